"""The tracker as time goes on: jumps, models and settings that change, and what is refused."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from tracked_tool import CHANNELS, MODEL, STEP_NS, TOOL, one_frame
from tracking_world import NOISE_T, fluxes, random_pose

from anser_ros import pose_states as states
from anser_ros.errors import TrackingError
from anser_ros.field.model import EffectRecord, OpenArm, from_document, to_document
from anser_ros.tracking.estimate import (
    FRESH_NOISE,
    NO_GATE,
    TrackerSettings,
    add_frame,
    scale_of_frame,
    sigma_factor,
)
from anser_ros.tracking.tracker import Tracker

SEED = 51


def test_duplicates_jumps_and_gaps(rng):
    tracker = Tracker(MODEL, TOOL)
    place = random_pose(rng)

    def flux():
        return fluxes(MODEL, TOOL, *place, rng)

    assert one_frame(tracker, flux(), 10**12)
    assert tracker.update(10**12, CHANNELS, flux()) == []
    assert tracker.counters['duplicates'] == 1
    assert tracker.counters['cold_starts'] == 9
    one_frame(tracker, flux(), 10**12 + STEP_NS)
    assert tracker.counters['cold_starts'] == 9, 'warm'
    one_frame(tracker, flux(), 10**12 + 5 * 10**9)
    assert tracker.counters['cold_starts'] == 18, 'the last good pose is too old'
    one_frame(tracker, flux(), 10**9)
    assert tracker.counters['time_jumps'] == 1
    assert tracker.counters['cold_starts'] == 27, 'a jump back forgets'
    tracker.reset()
    one_frame(tracker, flux(), 10**9 + STEP_NS)
    assert tracker.counters['cold_starts'] == 36


def test_a_tool_that_leaps_between_frames_is_found_every_time(rng):
    """A robot's raster leaps from point to point in a second: the last pose is no start."""
    tracker = Tracker(MODEL, TOOL)
    for i in range(40):
        position, rotation = random_pose(rng)
        found = one_frame(tracker, fluxes(MODEL, TOOL, position, rotation, rng), (i + 1) * 10**9)
        assert {e.state for e in found.values()} == {'ok'}, i
        assert np.linalg.norm(found['tool_a'].position - position) < 3e-4


def test_only_good_poses_start_the_next_frame(rng):
    """A tool that jumps while it can't be seen is found again, not followed into a false place."""
    tracker = Tracker(MODEL, TOOL)
    here, there = random_pose(rng), random_pose(rng)
    one_frame(tracker, fluxes(MODEL, TOOL, *here, rng), 1 * STEP_NS)
    broken = fluxes(MODEL, TOOL, *here, rng)
    broken[:, 2:6] *= [1.5, 0.6, 1.4, 0.7]
    found = one_frame(tracker, broken, 2 * STEP_NS)
    assert not any(e.state == states.OK for e in found.values())
    for i in range(3, 3 + 50):
        found = one_frame(tracker, fluxes(MODEL, TOOL, *there, rng), i * STEP_NS)
        assert i > 3 or not any(e.state == states.OK for e in found.values()), 'one is not enough'
    assert all(e.state == states.OK for e in found.values())
    assert np.linalg.norm(found['tool_a'].position - there[0]) < 2e-4


def test_swapping_models_keeps_the_warm_starts(rng):
    tracker = Tracker(MODEL, TOOL)
    position, rotation = random_pose(rng)
    one_frame(tracker, fluxes(MODEL, TOOL, position, rotation, rng))
    other = replace(MODEL, moments=1.001 * MODEL.moments)
    swapped = tracker.with_model(other, 'second')
    found = one_frame(swapped, fluxes(other, TOOL, position, rotation, rng), 2 * STEP_NS)
    assert {e.model_id for e in found.values()} == {'second'}
    assert {e.state for e in found.values()} == {'ok'}
    assert swapped.counters['cold_starts'] == 9
    assert swapped.model is other
    assert tracker.model is MODEL
    far = tracker.with_model(replace(MODEL, moments=0.5 * MODEL.moments))
    assert far._scene.context.grid is not tracker._scene.context.grid, (
        'another field needs another grid'
    )
    assert swapped._scene.context.grid is tracker._scene.context.grid


def test_settings_may_change_on_the_way(rng):
    tracker = Tracker(MODEL, TOOL)
    place = random_pose(rng)
    one_frame(tracker, fluxes(MODEL, TOOL, *place, rng))
    strict = tracker.with_settings(TrackerSettings(gate=0.01))
    found = one_frame(strict, fluxes(MODEL, TOOL, *place, rng), 2 * STEP_NS)
    assert {e.state for e in found.values()} == {'residual'}
    assert Tracker(None, TOOL).with_settings(TrackerSettings(gate=2.0)).settings.gate == 2.0


def test_effects_of_the_model_are_undone(rng):
    record = EffectRecord('sensor_gain', {'channel': 3, 'gain': 0.97, 'phase_deg': 1.0})
    informed = replace(MODEL, effects=(record,))
    position, rotation = random_pose(rng)
    flux = fluxes(MODEL, TOOL, position, rotation, rng)
    flux[3] *= 0.97 * np.exp(1j * math.radians(1.0))
    plain = one_frame(Tracker(MODEL, TOOL), flux)[TOOL.name[3]]
    sound = one_frame(Tracker(informed, TOOL), flux)[TOOL.name[3]]
    point = TOOL.placed(position, rotation)[0][3]
    assert plain.state == states.RESIDUAL
    assert sound.state == states.OK
    assert np.linalg.norm(sound.position - point) < 1e-3


def test_what_a_correction_makes_absurd_is_no_signal(rng):
    """A model may be wrong too: a gain of next to nothing makes fluxes of thousands of tesla."""
    record = EffectRecord('sensor_gain', {'channel': 3, 'gain': 1e-12, 'phase_deg': 0.0})
    flux = fluxes(MODEL, TOOL, *random_pose(rng), rng)
    tracker = Tracker(replace(MODEL, effects=(record,)), TOOL)
    found = one_frame(tracker, flux)
    assert found[TOOL.name[3]].state == states.NO_SIGNAL
    assert 'implausible' in found[TOOL.name[3]].reason
    assert tracker.counters['readings_absurd'] == 1
    assert found['tool_a'].state == states.OK


def test_a_shift_of_the_whole_field_is_in_every_sigma_and_refuses_no_pose(rng):
    flux = fluxes(MODEL, TOOL, *random_pose(rng), rng)
    sure, shifted = (
        one_frame(Tracker(model, TOOL), flux, 10**12)
        for model in (MODEL, replace(MODEL, shift_sigma_m=7e-3))
    )
    for name, one in shifted.items():
        assert one.state == 'ok'
        assert np.allclose(one.covariance - sure[name].covariance, np.diag([49e-6] * 3 + [0] * 3))
        assert one.sigma_position_m == pytest.approx(np.sqrt(np.trace(one.covariance[:3, :3])))


def test_a_lever_arm_that_no_turn_told_counts_where_the_tool_is_turned_otherwise(rng):
    position, rotation = random_pose(rng)
    flux, half = fluxes(MODEL, TOOL, position, rotation, rng), np.diag([-1.0, -1.0, 1.0])
    sigma, about_z = {}, np.diag([0.5, 0.5, 1.0])  # the mean of turns about z alone
    ways = ('alike', rotation), ('turned', rotation @ half), ('axis', rotation @ half @ about_z)
    for name, scanned in ways:
        arm = OpenArm(4e-3, scanned, 0.02)
        model = replace(MODEL, shift_sigma_m=5e-3, open_arms={'tool_a': arm})
        model = model.turned(np.eye(3), np.zeros(3))
        again = from_document(to_document(model))
        found = one_frame(Tracker(again, TOOL), flux, 10**12)
        sigma[name] = [found[one].sigma_position_m ** 2 for one in ('tool_a', TOOL.name[0])]
        turned = model.shift_covariance('tool_a', rotation)[3:, 3:].trace()
        assert turned == pytest.approx(2 * 0.04**2 if name == 'turned' else 0.0, abs=1e-9)
    # Beside the arm 3 mm are open along each axis; half a turn moves two of them by twice the arm.
    assert np.allclose(sigma['alike'], 27e-6, atol=1e-6)
    assert np.allclose(sigma['turned'], 27e-6 + 2 * 64e-6, atol=1e-6)


def test_the_gate_is_where_the_settings_say(rng):
    """Noise three times as large as it is taken to be misses a gate that is a little smaller."""
    position, rotation = random_pose(rng)
    flux = fluxes(MODEL, TOOL, position, rotation, rng, 3 * NOISE_T)
    coils, rest = range(len(TOOL)), TrackerSettings(adaptive=False, gate=100.0)
    misfit = {name: e.chi2 for name, e in one_frame(Tracker(MODEL, TOOL, rest), flux).items()}
    assert misfit['tool_a'] == pytest.approx(9.0, rel=0.3)
    for i in coils:
        gate = math.sqrt(misfit[TOOL.name[i]])
        for factor, withheld in ((1.01, False), (0.99, True)):
            tracker = Tracker(MODEL, TOOL, replace(rest, gate=factor * gate))
            # Its body may have missed the gate.
            state = one_frame(tracker, flux)[TOOL.name[i]].state
            assert (state == states.RESIDUAL) == withheld
    # A body first does without the coils that disagree most, so it falls a little later.
    for gate, state in ((1.01, states.OK), (0.6, states.RESIDUAL)):
        tracker = Tracker(MODEL, TOOL, replace(rest, gate=gate * math.sqrt(misfit['tool_a'])))
        assert one_frame(tracker, flux)['tool_a'].state == state


def test_unexplained_flux_widens_sigma(rng):
    flux = fluxes(MODEL, TOOL, *random_pose(rng), rng)
    settings = TrackerSettings(adaptive=False)
    sure = one_frame(Tracker(MODEL, TOOL, settings), flux)['tool_a']
    unsure = one_frame(Tracker(replace(MODEL, flux_error_t=120e-12), TOOL, settings), flux)
    expected = sure.sigma_position_m * math.hypot(120, 60) / 60
    assert unsure['tool_a'].sigma_position_m == pytest.approx(expected, rel=1e-3)


def test_sensors_and_settings_that_are_none_are_refused():
    with pytest.raises(TrackingError, match='no tool sensor'):
        Tracker(MODEL, TOOL.select(np.zeros(0, int)))
    with pytest.raises(TrackingError, match='channel appears twice'):
        Tracker(MODEL, replace(TOOL, channel=np.zeros(9, int)))
    with pytest.raises(TrackingError, match='name appears twice'):
        Tracker(MODEL, replace(TOOL, name=('a',) * 9))
    with pytest.raises(TrackingError, match='positive stamp'):
        Tracker(MODEL, TOOL).update(0, CHANNELS, np.ones((9, 8), complex))
    for name in ('flux_noise_t', 'grid_spacing_m', 'gate', 'max_sigma_m', 'warm_age_s'):
        with pytest.raises(TrackingError, match=name):
            TrackerSettings(**{name: 0.0})
    with pytest.raises(TrackingError, match='odds'):
        TrackerSettings(odds=0.5)


@pytest.mark.parametrize('gate', [NO_GATE, math.inf])
def test_no_gate_is_the_same_however_it_is_said(gate):
    """The node's largest gate refuses no more than the infinite one of a command line does."""
    settings = TrackerSettings(gate=gate)
    assert not settings.has_gate and sigma_factor.py_func(settings.has_gate, 9.0) == 3.0
    assert settings.margin(400.0) == -math.inf, 'the best of poses that all fit badly is taken'
    assert TrackerSettings(gate=NO_GATE / 2).margin(400.0) > 0.0


def test_three_sigma_hold_where_no_gate_refuses_a_wrong_gain(rng):
    tracker, wrong = Tracker(MODEL, TOOL, TrackerSettings(gate=NO_GATE)), 0
    for frame in range(60):
        position, rotation = random_pose(rng)
        flux = fluxes(MODEL, TOOL, position, rotation, rng)
        coil = frame % 9
        flux[coil, slice(None) if frame % 2 else frame % 8] *= 1.05
        found = one_frame(tracker, flux, (frame + 1) * 10**9)
        one, truth = found[TOOL.name[coil]], position + rotation @ TOOL.position[coil]
        if one.state == states.OK:
            error = float(np.linalg.norm(one.position - truth))
            wrong += error > max(3.0 * one.sigma_position_m, 1e-3)
    assert wrong == 0


def test_hostile_fluxes_never_make_a_pose(rng):
    tracker = Tracker(MODEL, TOOL)
    for i in range(60):
        size = 10.0 ** rng.uniform(-13, 300 if i % 3 == 0 else 0)
        flux = size * (rng.normal(size=(9, 8)) + 1j * rng.normal(size=(9, 8)))
        flux[rng.random((9, 8)) < 0.1] = rng.choice([0.0, np.nan, np.inf, 1e-300])
        found = one_frame(tracker, flux, (i + 1) * STEP_NS)
        assert all(e.state != 'ok' for e in found.values()), size


def test_a_misfit_that_lasts_from_frame_to_frame_is_no_noise(rng):
    scales, last = np.tile(FRESH_NOISE, (3, 1)), np.zeros((3, 16))
    misfit = np.sqrt(11.0 / 16.0) * rng.choice([-1.0, 1.0], 16)
    for _ in range(1000):
        noise = np.sqrt(11.0 / 16.0) * rng.normal(size=16)
        white = np.stack([2.0 * noise, noise + np.sqrt(3.0) * misfit, 0.5 * misfit])
        lasting = (last * white).sum(axis=1) / 11
        for scale, ratio, product in zip(scales, (4.0, 4.0, 0.9), lasting, strict=True):
            add_frame.py_func(scale, ratio, product)
        last = white
    noisy, wrong, among_metal = (partial(scale_of_frame.py_func, scale) for scale in scales)
    usual = 17.3 / 11.0, np.inf
    assert noisy(4.0, usual, 2.2, 0.0, False) == pytest.approx(4.0, rel=0.01)
    for ratio in (1.0, 4.0):  # what the frames before had, this one has too
        assert wrong(ratio, usual, 2.2, 0.0, False) > 10.0
    stated = among_metal(0.9, usual, 2.2, 0.25, True)
    assert stated == pytest.approx(1.0 + 0.25 * 3.0, rel=1e-6), 'the model states it'
