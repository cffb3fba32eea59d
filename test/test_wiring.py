"""Faults of wiring and mounting, alone and together, are named, and undoing them leaves noise."""

from dataclasses import replace

import numpy as np
import pytest
from diagnosis_world import world
from scipy.spatial.transform import Rotation

from anser_ros.diagnosis.problem import evaluate
from anser_ros.diagnosis.wiring import (
    rightly_wired,
    scan_faults,
    session_faults,
    wiring_faults,
    wiring_words,
    without_dead,
)
from anser_ros.effects.effect import Term, effect_named
from anser_ros.physics.pose_track import PoseTrack

TURN = (0.0, 0.0, 90.0)


def turned_back(made, turn):
    """State a body of a session as the true one turned back, deg."""
    track, turn = made.tool.track, Rotation.from_rotvec(turn, degrees=True)
    stated = Rotation.from_quat(track.quaternion) * turn.inv()
    made.track(PoseTrack(track.time, track.position, stated.as_quat()))


def said(term):
    """What a record says of a term, its numbers in tuples and rounded."""
    stated = term.effect.record(term, np.zeros((0, 0))).parameters
    return {key: tuple(np.round(values, 9).tolist()) for key, values in stated.items()}


def faults_of(
    emitters=3, sensors=(0, 1, 2), signs=(), coils=(), order=None, tones=None, turn=None
):
    """The faults of a session that has these, the truth of its turn, and what the undoing leaves.

    ``signs``, ``coils``: rows and emitters that are reversed; ``order``, ``tones``: rows and
    emitters that are read; ``turn``: of the body in its holder, deg.
    """
    made = world(seed=2, frames=200, emitters=emitters)
    rows = list(sensors)
    made.tool = made.tool.sensors_only(rows)
    if turn is not None:
        turned_back(made, turn)
    flux = made.tool.flux[:, order or slice(None)][:, :, tones or slice(None)].copy()
    flux[:, list(signs)] *= -1.0
    flux[:, :, list(coils)] *= -1.0
    made.tool = replace(made.tool, flux=flux)
    problem = replace(made.problem(), references=None)
    found = wiring_faults(problem)
    return {t.effect.name: t for t in found}, evaluate(problem, found).misfit


@pytest.mark.parametrize(
    ('fault', 'expected'),
    [
        ({}, {}),
        ({'signs': [2]}, {'sensor_polarity': {'channels': (2,)}}),
        ({'coils': [0, 2]}, {'coil_polarity': {'coils': (0, 2)}}),
        (
            {'signs': [1], 'coils': [2]},
            {'sensor_polarity': {'channels': (1,)}, 'coil_polarity': {'coils': (2,)}},
        ),
        ({'order': [1, 0, 2]}, {'swapped_channels': {'channels': (1, 0), 'read_as': (0, 1)}}),
        (
            {'order': [1, 0, 2], 'coils': [1]},
            {
                'swapped_channels': {'channels': (1, 0), 'read_as': (0, 1)},
                'coil_polarity': {'coils': (1,)},
            },
        ),
        (
            {'tones': [2, 1, 0], 'signs': [1]},
            {
                'swapped_coils': {'coils': (2, 0), 'read_as': (0, 2)},
                'sensor_polarity': {'channels': (1,)},
            },
        ),
        ({'turn': [90.0, 0, 0]}, {'body_turned': {'rotation_deg': (90.0, 0.0, 0.0)}}),
        (
            {'turn': [0, 0, -90.0], 'coils': [1]},
            {'body_turned': {'rotation_deg': (0.0, 0.0, -90.0)}, 'coil_polarity': {'coils': (1,)}},
        ),
        # Two reversed coils leave what is not in the middle; a half turn leaves nothing.
        ({'turn': [180.0, 0, 0]}, {'body_turned': {'rotation_deg': (180.0, 0.0, 0.0)}}),
        (
            {'sensors': range(6), 'turn': [0, 180.0, 0]},
            {'body_turned': {'rotation_deg': (0.0, 180.0, 0.0)}},
        ),
    ],
)  # fmt: skip
def test_faults_of_wiring_are_named_and_undone(fault, expected):
    found, misfit = faults_of(**fault)
    assert set(found) == set(expected)
    for name, stated in expected.items():
        assert said(found[name]) == {**said(found[name]), **stated}
    assert misfit < 1.2


@pytest.mark.parametrize('dead', [slice(50, None), slice(None)])
def test_frames_without_an_emitter_that_gives_at_times_do_not_count(dead):
    made = world(seed=2, frames=100, emitters=3)
    flux = made.tool.flux.copy()
    flux[dead, :, 1] = 0.0
    made.flux(flux)
    counted = without_dead(made.problem()).good[0].any(axis=1)
    np.testing.assert_array_equal(counted, flux[:, :, 1].any() <= flux[:, :, 1].any(axis=1))


def test_a_turned_body_turns_its_own_sensors_and_no_other():
    effect = effect_named('body_turned')
    term = Term(effect, {'channels': (0, 1)}, np.array([0.0, np.pi / 2, 0.0]))
    table = world(seed=2, frames=60).tool.sensors
    turned = effect.table(term, table)
    np.testing.assert_allclose(turned.axis[0], [0.0, 0.0, -1.0], atol=1e-12)
    np.testing.assert_allclose(turned.position[1], [-0.015, 0.0, 0.0], atol=1e-12)
    np.testing.assert_array_equal(turned.axis[2:], table.axis[2:])


@pytest.mark.parametrize(
    ('fault', 'expected'),
    [
        (None, []),
        ('sign', [('sensor_polarity', {'channels': (1, 4)})]),
        ('turn', [('body_turned', {'channels': (0, 1, 2, 3, 4, 5), 'rotation_deg': TURN})]),
        ('swap', [('swapped_channels', {'channels': (3, 1), 'read_as': (1, 3)})]),
        ('coil', []),  # the field is unknown: its sign is that of the dipoles
    ],
)  # fmt: skip
def test_a_scan_says_what_is_wrong_with_its_wiring(fault, expected):
    made = world(seed=2, frames=300, emitters=3)
    clean = made.tool.flux.copy()
    if fault == 'turn':
        turned_back(made, TURN)
    flux = made.tool.flux.copy()
    if fault == 'sign':
        flux[:, [1, 4]] *= -1.0
    if fault == 'coil':
        flux[:, :, 1] *= -1.0
    if fault == 'swap':
        flux[:, [1, 3]] = flux[:, [3, 1]]
    tool = replace(made.tool, flux=flux)
    line = np.linspace(-0.12, 0.12, 5)
    found = scan_faults([tool], np.array([(x, y, 0.0) for x in line for y in line]))
    assert [(term.effect.name, said(term)) for term in found] == expected
    righted = rightly_wired(tool, found)
    if fault != 'coil':
        np.testing.assert_allclose(righted.flux, clean)
    if fault == 'turn':
        np.testing.assert_allclose(righted.sensors.axis[0], [0.0, 1.0, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ('fault', 'words'),
    [
        ('turn', 'tool stands turned by 90 deg about +z against its stated axes'),
        ('sign', 'sensor tool/0/y and sensor tool/1/y are reversed'),
        ('coils', 'emitter 0 and emitter 2 are reversed'),
    ],
)  # fmt: skip
def test_a_session_that_stands_otherwise_is_named(fault, words):
    made = world(seed=2, frames=300, emitters=3)
    plain = made.tool
    if fault == 'turn':
        turned_back(made, TURN)
    flux = made.tool.flux.copy()
    if fault == 'sign':
        flux[:, [1, 4]] *= -1.0
    if fault == 'coils':
        flux[:, :, [0, 2]] *= -1.0
    wrong = replace(made.tool, flux=flux)
    line = np.linspace(-0.12, 0.12, 5)
    places = np.array([(x, y, 0.0) for x in line for y in line])
    parts = [m.frames(slice(k, None, 3)) for k, m in enumerate((plain, wrong, plain))]
    number, (term,) = session_faults([[part] for part in parts], places)
    assert (number, wiring_words(term, plain.sensors, '012')) == (1, words)
    assert session_faults([[plain.frames(slice(k, None, 3))] for k in range(3)], places)[1] == []
