"""References that fail, repeat themselves, jump together or cannot be read, and the refit."""

import numpy as np
import pytest
from refit_world import HEAD, STEP_NS, anser_world, run, share_left

from anser_ros.pose_states import REFERENCES_DOUBTFUL
from anser_ros.refit.health import ReferenceWatch
from anser_ros.refit.live_refit import LiveRefit

# The refit that all share takes some five seconds to work out.
pytestmark = [pytest.mark.usefixtures('shared_tables'), pytest.mark.long]


FAULTS = {
    'dead': lambda flux: flux.__setitem__(5, 0.0),
    'turned round': lambda flux: flux.__setitem__(5, -flux[5]),
    'gain': lambda flux: flux.__setitem__(5, 0.9 * flux[5]),
    'unplugged': lambda flux: flux.__setitem__(
        slice(6), anser_world().noise(np.random.default_rng(3))[:6]
    ),
}
"""Of one reference, and of a whole plug."""


@pytest.mark.parametrize('fault', FAULTS)
@pytest.mark.parametrize('metal', [False, True])
def test_references_that_fail_are_named_and_left_out(refit, fault, metal):
    world = anser_world()
    change = world.metal(HEAD) if metal else 0.0
    run(refit, world, change)
    result = run(refit, world, change, frames=1, start=10, fault=FAULTS[fault])
    names = tuple(world.references.name[:6]) if fault == 'unplugged' else ('ref/5',)
    assert result.left_out == names
    states = {health.state for health in result.references if health.name in names}
    assert states == {'silent' if fault in ('dead', 'unplugged') else 'disagrees'}
    if metal:
        assert share_left(world, result.model, HEAD) < (0.1 if len(names) > 1 else 0.03)
    else:
        assert result.model is world.model


@pytest.mark.parametrize('times', [1.8, 3.0])
def test_noise_above_what_the_setup_states_is_nobodys_fault(refit, times):
    world, rng = anser_world(), np.random.default_rng(5)
    for frame in range(1, 40):
        flux = world.baseline + times * world.noise(rng)
        result = refit.update(frame * STEP_NS, world.references.channel, flux)
        assert result.left_out == () and not result.withheld, frame


def test_two_that_fail_together_do_not_hide_each_other(refit):
    world = anser_world()

    def swap(flux):
        flux[[3, 11]] = flux[[11, 3]]

    result = run(refit, world, world.metal(HEAD), frames=1, fault=swap)
    assert result.left_out == ('ref/3', 'ref/11')
    assert share_left(world, result.model, HEAD) < 0.03


def test_one_that_works_again_comes_back_after_a_while(refit):
    world = anser_world()
    run(refit, world, 0.0, fault=FAULTS['dead'])
    hold = refit.settings.hold_frames
    result = run(refit, world, 0.0, frames=hold - 1, start=10)
    assert result.left_out == ('ref/5',)
    result = run(refit, world, 0.0, frames=3, start=100)
    assert result.left_out == ()


@pytest.mark.parametrize(
    ('rate_hz', 'frames'), [(100.0, 25), (50.0, 25), (25.0, 13), (10.0, 12), (1.0, 25)]
)
def test_slow_streams_wait_for_half_a_second_at_most_for_one_that_works_again(rate_hz, frames):
    watch, stamp_ns, good = ReferenceWatch(3, 25), 1, np.array([True, False, True])
    for _ in range(5):
        stamp_ns += round(1e9 / rate_hz)
        watch.note(good, ['ok', 'silent', 'ok'], 0, stamp_ns)
    for count in range(frames):
        assert watch.excluded[1], count
        # A frame that is lost, or a pause, does not change the rate.
        stamp_ns += round((3.0 if count == 5 else 1.0) * 1e9 / rate_hz)
        watch.note(good | True, ['ok'] * 3, 0, stamp_ns)
        watch.agreed(1, True)
        watch.readmit()
    assert not watch.excluded[1]


@pytest.mark.parametrize('reason', ['flagged', 'not finite', 'missing', 'absurd'])
def test_what_can_not_be_read_is_left_out_with_its_reason(refit, reason):
    world, rng = anser_world(), np.random.default_rng(2)
    flux = world.baseline + world.metal(HEAD) + world.noise(rng)
    flags = np.zeros(len(flux), dtype=int)
    channels = world.references.channel
    if reason == 'flagged':
        flags[2], flux[2] = 1, 3e-6
    elif reason == 'not finite':
        flux[2, 3] = np.nan
    elif reason == 'absurd':
        flux[2] = 1e30
    else:
        keep = np.arange(len(flux)) != 2
        flux, flags, channels = flux[keep], flags[keep], channels[keep]
    result = refit.update(STEP_NS, channels, flux, flags)
    assert result.left_out == ('ref/2',)
    assert result.references[2].state == reason
    assert np.isnan(result.references[2].residual_t)
    assert share_left(world, result.model, HEAD) < 0.03


def test_too_few_references_mean_the_calibrated_model_and_say_so(refit):
    world = anser_world()
    run(refit, world, world.metal(HEAD))
    few = world.references.channel[:3]
    result = refit.update(10 * STEP_NS, few, world.baseline[:3])
    assert result.state == 'few_references'
    assert result.model is world.model
    assert '3 usable' in result.reason
    assert result.left_out == world.references.name[3:]


@pytest.mark.long
def test_a_reference_without_a_baseline_takes_no_part():
    world = anser_world()
    baseline = world.baseline.copy()
    baseline[7, 2] = np.nan
    refit = LiveRefit(world.model, world.references, baseline, drawing=world.board.field)
    result = run(refit, world, world.metal(HEAD))
    assert result.references[7].state == 'no baseline'
    assert share_left(world, result.model, HEAD) < 0.03


def group_of(world, count, seed=4):
    return np.random.default_rng(seed).permutation(len(world.references))[:count]


@pytest.mark.parametrize('near', [False, True])
@pytest.mark.parametrize(
    ('count', 'gain', 'state'),
    [(5, 1.03, ''), (12, 1.02, 'references_doubtful'), (16, 1.05, 'references_doubtful')],
)
def test_references_that_go_wrong_together_are_left_out_or_doubted(
    refit, near, count, gain, state
):
    world = anser_world()
    change, group = world.metal(HEAD) if near else 0.0, group_of(world, count)
    run(refit, world, change, frames=5)

    def fault(flux):
        flux[group] *= gain

    result = run(refit, world, change, seed=2, start=6, frames=4, fault=fault)
    assert result.withheld == state and result.is_answer == (not state)
    if not state:
        assert set(result.left_out) == {world.references.name[i] for i in group}
    result = run(refit, world, change, seed=3, start=10, frames=2)
    assert result.left_out, 'what has jumped back is watched for a while'
    result = run(refit, world, change, seed=3, start=12, frames=60)
    assert result.withheld == '' and result.left_out == ()


ALL, PART, MOST = slice(None), list(range(6)), list(range(3, 15))
"""Of 16 references."""


SLIDES = [(step_m, emitter, ALL) for step_m in (0.0, 2e-5, 1e-4) for emitter in (None, 3)]


@pytest.mark.parametrize(
    ('step_m', 'emitter', 'part'), [*SLIDES, (2e-5, None, PART), (2e-5, None, MOST)]
)
@pytest.mark.parametrize('near', [False, True])
def test_references_that_slide_as_one_or_an_emitter_are_no_metal(
    refit, near, step_m, emitter, part
):
    """They slide by 1 and 5 mm a second, and back: by less than their survey's error a frame."""
    world, rng = anser_world(), np.random.default_rng(5)
    table, metal = world.references, world.metal(HEAD) if near else 0.0
    results, away = [], step_m * np.minimum(np.arange(161), np.arange(140, -21, -1).clip(0, 70))
    still = world.model.flux(table.position, table.axis, table.length)
    for frame, far_m in enumerate(away[1:].tolist(), start=1):
        moved = table.position + far_m * np.array([0.6, 0.0, 0.8])
        change = world.model.flux(moved, table.axis, table.length) - still
        if emitter is not None:
            change[:, np.arange(change.shape[1]) != emitter] = 0.0
        flux = world.baseline + metal + world.noise(rng)
        flux[part] += change[part]
        results.append(refit.update(frame * STEP_NS, table.channel, flux))
        assert results[-1].withheld or far_m < 1.1e-3, frame
    assert not results[-1].withheld, 'they are back'
    assert {result.withheld for result in results[55:80]} == {'other_place' if step_m else ''}
    if part is ALL:
        assert ('by up to 1.3 mm' in results[69].reason) == (step_m == 2e-5)
    elif part is PART and not near:  # beside metal an emitter may be named
        assert '6 of 16 references have moved' in results[69].reason
    if step_m and emitter is not None:
        assert f'emitter {world.model.emitters[emitter]} has moved' in results[69].reason


@pytest.mark.parametrize('times', [5, 30, 100])
def test_references_that_were_all_noisy_are_trusted_again_after_the_hold(refit, times):
    world, rng = anser_world(), np.random.default_rng(7)
    run(refit, world, 0.0, 10)

    def noisy(flux):
        flux += times * world.noise(rng)

    result = run(refit, world, 0.0, 40, start=11, fault=noisy)
    assert result.withheld == REFERENCES_DOUBTFUL
    result = run(refit, world, 0.0, 2 * refit.settings.hold_frames + 1, 8, 51)
    assert (result.state, result.withheld, result.model) == ('frozen', '', world.model)


@pytest.mark.parametrize(
    ('share', 'of', 'is_seen'), [(0.2, 0.01, True), (0.5, 0.01, True), (0.5, 0.005, False)]
)
def test_a_gain_of_all_that_begins_within_a_window_is_over_when_it_is_over(
    refit, share, of, is_seen
):
    """The window shows a part of it, which is no course that the references were on.

    Where the parts are too small to be seen, its end is not: they read the baseline again.
    """
    world = anser_world()
    run(refit, world, 0.0, 10)
    for first, frames, gain in ((11, 1, share * of), (12, 20, of)):
        result = run(
            refit, world, 0.0, frames, first, first,
            lambda flux, gain=gain: flux.__imul__(1.0 + gain),
        )  # fmt: skip
    assert (result.withheld == REFERENCES_DOUBTFUL) is is_seen
    result = run(refit, world, 0.0, 2 * refit.settings.hold_frames + 1, 8, 32)
    assert (result.state, result.withheld, result.model) == ('frozen', '', world.model)


def test_a_fault_of_all_is_over_when_metal_alone_explains_what_has_changed(refit):
    """Metal goes on moving meanwhile, so no reading comes back to where it was."""
    world, rng = anser_world(), np.random.default_rng(9)
    faults = {
        'noise': lambda flux: flux + 30.0 * world.noise(rng),
        'gain': lambda flux: 1.01 * flux,
    }
    hold, lasts = refit.settings.hold_frames, 40
    for name, fault in faults.items():
        refit.reset()
        for frame in range(20 + lasts + 2 * hold):
            points = HEAD - [0.0, 0.0, 0.06 - 5e-4 * frame]
            flux = world.baseline + world.metal(points) + world.noise(rng)
            is_faulty = 20 <= frame < 20 + lasts
            flux = fault(flux) if is_faulty else flux
            result = refit.update((frame + 1) * STEP_NS, world.references.channel, flux)
            if is_faulty:
                assert result.withheld == REFERENCES_DOUBTFUL, (name, frame)
            if frame >= 20 + lasts + hold + 5:
                assert result.withheld == '', (name, frame - 20 - lasts)
        assert share_left(world, result.model, points) < 0.1, name


def test_coils_that_recover_are_used_again_together(refit):
    """A change of the coils in use takes longer than a frame."""
    world, hold = anser_world(), refit.settings.hold_frames
    for first in (2, 5, 8):
        flags = np.zeros(len(world.baseline), dtype=int)
        flags[:first] = 1
        run(refit, world, 0.0, 4, first, 10 * first, flags=flags)
    left_out = {len(run(refit, world, 0.0, 1, 7, 100 + k).left_out) for k in range(2 * hold)}
    assert left_out == {8, 0}


def test_frozen_references_are_left_out_however_many_they_are(refit):
    world, held = anser_world(), {}
    group = group_of(world, 11)

    def fault(flux):
        held.setdefault('flux', flux[group].copy())
        flux[group] = held['flux']

    change = world.metal(HEAD)
    run(refit, world, change)
    result = run(refit, world, change, seed=2, start=4, frames=4, fault=fault)
    assert set(result.left_out) == {world.references.name[i] for i in group}
    assert {r.state for r in result.references if r.name in result.left_out} == {'stuck'}
    assert result.is_answer
    held.clear()
    group = np.arange(len(world.references))
    assert run(refit, world, change, seed=5, start=9, fault=fault).withheld == 'references_lost'
