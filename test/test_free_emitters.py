"""Emitters of any shape: clusters of dipoles, delays of channels, errors that places share."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from anser_ros.calibration.calibrate import Options, correct_scan, fit_scan
from anser_ros.calibration.held_out import rms
from anser_ros.calibration.layouts import CLUSTER, FREE_KINDS, Generator, clusters, fit_clusters
from anser_ros.calibration.population import alike_sigma_m
from anser_ros.calibration.result import residuals
from anser_ros.calibration.selection import COAXIAL
from anser_ros.calibration.sensor_parameters import KINDS, SensorParameters, open_ways
from anser_ros.effects.correction import Correction
from anser_ros.errors import ModelFileError
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import SESSION, Dipoles, EffectRecord
from anser_ros.physics.dipole import flux_basis
from anser_ros.physics.sensor import SensorTable
from anser_ros.sessions.diagnosis import diagnose_session
from anser_ros.sessions.prepared import correct, prepare
from anser_ros.sessions.session import Session
from anser_ros.settings import Accuracy
from anser_ros.wire.setup import Coil, Emitter, SensorSpec, Setup

TONES = (7500.0, 10500.0, 13500.0)
X, _, Z = np.eye(3)
CENTRES = np.array([[0.03, 0.0, 0.05], [-0.02, 0.04, 0.04], [-0.02, -0.04, 0.06]])
NOISE_T, JITTER_M, JITTER_RAD = 1e-10, 5e-5, 3e-4
ACCURACY = Accuracy(NOISE_T, JITTER_M, JITTER_RAD)
DELAY_S = np.array([4e-8, -3e-8, -1e-8])


def body():
    return SensorTable(
        np.arange(3), ('tool/x', 'tool/y', 'tool/z'), ('tool',) * 3, np.zeros((3, 3)), np.eye(3),
        np.zeros(3),
    )  # fmt: skip


def shapeless(rng):
    """Three emitters of five dipoles each, anywhere within 2 cm: nothing has an axis."""
    places = CENTRES[:, None] + 0.02 * rng.uniform(-1, 1, (3, 5, 3))
    moments = np.zeros((3, 5, 3, 3), complex)
    for k, axis in enumerate(np.eye(3)):
        moments[k, :, :, k] = 0.4 * axis + 0.15 * rng.normal(size=(5, 3))
    return Dipoles.vectors(places.reshape(-1, 3), moments.reshape(15, 3, 3))


def scan(rng, field, frames=250, delay_s=DELAY_S):
    """Poses 0.14 to 0.3 m above the emitters, each in any orientation, and what is read there."""
    place = rng.uniform([-0.09, -0.09, 0.2], [0.09, 0.09, 0.33], (frames, 3))
    turn = Rotation.random(frames, random_state=3)
    sensors = body()
    points, axes = sensors.placed(place, turn.as_matrix())
    flux = field.flux(points.reshape(-1, 3), axes.reshape(-1, 3), None).reshape(frames, 3, 3)
    omega = 2 * np.pi * np.array(TONES)
    flux = flux * np.exp(-1j * delay_s[:, None] * (omega - omega.mean()))
    noise = NOISE_T * rng.normal(size=(*flux.shape, 2)) @ [1.0, 1j]
    off = Rotation.from_rotvec(JITTER_RAD * rng.normal(size=(frames, 3)))
    return Measurements(
        'tool', sensors, 2.0 * np.arange(frames), flux + noise, np.ones((frames, 3), bool),
        np.zeros((frames, 3), int), place + JITTER_M * rng.normal(size=place.shape),
        (off * turn).as_matrix(), np.ones(frames, bool),
    )  # fmt: skip


@pytest.fixture(scope='module')
def found():
    rng = np.random.default_rng(8)
    field = shapeless(rng)
    measured = scan(rng, field)
    stated = CENTRES + [0.015, -0.01, 0.01]  # as well as a ruler tells
    generator = Generator(stated, np.zeros(3), 0.05, ('a', 'b', 'c'), TONES)
    options = Options(ACCURACY, estimate=KINDS)
    corrected = correct_scan([measured], generator, options)
    return field, corrected, fit_scan(corrected, ['scan'], generator, options)


def at_new_places(rng, count=300):
    points = rng.uniform([-0.08, -0.08, 0.21], [0.08, 0.08, 0.32], (count, 3))
    axes = rng.normal(size=(count, 3))
    return points, axes / np.linalg.norm(axes, axis=1)[:, None], np.zeros(count)


def test_a_cluster_makes_the_field_of_any_source_of_its_size():
    rng = np.random.default_rng(1)
    field, where = shapeless(rng), at_new_places(rng)
    truth = field.flux(*where)
    left = []
    for places in (
        CENTRES[:, None],
        CENTRES[:, None] + 0.03 * CLUSTER[:7],
        CENTRES[:, None] + 0.03 * CLUSTER,
    ):
        errors = []
        for k, own in enumerate(places):
            sites = np.repeat(own, 3, axis=0), np.tile(np.eye(3), (len(own), 1))
            basis = flux_basis(*where, *sites)
            moments = np.linalg.lstsq(basis, truth[:, k], rcond=1e-9)[0]
            errors.append(rms(truth[:, k] - basis @ moments) / rms(truth[:, k]))
        left.append(max(errors))
    assert left[0] > 0.02  # one dipole
    assert left[1] < 0.03 * left[0]


def test_emitters_at_one_place_have_one_cluster_and_others_their_own():
    sites = clusters(np.array([[0.0, 0.0, 0.0], [0.001, 0.0, 0.0], [0.1, 0.0, 0.0]]), 0.03)
    assert len(sites) == 2 * 3 * 7
    groups = sites.groups(3)
    assert [emitters for emitters, _ in groups] == [[0, 1], [2]]
    assert not set(groups[0][1]) & set(groups[1][1])


def test_clusters_go_where_the_emitters_are():
    rng = np.random.default_rng(2)
    measured = scan(rng, shapeless(rng), delay_s=np.zeros(3))
    weights = [np.ones(measured.valid.shape)]
    sites = fit_clusters([measured], weights, CENTRES + [0.02, 0.02, -0.02])
    middles = sites.positions[:: 3 * len(CLUSTER)]
    assert np.linalg.norm(middles - CENTRES, axis=1).max() < 0.015


def test_sources_without_an_axis_are_learnt_as_clusters(found):
    field, corrected, calibration = found
    assert calibration.layout.kind in FREE_KINDS
    scores = {one.layout: one.score for one in calibration.candidates}
    assert scores[calibration.layout] < 0.3 * min(scores[layout] for layout in COAXIAL)
    where = at_new_places(np.random.default_rng(5))
    truth = field.flux(*where)
    gain = np.vdot(calibration.model.flux(*where), truth) / np.vdot(truth, truth)
    assert abs(abs(gain) - 1.0) < 2e-3
    assert rms(calibration.model.flux(*where) - truth) < 3e-3 * rms(truth)
    assert corrected.sensor_fit.kept[0].mean() > 0.98


def test_delays_are_found_and_undone(found):
    _, corrected, _ = found
    (record,) = (r for r in corrected.corrections if r.name == 'sensor_delay_spread')
    values = np.array(record.parameters['values'])[:, 0]
    assert np.abs(values - DELAY_S).max() < 3e-9
    flux = np.ones((3, 3), complex)
    omega = 2 * np.pi * np.array(TONES)
    turn = np.exp(-1j * values[:, None] * (omega - omega.mean()))
    undone = Correction.of([record], body(), TONES).flux(0.0, np.arange(3), turn)
    assert np.allclose(undone, flux, rtol=1e-12)
    bad = EffectRecord('sensor_delay_spread', {'channels': [0], 'values': [[0.0, 1.0]]})
    with pytest.raises(ModelFileError, match='needs 1 values for each of its 1 channels'):
        Correction.of([bad], body(), TONES)


def test_errors_that_places_share_are_told_from_jitter():
    rng = np.random.default_rng(6)
    measured = scan(rng, shapeless(rng), 400)
    kept = [np.ones(400, bool)]
    jitter = 1e-4 * rng.normal(size=(400, 6))
    assert alike_sigma_m([measured], [jitter], kept) < 4e-5
    wave = 2e-4 * np.sin(20.0 * measured.position[:, [1, 2, 0]])
    by_place = np.concatenate([wave, np.zeros((400, 3))], axis=1)
    expected = np.sqrt(np.mean(wave**2))
    assert alike_sigma_m([measured], [jitter + by_place], kept) == pytest.approx(expected, rel=0.2)
    assert alike_sigma_m([measured], [jitter], [np.zeros(400, bool)]) == 0.0


def test_sessions_that_turn_about_one_axis_each_determine_a_lever_arm_together():
    rng = np.random.default_rng(7)
    whole = scan(rng, shapeless(rng), 60)
    rests = replace(whole, rotation=np.tile(np.eye(3), (60, 1, 1)))
    about = [
        replace(
            whole,
            rotation=Rotation.from_rotvec(np.outer(np.linspace(-1, 1, 60), axis)).as_matrix(),
        )
        for axis in (X, Z)
    ]
    np.testing.assert_allclose(np.abs(open_ways(about[:1])), [X], atol=1e-9)
    assert not len(open_ways(about))
    one, both = (SensorParameters(part, KINDS) for part in (about[:1], about))
    assert 'lever_arm' not in one.kinds and 'lever_arm' in both.kinds and 'axes' in one.kinds
    assert 'lever_arm' not in SensorParameters([rests], KINDS).kinds
    kinds = [SensorParameters([m], KINDS).kinds for m in (rests, rests.sensors_only([0]))]
    assert ['axes' in own for own in kinds] == [True, False]


def stood(measured, frame, mount, session):
    """A session's poses, of (turn, shift) frames as the optics say, on a mount of its own."""
    turn, held = (Rotation.from_rotvec(part[:3]) for part in (frame, mount))
    # Where it is said to be, and how, so that its coils are where they are.
    rotation = measured.rotation @ held.as_matrix().T
    position = measured.position - rotation @ mount[3:]
    rotation, position = turn.as_matrix().T @ rotation, turn.inv().apply(position - frame[3:])
    return replace(measured, rotation=rotation, position=position, session=session)


@pytest.mark.parametrize('size', [0.0, 1.0])
def test_sessions_stand_by_themselves_and_share_field_and_sensors(size):
    rng = np.random.default_rng(9)
    whole, names = scan(rng, shapeless(rng), 450), ('a.mcap', 'b.mcap', 'c.mcap')
    generator = Generator(CENTRES, np.zeros(3), 0.05, ('a', 'b', 'c'), TONES)
    unit = size * np.array([8e-3, 8e-3, 8e-3, 2e-3, 2e-3, 2e-3])
    frames, mounts = (unit * rng.normal(size=(3, 6)) for _ in range(2))
    parts = [
        stood(whole.frames(np.arange(i, 450, 3)), frames[i], mounts[i] / 2, name)
        for i, name in enumerate(names)
    ]
    options = Options(ACCURACY, estimate=KINDS)
    corrected = correct_scan(parts, generator, options)
    model = fit_scan(corrected, names, generator, options).model
    records = [record for record in model.effects if SESSION in record.parameters]
    assert sorted(r.name for r in records) == sorted(
        ['registration', 'body_turned', 'lever_arm'] * 3 if size else []
    )
    coils = tuple(
        Coil(name, tuple(place), 0.0, tone)
        for name, place, tone in zip('abc', CENTRES.tolist(), TONES, strict=True)
    )
    table = body()
    sensors = tuple(
        SensorSpec(k, table.name[k], 'tool', (0.0, 0.0, 0.0), tuple(axis), 0.0)
        for k, axis in enumerate(table.axis.tolist())
    )
    setup = Setup('fg', 1.0, Emitter('free', {}, coils), sensors, None, {})
    for part, name in zip(parts, names, strict=True):
        session = Session(name, setup, 10**9, (part,), None)
        prepared = prepare(session, model)
        assert not any(SESSION in record.parameters for record in prepared.model.effects)
        (tool,) = correct(prepared).session.tools
        left = residuals([tool], prepared.model)
        assert left.unexplained < 4e-3, name
        # Reversed or exchanged coils hide neither how it stands nor whose the delays are, and a
        # lever arm hides no turn.
        wrong = {
            '': part,
            'coil_polarity': replace(part, flux=part.flux * [1, -1, -1]),
            'swapped_channels': replace(part, flux=part.flux[:, [1, 0, 2]]),
            'lever_arm': replace(part, position=part.position - part.rotation @ [6e-3, 0.0, 8e-3]),
        }
        noise = {
            'outliers',
            'excess_noise',
            'loose_contact',
        }  # the setup states less than there is
        for fault, tool in wrong.items() if size and name == names[1] else ():
            found = diagnose_session(replace(session, tools=(tool,)), model)
            named = {one.record.name for one in found.diagnosis.findings}
            assert named - noise == {fault} - {''}, name
            assert found.after.position_rmse_m < 3e-4
