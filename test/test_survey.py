"""What a scan is found to be wrong with: sensors, clock, optics, and frames that are left out."""

from dataclasses import replace

import numpy as np
import pytest
from calibration_world import JITTER_M, JITTER_RAD, NOISE_T, Errors, moved_scan, scene
from tracking_world import three_axis

from anser_ros.calibration.disturbances import outside, spans_of, unsteady_references
from anser_ros.calibration.population import Likelihood, Population, solve
from anser_ros.calibration.result import contradiction_words, corrections, reported_effects
from anser_ros.calibration.sensor_fit import SensorFitter
from anser_ros.calibration.sensor_parameters import KINDS, SensorParameters
from anser_ros.effects.correction import Correction
from anser_ros.errors import ModelFileError
from anser_ros.field.model import EffectRecord
from anser_ros.settings import Accuracy

pytestmark = pytest.mark.long

FRAMES, RATE_HZ = 500, 25.0
OFFSET_S, LEVER_M = 0.018, np.array([0.3e-3, -0.4e-3, 0.2e-3])
GLITCHES = (100, 400, 777)


@pytest.fixture(scope='module')
def dirty():
    """A moved scan in which everything is a little wrong, and what."""
    rng = np.random.default_rng(5)
    world = scene(rng, side=4)
    errors = Errors(lever_m=tuple(LEVER_M), offset_s=OFFSET_S, reflected=0.0)
    told, truth = moved_scan(world, world.measurements.sensors, rng, FRAMES / RATE_HZ, errors)
    there = told.track.position.copy()
    there[list(GLITCHES)] += [0.02, -0.01, 0.015]
    track = replace(told.track, position=there)
    at, rotation, has_pose = track.at(told.time)
    told = replace(told, track=track, position=at, rotation=rotation, has_pose=has_pose)
    found = SensorFitter([told], KINDS, world.generator, Accuracy()).fit()
    return told, found, truth


def test_all_that_is_wrong_is_found(dirty):
    _, found, truth = dirty
    own = found.errors_of('tool')
    assert np.abs(own.gain - truth.gain).max() < 3e-4
    assert np.abs(own.gain).mean() == pytest.approx(1.0, abs=1e-12)
    assert np.linalg.norm(own.axis - truth.axis, axis=1).max() < 5e-4
    assert np.abs(own.place - truth.place).max() < 2e-5
    assert np.abs(own.lever_arm - LEVER_M).max() < 5e-5
    assert abs(own.offset_s - OFFSET_S) < 1e-4
    assert found.left_out == ('clock_rate',)


def test_uncertainties_hold(dirty):
    _, found, truth = dirty
    sigma = np.sqrt(np.diag(found.posterior.covariance))
    rows = found.parameters.rows('gains')
    own = found.errors_of('tool')
    error = np.stack([own.gain.real, own.gain.imag], axis=1)
    error -= np.stack([truth.gain.real, truth.gain.imag], axis=1)
    assert np.sqrt(np.mean((error.ravel() / sigma[rows]) ** 2)) < 2.0
    assert sigma[rows].max() < 1e-3


def test_jitter_and_reflected_poses_are_told(dirty):
    told, found, _ = dirty
    assert found.optical.position_m == pytest.approx(JITTER_M, rel=0.08)
    assert found.optical.rotation_rad == pytest.approx(JITTER_RAD, rel=0.08)
    wrong = [np.argmin(abs(told.time - told.track.time[i] - OFFSET_S)) for i in GLITCHES]
    assert not found.kept[0][wrong].any()
    assert found.kept[0].mean() > 0.97
    assert reported_effects(found, [told]) == ()
    outliers = corrections(found)[-1]
    assert outliers.parameters['fraction'] == pytest.approx(6 / FRAMES, rel=0.5)


def test_records_undo_what_was_found(dirty):
    told, found, _ = dirty
    records = corrections(found)
    assert [record.name for record in records] == [
        'sensor_gain_spread', 'sensor_axis_spread', 'sensor_place_spread', 'lever_arm',
        'time_offset', 'outliers',
    ]  # fmt: skip
    correction = Correction.of(records, told.sensors, (1.0, 2.0, 3.0))
    assert correction.corrected[0] == 'sensor_gain_spread'
    own = found.errors_of('tool')
    repaired = own.apply(told)
    assert np.allclose(correction.sensors().position, repaired.sensors.position, atol=1e-12)
    assert np.allclose(correction.sensors().axis, repaired.sensors.axis, atol=1e-12)
    assert np.allclose(correction.optical(told.track).time, repaired.track.time)
    flux = correction.flux(0.0, told.sensors.channel, told.flux[7])
    assert np.allclose(flux, repaired.flux[7], rtol=1e-12)


def test_a_spread_without_its_values_is_refused():
    record = EffectRecord('sensor_gain_spread', {'channels': [0, 1], 'values': [[1.0, 0.0]]})
    sensors = scene(np.random.default_rng(0), side=2).measurements.sensors
    with pytest.raises(ModelFileError, match='needs 2 values for each of its 2 channels'):
        Correction.of([record], sensors, (1.0,))


def test_a_channel_far_outside_its_population_stands_alone(dirty):
    told, _, _ = dirty
    parameters = SensorParameters([told], ('gains',))
    population = Population(parameters)
    values = 0.004 * np.random.default_rng(1).normal(size=12)
    values[6] = 0.08
    information = np.eye(12) / 1e-4**2
    likelihood = Likelihood(information, information @ values)
    assert population.stand_alone(population.fit(likelihood))
    assert population.alone['gains'].tolist() == [6, 7]
    found = population.fit(likelihood)
    assert found.width[0] < 0.01
    assert found.values[6] == pytest.approx(0.08, rel=1e-3)
    assert not population.stand_alone(found)


def test_gains_that_the_axes_of_a_chip_share_are_found_to_be_shared():
    rng = np.random.default_rng(4)
    chips = three_axis('patch', 0.02 * rng.normal(size=(12, 3)))
    told = replace(scene(rng, side=2).measurements, body='patch', sensors=chips)
    population = Population(SensorParameters([told], ('gains',)))
    information = np.zeros((72, 72))
    information[::2, ::2] = np.eye(36) / 2e-3**2
    shared = {}
    for kind, chip in (('axes of a chip', 3), ('coils', 1)):
        truth = np.repeat(0.01 * rng.normal(size=36 // chip), chip)
        values = np.zeros(72)
        values[::2] = truth + 2e-3 * rng.normal(size=36)
        likelihood = Likelihood(information, information @ values)
        before = population.fit(likelihood)
        after = population.with_common_gains(likelihood, before)
        shared[kind] = after.shared
        errors = [np.sqrt(np.mean((p.values[::2] - truth) ** 2)) for p in (before, after)]
        assert errors[1] < (0.75 if chip == 3 else 1.05) * errors[0]
        assert after.width[0] == pytest.approx(0.01, rel=0.5)
    assert shared['axes of a chip'] > 0.95 and shared['coils'] < 0.5


def test_what_the_data_do_not_tell_stays_at_zero(dirty):
    told, _, _ = dirty
    population = Population(SensorParameters([told], ('axes', 'lever_arm')))
    noise = np.random.default_rng(2).normal(size=15)
    information = np.eye(15) / 1e-4**2
    found, left_out, _ = population.chosen(Likelihood(information, information @ (1e-4 * noise)))
    assert set(left_out) == {'axes', 'lever_arm'}
    assert np.abs(found.values).max() < 1e-9
    free = solve(Likelihood(information, information @ (1e-4 * noise)), np.full(15, 1.0))
    assert np.allclose(free.values, 1e-4 * noise, rtol=1e-6)


def test_references_say_when_metal_moved():
    rng = np.random.default_rng(3)
    steady = scene(rng, side=20)
    time = np.arange(400) / 25.0
    change = 5e-10 * np.exp(-(((time - 8.0) / 1.0) ** 2))
    noise = rng.normal(size=(400, 6, 3)) + 1j * rng.normal(size=(400, 6, 3))
    flux = 1e-6 + change[:, None, None] + NOISE_T * noise
    reference = replace(
        steady.measurements, time=time, flux=flux, valid=np.ones((400, 6), dtype=bool)
    )
    (span,) = spans_of(time, unsteady_references(reference))
    assert span.start_s == pytest.approx(6.2, abs=0.8)
    assert span.end_s == pytest.approx(9.8, abs=0.8)
    assert outside(time, [span]).sum() == 400 - span.holds(time).sum()
    quiet = replace(reference, flux=flux - change[:, None, None])
    assert not unsteady_references(quiet).any()


def test_sessions_that_say_different_things_of_a_sensor_are_told(dirty):
    told, whole, _ = dirty
    halves = [told.frames(np.arange(0, 160)), told.frames(np.arange(250, 410))]
    changed = halves[1].flux.copy()
    changed[:, 4] *= 1.01
    other = replace(halves[1], flux=changed)
    generator = scene(np.random.default_rng(5), side=2).generator
    same, differ = (
        SensorFitter([halves[0], second], KINDS, generator, Accuracy()).fit()
        for second in (halves[1], other)
    )
    assert whole.contradictions == () and same.contradictions == ()
    assert [c.place for c in differ.contradictions] == ['tool/1/y']
    found = differ.contradictions[0]
    assert (found.kind, found.sessions) == ('gains', (0, 1))
    assert found.size == pytest.approx(0.01, rel=0.05)
    (line,) = contradiction_words(differ, ['monday.mcap', 'tuesday.mcap'])
    assert line.startswith('gains of tool/1/y: monday.mcap and tuesday.mcap differ by ')
