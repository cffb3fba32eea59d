"""What a scan cannot tell: it is said, a model is made all the same, and poses own up to it."""

from dataclasses import replace

import numpy as np
import pytest
from calibration_world import NOISE_T, Errors, moved_scan, scene, tool_of

from anser_ros.calibration.calibrate import Options, correct_scan, fit_scan
from anser_ros.calibration.held_out import HeldOutTally, factor_of
from anser_ros.calibration.layouts import Layout
from anser_ros.calibration.moments import PoseTerms
from anser_ros.calibration.population import Likelihood, Population
from anser_ros.calibration.result import corrections, undetermined_words
from anser_ros.calibration.sensor_fit import SensorFitter
from anser_ros.calibration.sensor_parameters import KINDS, STANDS, SURVEYED_M
from anser_ros.diagnosis.problem import Spread, build_problem, evaluate, expected_rms, rms
from anser_ros.errors import ModelFileError
from anser_ros.field.model import from_document, parse_gaps, to_document
from anser_ros.settings import Accuracy


def surveyed(seed, coils, seconds, turn_rad, errors, flat=False):
    """A joint fit of a scan by a hand, and what is true of it."""
    rng = np.random.default_rng(seed)
    world, table = scene(rng, side=4), tool_of(coils)
    told, truth = moved_scan(world, table, rng, seconds, errors, turn_rad, flat)
    return SensorFitter([told], KINDS, world.generator, Accuracy()).fit(), truth


@pytest.mark.long
def test_a_camera_that_jitters_shifts_neither_field_nor_tool_and_its_limits_are_known():
    found, truth = surveyed(307, 3, 20.0, 0.6, Errors(jitter=4.3))
    assert np.abs(found.errors_of('tool').lever_arm - truth.lever).max() < 1e-4
    assert 5e-6 < found.shift_sigma_m < 5e-5
    sigma = np.sqrt(np.diag(found.posterior.covariance))
    lever, offset = (sigma[found.parameters.rows(kind)] for kind in ('lever_arm', 'time_offset'))
    # 500 poses of 0.25 mm and 1.4 mrad by a hand at 0.11 m/s and 0.64 rad/s.
    assert 6e-5 < offset[0] < 1e-4
    assert lever.min() > 2.4e-5 and lever.max() < 4e-5
    assert (np.abs(found.errors_of('tool').lever_arm - truth.lever) < 3.0 * lever).all()


@pytest.mark.long
def test_a_scan_without_turns_tells_no_lever_arm_and_poses_know_it():
    found, _ = surveyed(22, 3, 6.0, 0.01, Errors())
    assert 'lever_arm' in found.undetermined
    line = 'lever_arm: the scan determines it only to 5 mm; the value of the setup is kept'
    assert line in undetermined_words(found)
    assert 0.2e-3 < found.shift_sigma_m <= 1.01 * SURVEYED_M
    population = Population(found.parameters)
    size = len(found.parameters)
    nothing, much = (Likelihood(told * np.eye(size), np.zeros(size)) for told in (0.0, 1e14))
    assert population.shift_sigma_m(nothing, population.fit(nothing)) == SURVEYED_M
    assert population.shift_sigma_m(nothing, population.fit(nothing), 2e-4) == 2e-4
    assert population.shift_sigma_m(much, population.fit(much)) < 1e-5, 'its setup knew the coils'


@pytest.mark.long
def test_a_scan_of_seconds_tells_nothing_of_the_sensors_and_takes_the_setup():
    found, _ = surveyed(23, 9, 2.0, 0.6, Errors())
    told = set(KINDS) - set(STANDS)  # which several sessions have
    assert set(found.undetermined) == told and not found.evidence
    assert len(undetermined_words(found)) == len(told)
    own = found.errors_of('tool')
    assert (own.gain == 1.0).all() and not own.place.any() and not own.lever_arm.any()
    assert found.kept[0].sum() >= 45


@pytest.mark.long
def test_of_one_coil_in_seconds_what_is_not_told_stays_at_the_setups():
    found, _ = surveyed(31, 1, 8.0, 0.6, Errors())
    assert {'axes', 'lever_arm'} <= set(found.undetermined)
    assert not set(found.undetermined) & set(found.evidence)
    assert np.abs(found.errors_of('tool').lever_arm).max() < 1e-9
    told = corrections(replace(found, evidence={'axes': 9.0}))
    assert told[0].name == 'sensor_axis', 'one coil has no spread'


@pytest.mark.long
def test_a_flat_scan_says_what_it_cannot_give():
    found, _ = surveyed(24, 3, 6.0, 0.6, Errors(), flat=True)
    assert 'lever_arm' in found.undetermined and 'lever_arm' not in found.evidence
    assert 0.2e-3 < found.shift_sigma_m <= 1.01 * SURVEYED_M


LAYER = Layout('layer', 10, 1.5, 0.0)


@pytest.fixture(scope='module')
def scanned():
    """A scan that left out one side of its volume, and the model of it."""
    world = scene(np.random.default_rng(7), side=17)
    side = world.measurements.position[:, 0] > 0.04
    part = world.measurements.frames(np.flatnonzero(~side))
    options = Options(layout=LAYER)
    tones = (1000.0, 1100.0, 1200.0)
    generator = replace(world.generator, emitters=('a', 'b', 'c'), frequencies_hz=tones)
    found = fit_scan(correct_scan([part], generator, options), ['scan'], generator, options)
    return world, side, found.model


def test_a_model_says_where_its_scan_has_a_gap(scanned):
    world, side, model = scanned
    table = world.measurements.sensors
    points, axes = table.placed(world.position, world.rotation)
    true = world.flux(points.reshape(-1, 3), axes.reshape(-1, 3)).reshape(*points.shape[:2], -1)
    error = np.abs(model.flux(points, axes) - true) / np.sqrt(2.0)
    told = model.gaps.sigma_t(points, axes, table.length)
    far = world.position[:, 0] > 0.07
    assert told[far].mean() > 5.0 * told[~side].mean()
    ratio = np.sqrt(np.mean(error[far] ** 2) / np.mean(told[far] ** 2))
    assert 0.3 < ratio < 3.0


def test_a_reading_in_a_gap_counts_for_less(scanned):
    world, side, model = scanned
    spread = Spread(NOISE_T)
    sure, unsure = (
        evaluate(build_problem([world.measurements], None, None, one, None, spread), ())
        for one in (replace(model, gaps=None, error_share=0.0), replace(model, error_share=0.0))
    )
    before, after = sure.parts[0].whitener.weight, unsure.parts[0].whitener.weight
    inner = np.abs(world.position - [-0.03, 0.0, 0.14]).max(axis=1) < 0.05
    assert after[inner].mean() > 0.9 * before[inner].mean()
    assert after[side].mean() < 0.7 * before[side].mean()
    assert expected_rms(sure) == pytest.approx(NOISE_T)
    assert expected_rms(unsure) > 1.2 * NOISE_T
    assert rms(unsure) == pytest.approx(rms(sure)), 'told in T, whatever the weights are'
    assert np.mean(unsure.parts[0].white ** 2) < 0.6 * np.mean(sure.parts[0].white ** 2)


def test_gaps_survive_the_models_file_and_broken_ones_are_refused(scanned):
    _, _, model = scanned
    again = from_document(to_document(model)).gaps
    assert np.array_equal(again.moments, model.gaps.moments)
    assert np.array_equal(again.positions, model.gaps.positions)
    with pytest.raises(ModelFileError, match='rows of at least 7 numbers'):
        parse_gaps([[0.0] * 6])
    with pytest.raises(ModelFileError, match='not a table'):
        parse_gaps([[0.0] * 7, ['x']])


def test_blocks_that_were_held_out_say_how_much_too_small_a_covariance_is():
    expected = np.geomspace(1e-24, 1e-20, 40)
    assert factor_of(expected, 9.0 * expected) == pytest.approx(3.0)
    assert factor_of(expected, 0.1 * expected) == 1.0
    assert factor_of(expected[:5], 9.0 * expected[:5]) == 1.0


@pytest.mark.parametrize('share', [0.0, 1e-3])
def test_a_field_that_errs_by_a_share_of_itself_says_so(share):
    rng = np.random.default_rng(4)
    flux = np.geomspace(1e-7, 1e-5, 300)[:, None, None] * rng.normal(size=(300, 9, 3))
    left = 1e-9 * rng.normal(size=(300, 9, 6))
    left += share * np.repeat(np.abs(flux), 2, axis=2) * rng.normal(size=left.shape)
    tally = HeldOutTally(1e-9, 1e-9, Accuracy(1e-9, 1e-9, 1e-9), 1)
    terms = PoseTerms(left, 1e-3 * rng.normal(size=(*left.shape, 6)))
    weights, place = np.ones((300, 9)), np.zeros((300, 3))
    tally.add(terms, weights, place, None, flux.astype(complex))
    assert tally.result().error_share == pytest.approx(share * np.sqrt(2.0), rel=0.2, abs=1e-4)
