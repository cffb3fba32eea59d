"""The tracker as a whole: states and their reasons, honest uncertainty, bad readings."""

import gc
import weakref
from dataclasses import replace

import numpy as np
import pytest
from tracked_tool import CHANNELS, MODEL, STEP_NS, TOOL, one_frame, path
from tracking_world import NOISE_T, anser_board, fluxes, random_pose, triaxial_tool

from anser_ros import pose_states as states
from anser_ros.field.nominal import nominal_model
from anser_ros.metal.body import sphere_polarisability
from anser_ros.physics.board import build_board
from anser_ros.physics.volume import TrackedVolume
from anser_ros.tracking.estimate import TrackerSettings
from anser_ros.tracking.tracker import Tracker

SEED = 51
EXACT = TrackerSettings(stamp_sigma_s=0.0)
"""Settings for stamps without an error, as this file's own have none."""


def run(tracker, count, rng, model=MODEL, noise_t=NOISE_T, seed=0):
    """Errors over sigma of sensors and body, and all states."""
    ratios = {name: [] for name in (*TOOL.name, 'tool_a')}
    seen = []
    for stamp, position, rotation in path(count, seed):
        flux = fluxes(model, TOOL, position, rotation, rng, noise_t)
        points, _ = TOOL.placed(position, rotation)
        truth = dict(zip(TOOL.name, points, strict=True)) | {'tool_a': position}
        for e in tracker.update(stamp, CHANNELS, flux):
            seen.append(e.state)
            if e.state == states.OK:
                ratios[e.name].append(
                    np.linalg.norm(e.position - truth[e.name]) / e.sigma_position_m
                )
    return ratios, seen


def test_errors_are_what_their_sigma_says(rng):
    """Issue: the 95th percentile of error over sigma lies between 1.3 and 2.3."""
    ratios, seen = run(Tracker(MODEL, TOOL, EXACT), 400, rng)
    assert set(seen) == {'ok'}
    for name, values in ratios.items():
        assert 1.3 < np.percentile(values, 95) < 2.3, name


def test_a_tracker_that_was_replaced_is_gone_at_once(rng):
    """No cycle keeps its tables of megabytes until the next collection of garbage."""
    gc.disable()
    try:
        tracker = Tracker(MODEL, TOOL, EXACT)
        run(tracker, 3, rng)
        old = weakref.ref(tracker)
        tracker = tracker.with_model(MODEL)
        assert old() is None
        last = weakref.ref(tracker)
        del tracker
        assert last() is None
    finally:
        gc.enable()


@pytest.mark.long
@pytest.mark.parametrize('noise_t', [20e-12, 100e-12])
def test_the_noise_is_learnt_from_residuals(rng, noise_t):
    tracker = Tracker(MODEL, TOOL, EXACT)
    run(tracker, 150, rng, noise_t=noise_t)
    ratios, seen = run(tracker.with_model(MODEL), 300, rng, noise_t=noise_t, seed=1)
    assert set(seen) == {'ok'}
    for name, values in ratios.items():
        assert 1.3 < np.percentile(values, 95) < 2.3, name


def test_a_board_that_differs_from_its_drawing(rng):
    """The nominal model's modes hold the truth's distance from it: sigmas stay honest."""
    model = nominal_model(anser_board())
    ratios = []
    for trial in range(40):
        xi = rng.normal(size=len(model.modes))
        real = replace(model, moments=model.moments + np.tensordot(xi, model.modes, 1))
        tracker = Tracker(model, TOOL)
        position, rotation = random_pose(rng)
        flux = fluxes(real, TOOL, position, rotation, rng)
        points, _ = TOOL.placed(position, rotation)
        truth = dict(zip(TOOL.name, points, strict=True)) | {'tool_a': position}
        for name, e in one_frame(tracker, flux, trial + 1).items():
            assert e.state in ('ok', 'ambiguous'), e.reason
            if e.state == 'ok':
                ratios.append(np.linalg.norm(e.position - truth[name]) / e.sigma_position_m)
    assert len(ratios) > 320
    assert 1.3 < np.percentile(ratios, 95) < 2.3


def test_finite_coils_are_not_points(rng):
    tool = triaxial_tool(length_m=0.01)
    position, rotation = random_pose(rng, 0.09, 0.12)
    flux = fluxes(MODEL, tool, position, rotation, rng)
    found = {e.name: e for e in Tracker(MODEL, tool).update(1, CHANNELS, flux)}
    assert {e.state for e in found.values()} == {'ok'}
    assert np.linalg.norm(found['tool_a'].position - position) < 1e-4


def test_every_state_has_its_reason(rng):
    tracker = Tracker(MODEL, TOOL)
    flux = fluxes(MODEL, TOOL, *random_pose(rng), rng)
    flux[0] = np.nan
    flux[1, 3] = np.inf
    flux[2] = NOISE_T * rng.normal(size=8)
    flux[3, 4] *= 1.2
    found = one_frame(tracker, flux, flags=np.array([0, 0, 0, 0, 1, 2, 4, 3, 0]))
    assert [found[name].state for name in TOOL.name] == [
        states.NO_SIGNAL, states.NO_SIGNAL, states.NO_SIGNAL, states.RESIDUAL, states.SATURATED,
        states.STALE, states.DROPPED, states.SATURATED, states.OK,
    ]  # fmt: skip
    for name in TOOL.name[:-1]:
        assert found[name].reason
    assert found[TOOL.name[-1]].reason == ''
    assert np.isnan(found[TOOL.name[0]].position).all()
    assert {e.state for e in found.values()} <= set(states.STATES)


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('silence', [0.0, np.nan, np.inf])
def test_a_dead_emitter_is_named_and_the_others_go_on(rng, silence):
    """Two may die of eight; covariances grow; one more, and there is no signal."""
    uncertain = nominal_model(anser_board())
    for model, rough in (
        (MODEL, set()), (uncertain, {states.AMBIGUOUS, states.UNCONFIRMED}),
    ):  # fmt: skip
        tracker = Tracker(model, TOOL)
        whole, part = [], []
        for i, (stamp, position, rotation) in enumerate(path(40)):
            flux = fluxes(model, TOOL, position, rotation, rng)
            dead = [(), (), (2,), (2, 5)][i // 10]
            flux[:, list(dead)] = silence
            found = one_frame(tracker, flux, stamp)
            # A rough model may leave a single coil ambiguous.
            assert {e.state for e in found.values()} <= ({'ok'} | rough)
            assert found['tool_a'].state == 'ok'
            assert tracker.dead_emitters == tuple(f'coil{k}' for k in dead)
            away = np.linalg.norm(found['tool_a'].position - position)
            assert away < 5.0 * found['tool_a'].sigma_position_m
            (part if dead else whole).append([e.sigma_position_m for e in found.values()])
        assert (np.mean(part, axis=0) > np.mean(whole, axis=0)).all()
        assert tracker.counters['frames_dead_emitter'] == 20
        assert rough or tracker.counters['cold_starts'] == 9, 'warm through all of it'
    flux[:, 0] = silence
    found = one_frame(tracker, flux, 41 * STEP_NS)
    assert {e.state for e in found.values()} == {states.NO_SIGNAL}
    assert 'coil0, coil2, coil5; 5 emitters are left, 6 needed' in found['tool_a'].reason


def test_the_error_of_the_model_is_that_of_the_living_emitters(rng):
    """A tool at rest goes on from what it knew; emitter 2 alone is uncertain."""
    modes = np.zeros((1, *MODEL.moments.shape), complex)
    modes[0, :, 2] = 0.01 * MODEL.moments[:, 2]
    model, settings = replace(MODEL, modes=modes), replace(EXACT, adaptive=False)
    ((_, *pose),) = path(1)
    flux, sigmas = [fluxes(model, TOOL, *pose, rng) for _ in range(4)], []
    for course in ((2, 2, 2, 5), (5, 5, 5, 5)):
        tracker = Tracker(model, TOOL, settings)
        for i, dead in enumerate(course):
            silent = np.arange(8) == dead
            found = one_frame(tracker, np.where(silent, 0.0, flux[i]), (i + 1) * STEP_NS)
        sigmas.append([e.sigma_position_m for e in found.values()])
    np.testing.assert_allclose(sigmas[0], sigmas[1], rtol=0.01)


def test_a_cold_start_and_a_model_swap_with_a_dead_emitter(rng):
    tracker = Tracker(MODEL, TOOL)
    for i in range(5):
        position, rotation = random_pose(rng)
        flux = fluxes(MODEL, TOOL, position, rotation, rng)
        flux[:, 3] = 0.0
        found = one_frame(tracker, flux, (i + 1) * 10**10)
        assert np.linalg.norm(found['tool_a'].position - position) < 5e-4
        tracker = tracker.with_model(replace(MODEL, moments=MODEL.moments * (1 + 1e-9 * i)))
    assert tracker.counters['cold_starts'] == 45


@pytest.mark.filterwarnings('error')
def test_what_is_not_used_is_counted_by_its_kind(rng):
    tracker = Tracker(MODEL, TOOL)
    flux = fluxes(MODEL, TOOL, *random_pose(rng), rng)
    flux[0, 1], flux[1, 2], flux[2, 3] = np.nan, complex(1.0, np.inf), 1e30
    marks = np.array([0, 0, 0, 1, 2, 4, 0, 0])
    tracker.update(STEP_NS, CHANNELS[:8], flux[:8], flags=marks)
    nothing = np.zeros(0, dtype=int)
    found = tracker.update(2 * STEP_NS, nothing, flux[:0])
    assert {e.state for e in found} == {states.STALE}
    one_frame(tracker, flux, 10**10)
    kinds = ('not_finite', 'absurd', 'saturated', 'stale', 'dropped', 'missing')
    assert [tracker.counters[f'readings_{kind}'] for kind in kinds] == [4, 2, 1, 1, 1, 10]
    assert tracker.counters['frames_empty'] == 1
    assert tracker.counters['time_jumps_forward'] == 1
    assert tracker.counters['time_jumps'] == 0


def test_outside_the_volume(rng):
    settings = TrackerSettings(volume=TrackedVolume((-0.1, -0.1, 0.08), (0.1, 0.1, 0.2)))
    flux = fluxes(MODEL, TOOL, np.array([0.0, 0.0, 0.255]), np.eye(3), rng)
    found = one_frame(Tracker(MODEL, TOOL, settings), flux)
    assert found['tool_a/1/x'].state == states.OUTSIDE_VOLUME
    assert 'mm' in found['tool_a/1/x'].reason
    assert found['tool_a'].state == states.OUTSIDE_VOLUME


def three_coil_model():
    board = build_board(
        'circular_loop', {'radius_m': 0.06, 'turns': 60}, ['a', 'b', 'c'],
        np.array([[-0.1, 0, 0], [0.1, 0, 0], [0, 0.12, 0]]), np.zeros(3), [1e3, 2e3, 3e3],
    )  # fmt: skip
    model = nominal_model(board)
    return replace(model, modes=None)


def test_three_emitters_single_coils_are_ambiguous_and_the_tool_is_tracked(rng):
    model = three_coil_model()
    tracker = Tracker(model, TOOL)
    position, rotation = random_pose(rng, 0.12, 0.18)
    for stamp in (1, 2):
        flux = fluxes(model, TOOL, position, rotation, rng)
        found = {e.name: e for e in tracker.update(stamp, CHANNELS, flux)}
        assert all(found[name].state != 'ok' for name in TOOL.name)
        assert any(found[name].state == states.AMBIGUOUS for name in TOOL.name)
    assert found['tool_a'].state == states.OK
    assert np.linalg.norm(found['tool_a'].position - position) < 1e-5


def metal_near(model, position):
    """The model with a copper ball, one polarisability for all emitters."""
    at = np.array(position)[None]
    axes = np.eye(3)
    field = np.stack([model.flux(at, a[None])[0] for a in axes], axis=1)[None]
    alpha = sphere_polarisability(0.03, 5.8e7, 1.0, 2 * np.pi * np.array(model.frequencies_hz))
    moments = alpha[None, :, None] * field
    return model.with_dipoles(np.repeat(at, 3, axis=0), axes, moments[0].T.copy())


def test_metal_is_noticed_and_its_model_is_believed(rng):
    bent = metal_near(MODEL, (0.05, 0.0, 0.05))
    position, rotation = np.array([0.02, 0.02, 0.14]), np.eye(3)
    clean = Tracker(MODEL, TOOL)
    assert one_frame(clean, fluxes(MODEL, TOOL, position, rotation, rng))['tool_a'].state == 'ok'
    flux = fluxes(bent, TOOL, position, rotation, rng)
    found = one_frame(clean, flux, 2 * STEP_NS)
    assert found['tool_a'].state == states.RESIDUAL
    assert 'times the expected one' in found['tool_a'].reason
    for i in range(3, 3 + 50):
        flux = fluxes(bent, TOOL, position, rotation, rng)
        informed = one_frame(clean.with_model(bent), flux, i * STEP_NS)
    assert informed['tool_a'].state == 'ok'
    assert np.linalg.norm(informed['tool_a'].position - position) < 1e-4


def test_nothing_among_the_dipoles_that_stand_for_metal_has_a_pose(rng):
    """Neither coils that have just come there from elsewhere, nor their body."""
    side = np.arange(-0.1, 0.101, 0.02)
    places = np.stack([v.ravel() for v in np.meshgrid(side, side, [0.17])], axis=-1)
    upright, none = np.tile([0.0, 0.0, 1.0], (len(places), 1)), np.zeros((len(places), 8))
    model = MODEL.with_dipoles(places, upright, none.astype(complex))
    modes = np.zeros((1, *model.moments.shape), dtype=complex)
    modes[:, -len(places) :] = 1e-9
    tracker, lying = Tracker(replace(model, modes=modes), TOOL), np.eye(3)[[1, 2, 0]]
    for i in range(1, 30):
        position = np.array([0.0, 0.0, 0.145 if i < 20 else 0.163])
        flux = fluxes(MODEL, TOOL, position, lying, rng)
        found = one_frame(tracker, flux, 2 * i * STEP_NS)
        expected = states.OK if i < 20 else states.AMBIGUOUS
        assert {e.state for e in found.values()} == {expected}, i


def test_a_long_distortion_costs_few_scans_and_ends_in_less_than_a_second(rng):
    tracker = Tracker(MODEL, TOOL)
    bent = metal_near(MODEL, (0.05, 0.0, 0.04))
    for stamp, position, rotation in path(200):
        model = bent if 20 * STEP_NS < stamp <= 140 * STEP_NS else MODEL
        found = one_frame(tracker, fluxes(model, TOOL, position, rotation, rng), stamp)
        if stamp <= 20 * STEP_NS or stamp > 189 * STEP_NS:
            assert {e.state for e in found.values()} == {'ok'}, stamp
    assert tracker.counters['cold_starts'] < 0.2 * 120 * 9


def test_one_bad_coil_does_not_stop_the_tool_and_is_used_again_once_it_recovers(rng):
    tracker = Tracker(MODEL, TOOL)
    for stamp, position, rotation in path(90):
        flux = fluxes(MODEL, TOOL, position, rotation, rng)
        if is_bad := stamp <= 20 * STEP_NS:
            flux[4] *= -1.0
        found = one_frame(tracker, flux, stamp)
        assert found['tool_a'].state == 'ok'
        assert not is_bad or found['tool_a'].reason == '1 of 9 coils left out'
        assert np.linalg.norm(found['tool_a'].position - position) < 2e-4
    assert found['tool_a'].reason == ''


def test_bodies_without_two_directions_get_no_pose(rng):
    lone = TOOL.select([2, 5, 8])
    tracker = Tracker(MODEL, lone)
    assert tracker.bodies == ()
    found = tracker.update(1, lone.channel, fluxes(MODEL, lone, *random_pose(rng), rng))
    assert [e.name for e in found] == list(lone.name)


def test_two_bodies_are_tracked_side_by_side(rng):
    other = triaxial_tool('tool_b', first=20)
    both = TOOL.joined(other)
    first, second = random_pose(rng), random_pose(rng)
    flux = np.concatenate([fluxes(MODEL, TOOL, *first, rng), fluxes(MODEL, other, *second, rng)])
    found = {e.name: e for e in Tracker(MODEL, both).update(1, both.channel, flux)}
    assert np.linalg.norm(found['tool_a'].position - first[0]) < 2e-4
    assert np.linalg.norm(found['tool_b'].position - second[0]) < 2e-4
