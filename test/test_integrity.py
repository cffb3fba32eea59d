"""Faults that one frame's residual does not see: copies, swaps, leaps, other models."""

from dataclasses import replace

import numpy as np
import pytest
from tracked_tool import CHANNELS, MODEL, STEP_NS, TOOL, path
from tracking_world import NOISE_T, fluxes

from anser_ros import pose_states as states
from anser_ros.errors import TrackingError
from anser_ros.frames.intake import Freshness, Intake
from anser_ros.integrity.pose_checks import Continuity, Place
from anser_ros.physics.rotations import rotation_of_vector
from anser_ros.settings import ToolSettings
from anser_ros.tracking.estimate import TrackerSettings
from anser_ros.tracking.rigid import weigh
from anser_ros.tracking.tracker import Tracker

SEED = 7
HANDS = ToolSettings()
FAULT = 30


def wrong_and_ok(estimates, position, rotation):
    """Names whose pose is published although it is wrong by more than max(3 sigma, 1 mm)."""
    truth = dict(zip(TOOL.name, TOOL.placed(position, rotation)[0], strict=True))
    truth['tool_a'] = position
    return [
        e.name for e in estimates
        if e.state == states.OK
        and np.linalg.norm(e.position - truth[e.name]) > max(3 * e.sigma_position_m, 1e-3)
    ]  # fmt: skip


def track_with(fault, rng, count=80, settings=None, model=MODEL, **options):
    """Track a moving tool whose fluxes (all so far, newest last) a fault changes.

    Returns all estimates by frame; none of them may be wrong and ok.
    """
    tracker, seen, all_found = Tracker(model, TOOL, settings), [], []
    for i, (stamp, position, rotation) in enumerate(path(count)):
        seen.append(fluxes(MODEL, TOOL, position, rotation, rng))
        found = tracker.update(stamp, CHANNELS, fault(i, seen), **options)
        assert wrong_and_ok(found, position, rotation) == [], i
        all_found.append({e.name: e for e in found})
    return all_found


# Freshness ------------------------------------------------------------------------------


@pytest.mark.parametrize('length', [1, 5, 40])
def test_a_ring_of_old_frames_is_stuck_at_once_and_new_ones_are_good_at_once(rng, length):
    def ring(i, seen):
        return seen[50 - length + (i - 50) % length if 50 <= i < 70 else i]

    found = track_with(ring, rng, 90)
    for i, frame in enumerate(found):
        state = {e.state for e in frame.values()}
        assert state == ({'stale'} if 50 <= i < 70 else {'ok'}), i
    assert 'stuck: the same reading as' in found[50]['tool_a/0/x'].reason


def test_a_frozen_column_divided_by_a_noisy_current_is_stuck(rng):
    """The voltages stay to the last bit; the measured currents, 3 A, have their own noise."""
    frozen = TOOL.name[3]

    def column(i, seen):
        flux = seen[i].copy()
        if i >= FAULT:
            noise = 7e-6 * (rng.normal(size=8) + 1j * rng.normal(size=8))
            flux[3] = seen[FAULT][3] / (1.0 + noise)
        return flux

    found = track_with(column, rng)
    assert all(frame[frozen].state == 'stale' for frame in found[FAULT + 8 :])
    assert all(frame['tool_a'].state == 'ok' for frame in found)


@pytest.mark.parametrize('emitters', [1, 3, 8])
@pytest.mark.parametrize('noise_t', [NOISE_T / 8, NOISE_T])
def test_a_still_tool_is_never_stuck(rng, emitters, noise_t):
    """Also where the stated noise is eight times the true one; fluxes travel as float32."""
    intake, fresh = Intake(np.arange(9)), Freshness()
    still = 1e-6 * (rng.normal(size=(9, emitters)) + 1j * rng.normal(size=(9, emitters)))
    for stamp in range(1, 400):
        noise = rng.normal(size=(2, 9, emitters))
        flux = (still + noise_t * (noise[0] + 1j * noise[1])).astype(np.complex64)
        frame = fresh.judged(intake.admit(stamp * STEP_NS, np.arange(9), flux), NOISE_T)
        assert frame.usable.all(), stamp


@pytest.mark.parametrize(('emitters', 'most'), [(1, 8), (3, 3), (8, 1)])
def test_few_emitters_only_need_more_copies(rng, emitters, most):
    intake, fresh = Intake(np.arange(1)), Freshness()
    flux = 1e-6 * (rng.normal(size=(1, emitters)) + 1j * rng.normal(size=(1, emitters)))
    states_seen = [
        fresh.judged(intake.admit(stamp * STEP_NS, [0], flux), NOISE_T).usable[0]
        for stamp in range(1, 20)
    ]
    assert states_seen[0] and not any(states_seen[most:])


# Rigidity -------------------------------------------------------------------------------


def test_swapped_columns_give_no_pose_and_their_body_goes_on(rng):
    def swap(i, seen):
        order = [0, 1, 2, 3, 4, 8, 6, 7, 5] if i >= FAULT else range(9)
        return seen[i][list(order)]

    found = track_with(swap, rng)
    for frame in found[FAULT + 1 :]:
        assert {frame[name].state for name in ('tool_a/1/z', 'tool_a/2/z')} == {'inconsistent'}
        assert frame['tool_a'].state == 'ok' and frame['tool_a/0/x'].state == 'ok'
    assert 'from its place in the body' in found[-1]['tool_a/1/z'].reason


@pytest.mark.parametrize('moved', [range(3), range(6), (0, 1, 2, 6, 7, 8)])
@pytest.mark.parametrize('aside_m', [1.5e-3, 6e-3])
def test_parts_of_a_bent_tool_contradict_each_other_and_none_is_believed(rng, moved, aside_m):
    """Most coils may be in the part that has moved, so their number says nothing."""
    bent, tracker = TOOL.position.copy(), Tracker(MODEL, TOOL)
    bent[list(moved)] += [0.6 * aside_m, 0.8 * aside_m, 0.0]
    for i, (stamp, position, rotation) in enumerate(path(60)):
        real = TOOL if i < FAULT else replace(TOOL, position=bent)
        found = tracker.update(stamp, CHANNELS, fluxes(MODEL, real, position, rotation, rng))
        assert wrong_and_ok(found, position, rotation) == [], i
    assert {e.state for e in found} <= {'inconsistent', 'residual'}


def test_clusters_that_are_permuted_now_and_then_give_no_pose(rng):
    def permute(i, seen):
        turned = FAULT <= i < 60 and i % 5 == 0
        return np.roll(seen[i], -3, axis=0) if turned else seen[i]

    found = track_with(permute, rng, count=164)
    assert {e.state for e in found[FAULT + 1].values()} == {'ok'}, 'one such frame is a chance'
    assert {e.state for e in found[52].values()} == {'unconfirmed'}
    assert all('a fault of the line' in e.reason for e in found[52].values())
    assert {e.state for e in found[-1].values()} == {'ok'}


def test_no_coil_is_left_out_where_the_others_could_not_contradict_the_pose(rng):
    """Three coils of three emitters: any two of them fit some pose, whatever the third says."""
    few = replace(
        MODEL, moments=MODEL.moments[:, :3], emitters=MODEL.emitters[:3],
        frequencies_hz=MODEL.frequencies_hz[:3],
    )  # fmt: skip
    tool = TOOL.select(np.array([0, 4, 8]))
    tracker = Tracker(few, tool)
    for i, (stamp, position, rotation) in enumerate(path(20)):
        seen = fluxes(few, tool, position, rotation, rng)
        seen[2] *= 1.0 if i < 10 else 1.3
        body = tracker.update(stamp, tool.channel, seen)[-1]
        assert body.state == (states.OK if i < 10 else states.RESIDUAL), i


@pytest.mark.parametrize('rows', [(2, 8), (2, 5, 8)])
@pytest.mark.parametrize('every', [1, 2, 5])
def test_parallel_coils_that_are_exchanged_along_their_axis_contradict_each_other(
    rng, rows, every
):
    tool = TOOL.select(list(rows))
    tracker = Tracker(MODEL, tool)
    for i, (stamp, position, rotation) in enumerate(path(60)):
        flux = fluxes(MODEL, tool, position, rotation, rng)
        turned = i >= FAULT and i % every == 0
        found = tracker.update(stamp, tool.channel, flux[::-1] if turned else flux)
        assert wrong_and_ok(found, position, rotation) == [], i
        if i < FAULT or turned:
            assert {e.state for e in found} == {states.INCONSISTENT if turned else states.OK}, i


@pytest.mark.parametrize('gate', [8.0, 100.0, 1e6])
def test_a_wide_gate_of_residuals_leaves_rigidity_and_continuity(rng, gate):
    def swap(i, seen):
        return seen[i][[4, 1, 2, 3, 0, 5, 6, 7, 8]] if i >= FAULT else seen[i]

    found = track_with(swap, rng, settings=TrackerSettings(gate=gate))
    assert 'ok' not in {found[-1][name].state for name in ('tool_a/0/x', 'tool_a/1/y')}


@pytest.mark.parametrize('gain', [0.98, 1.01, 1.02])
@pytest.mark.parametrize('learns', [False, True])
def test_a_gain_that_all_coils_have_in_common_is_in_every_sigma(rng, gain, learns):
    """High up it looks like a distance to each coil; the body tells it, whatever the gate, and
    without references it is learnt as one of the emitters.
    """
    tracker, sigma = Tracker(MODEL, TOOL, TrackerSettings(gate=50.0)), {}
    for now in (1.0, gain):
        for stamp, position, rotation in path(120):
            place = position + [0.0, 0.0, 0.1]
            flux = now * fluxes(MODEL, TOOL, place, rotation, rng)
            found = tracker.update(stamp + round(1e12 * now), CHANNELS, flux, learns=learns)
            assert wrong_and_ok(found, place, rotation) == []
            sigma[now] = found[-1].sigma_position_m
    assert sigma[1.0] < 1e-4 and (learns or sigma[gain] > 5e-4)


@pytest.mark.parametrize(('told', 'off', 'counts'), [
    (0.0, 0.0, 0.87e-3),  # one chance in a hundred of 1 %, less what nobody reckons with
    (1e7, 0.0, 0.0), (1e7, 0.02, 0.02), (1e7, 3e-4, 0.0), (1e6, 5e-3, 5e-3),
])  # fmt: skip
def test_a_common_gain_counts_as_far_as_it_may_have_changed(told, off, counts):
    """``told`` is what readings tell of it, ``off`` by how much it has changed."""
    rows = np.zeros((8, 10))
    rows[1:7, 1:7] = np.eye(6)
    rows[7, 8] = np.sqrt(told)
    rows[0] = off * rows[7]
    *_, gain, _ = weigh(rows, np.zeros((0, 10)), np.eye(6), 1)
    assert gain == pytest.approx(counts, rel=0.1, abs=1e-5)


def test_a_survey_as_wrong_as_is_stated_contradicts_nothing(rng):
    """Places 0.12 mm, axes 0.5 degrees and gains 0.2 % off, as the settings have them."""
    off = 0.12e-3 * rng.normal(size=(9, 3))
    turned = [
        rotation_of_vector(np.radians(0.5) * rng.normal(size=3)) @ axis for axis in TOOL.axis
    ]
    real = replace(TOOL, position=TOOL.position + off, axis=np.array(turned))
    gain = 1.0 + 0.002 * rng.normal(size=(9, 1))
    tracker, seen = Tracker(MODEL, TOOL, TrackerSettings(gate=40.0)), []
    for stamp, position, rotation in path(60):
        flux = gain * fluxes(MODEL, real, position, rotation, rng)
        seen += [e.state for e in tracker.update(stamp, CHANNELS, flux)]
    assert states.INCONSISTENT not in seen


@pytest.mark.parametrize(
    ('rows', 'moved', 'size', 'up_m'),
    [((0, 4), (4,), 1e-3, 0.15), (range(9), (3, 4, 5, 6, 7, 8), 2e-3, 0.17)],
)
def test_the_sigma_of_a_tool_that_is_bent_high_above_the_board_says_so(rows, moved, size, up_m):
    """There single coils see too little to contradict each other."""
    rng, aside, found = np.random.default_rng(5), np.zeros((9, 3)), []
    aside[list(moved)] = size * np.array([0.6, 0.8, 0.0])
    tool, bent = TOOL.select(list(rows)), replace(TOOL, position=TOOL.position + aside)
    tracker, real = Tracker(MODEL, tool), bent.select(list(rows))
    for stamp, position, rotation in path(200):
        position = position + [0.0, 0.0, up_m]
        flux = fluxes(MODEL, real, position, rotation, rng)
        body = tracker.update(stamp, tool.channel, flux)[-1]
        if body.state == states.OK:
            error = np.linalg.norm(body.position - position)
            found.append(error / max(3.0 * body.sigma_position_m, 1e-3))
    assert len(found) > 10 and max(found) < 1.0


# Continuity -----------------------------------------------------------------------------


def judged(places, bounds=HANDS, step_s=0.02, sigma_m=1e-4):
    """Whether each of some places (None: refused), a step apart, is confirmed."""
    one, found = Continuity(), []
    for i, x in enumerate(places, start=1):
        stamp = round(i * step_s * 1e9)
        place = None if x is None else Place(stamp, (x, 0.0, 0.0), sigma_m)
        found.append(one.judge(stamp, place, x is None, bounds) == '')
    return found


def test_what_slips_through_a_long_refusal_waits_for_a_run():
    places = [0.0] * 10 + ([None] * 6 + [0.1]) * 30
    found = judged(places)
    assert all(found[:10])
    late = [good for x, good in zip(places[60:], found[60:], strict=True) if x is not None]
    assert not any(late)
    found = judged([0.0] * 10 + [None] * 100 + [0.1] * 40)
    assert not any(found[110:122]) and all(found[123:])


def test_most_of_the_last_single_points_refused_withhold_the_others():
    """A source that was moved: some points pass by chance, however far apart they are in time."""
    assert all(judged([0.0] * 10 + [None] + [0.1] * 10, step_s=1.0)[11:])
    found = judged([0.0] * 12 + ([None] * 3 + [0.1]) * 10, step_s=1.0)
    assert all(found[:12]) and not any(found[23::4])
    assert all(judged([None] * 12 + [0.1] * 20, step_s=1.0)[18:]), 'given again after as many'


def test_a_leap_waits_for_three_frames_and_a_jerk_too():
    found = judged([0.0] * 10 + [0.2] * 10)
    assert found == [True] * 10 + [False, False] + [True] * 8
    smooth = [0.5 * 20.0 * (0.02 * i) ** 2 for i in range(6)]
    assert all(judged(smooth))
    jerk = [0.0, 0.0, 0.0, 0.030, 0.060]
    assert judged(jerk) == [True, True, True, False, False], 'below 2 m/s, above 40 m/s^2'
    assert all(judged(jerk, ToolSettings(max_acceleration_m_s2=200.0)))


@pytest.mark.parametrize('run', [1, 5])
def test_what_jumps_there_and_back_gets_no_pose_though_each_place_is_good(run):
    """A place out of reach, for a frame or confirmed by the next ones, three times within 2 s."""
    one, times = Continuity(), []
    for i in range(60):
        x = 0.2 * (i > 20 and (i - 20) // run % 2)
        stamp = round((1 + i) * 0.04e9)
        one.judge(stamp, Place(stamp, (x, 0.0, 0.0), 1e-4), False, HANDS)
        times.append(bool(one.alternates))
    first = times.index(True)
    assert first <= 21 + 4 * run + 1 and all(times[first:])
    for i in range(61, 120):
        stamp = round((1 + i) * 0.04e9)
        one.judge(stamp, Place(stamp, (x, 0.0, 0.0), 1e-4), False, HANDS)
    assert not one.alternates


@pytest.mark.parametrize('rows', [(0, 1), (2,)])
def test_a_tool_that_turns_over_in_a_frame_waits_as_one_that_jumps(rng, rows):
    tool, seen = TOOL.select(list(rows)), []
    tracker, still = Tracker(MODEL, tool), np.array([0.02, 0.01, 0.15])
    over = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    for i in range(1, 40):
        turn = over if i == 30 else np.eye(3)
        place = still + (np.eye(3) - turn) @ tool.position[0]  # the coil stays
        flux = fluxes(MODEL, tool, place, turn, rng)
        seen.append({e.state for e in tracker.update(i * STEP_NS, tool.channel, flux)})
    assert seen[29] == {'unconfirmed'} and {'ok'} in seen[30:33], seen


# The model ------------------------------------------------------------------------------


@pytest.mark.parametrize(('factor', 'learns'), [(0.98, False), (1.01, False), (0.8, True)])
def test_a_model_of_other_moments_gives_no_pose(rng, factor, learns):
    """No emitter that warms up is a fifth stronger."""
    other = replace(MODEL, moments=factor * MODEL.moments)
    found = track_with(lambda i, seen: seen[i], rng, 60, model=other, learns=learns)
    last = {e.state for frame in found[20:] for e in frame.values()}
    assert 'ok' not in last
    assert last <= {'residual', 'inconsistent', 'model_doubtful', 'unconfirmed'}


# Stamps ---------------------------------------------------------------------------------


def test_the_stamp_s_error_is_part_of_the_covariance_along_the_motion(rng):
    sure, unsure = (
        Tracker(MODEL, TOOL, TrackerSettings(stamp_sigma_s=s, adaptive=False)) for s in (0.0, 2e-3)
    )
    places = []
    for stamp, position, rotation in path(20):
        places.append(position)
        flux = fluxes(MODEL, TOOL, position, rotation, rng)
        a, b = (
            {e.name: e for e in tracker.update(stamp, CHANNELS, flux)}
            for tracker in (sure, unsure)
        )
    velocity = (places[-1] - places[-2]) / 0.02
    more = (b['tool_a'].covariance - a['tool_a'].covariance)[:3, :3]
    expected = 2e-3**2 * np.outer(velocity, velocity)
    assert np.linalg.norm(more - expected) < 0.3 * np.linalg.norm(expected)
    turn = (b['tool_a'].covariance - a['tool_a'].covariance)[3:, 3:]
    assert np.trace(turn) > 0.0
    with pytest.raises(TrackingError, match='stamp_sigma_s'):
        TrackerSettings(stamp_sigma_s=-1.0)


def test_without_a_gate_nothing_is_withheld_for_what_it_contradicts(rng):
    tracker = Tracker(MODEL, TOOL, TrackerSettings(gate=np.inf))
    for stamp, position, rotation in path(5):
        flux = fluxes(MODEL, TOOL, position, rotation, rng)[[0, 1, 2, 3, 4, 8, 6, 7, 5]]
        found = tracker.update(stamp, CHANNELS, flux)
    assert {e.state for e in found} == {'ok'}
