"""Emitters whose strength is not the model's, learnt from the tools alone."""

import numpy as np
import pytest
from tracked_tool import MODEL, STEP_NS, TOOL, path
from tracking_world import NOISE_T, fluxes

from anser_ros.chain.frame import Answer, FrameReadings
from anser_ros.chain.tracking_half import TrackingHalf
from anser_ros.tracking.estimate import TrackerSettings
from anser_ros.tracking.tracker import Tracker

SEED = 53
EXACT = TrackerSettings(stamp_sigma_s=0.0, flux_noise_t=NOISE_T)
COUNT, SETTLED = 400, 100


def tracked(rng, gain, coils=range(9), fault=lambda i, flux: flux, count=COUNT, **options):
    """The tracker, and errors (m), sigmas (m) and whether ok of all poses in each frame."""
    table = TOOL.select(np.array(coils))
    tracker, out = Tracker(MODEL, table, EXACT), []
    for i, (stamp, position, rotation) in enumerate(path(count)):
        flux = fluxes(MODEL, TOOL, position, rotation, rng) * gain(stamp * 1e-9)
        found = tracker.update(stamp, table.channel, fault(i, flux)[list(coils)], **options)
        places = {
            n: position + rotation @ p for n, p in zip(TOOL.name, TOOL.position, strict=True)
        }
        out.append(
            [
                (np.linalg.norm(e.position - places.get(e.name, position)), e.sigma_position_m,
                 e.state == 'ok')
                for e in found
            ]
        )  # fmt: skip
    return tracker, *np.moveaxis(np.array(out, dtype=float), 2, 0)


def warmed(percent, drift_1_s=0.0, emitter=3, turn=0.0):
    """Factors (K,) of an emitter that is stronger from the start on, and drifts."""

    def gain(t):
        out = np.ones(8, complex)
        out[emitter] += (percent / 100.0 + drift_1_s * t) * np.exp(1j * turn)
        return out

    return gain


@pytest.mark.parametrize('coils', [range(9), (0, 1, 2)], ids=['nine coils', 'three'])
@pytest.mark.parametrize(
    'gain', [warmed(1.0), warmed(-3.0, 5e-4), warmed(0.0, 5e-4), warmed(0.0, 2e-5)]
)
def test_a_rigid_tool_learns_the_strength_of_an_emitter(rng, coils, gain):
    _, error, sigma, ok = tracked(rng, gain, coils)
    _, usual, _, _ = tracked(np.random.default_rng(SEED), warmed(0.0), coils)
    assert ok[SETTLED:].mean() > 0.99
    late, good = error[SETTLED:], ok[SETTLED:] == 1.0
    assert (late > 3.0 * sigma[SETTLED:])[good].mean() <= 0.01
    rms = [float(np.sqrt(np.mean(e**2))) for e in (late[good], usual[SETTLED:])]
    assert rms[0] < np.hypot(rms[1], 3e-5), 'at most 0.03 mm'


def test_what_is_learnt_is_stated(rng):
    tracker, *_ = tracked(rng, warmed(1.0, turn=0.1))
    assert tracker.emitter_strengths.startswith(f'{MODEL.emitters[3]} +')
    assert ',' not in tracker.emitter_strengths, 'no other emitter'
    learnt = tracker._past.strengths.used[3]
    assert abs(learnt - 0.01 * np.exp(0.1j)) < 2e-4


def test_nothing_is_changed_where_emitters_are_as_calibrated(rng):
    tracker, error, *_ = tracked(rng, warmed(0.0))
    other, same, *_ = tracked(np.random.default_rng(SEED), warmed(0.0), learns=False)
    assert tracker.emitter_strengths == other.emitter_strengths == ''
    np.testing.assert_array_equal(error, same)


def test_a_single_coil_learns_while_it_moves_and_says_what_it_does_not_know(rng):
    _, error, sigma, ok = tracked(rng, warmed(1.0), (4,), count=2 * COUNT)
    assert ok[COUNT:].mean() > 0.9
    assert (error > 3.0 * sigma)[ok == 1.0].mean() <= 0.01


def test_a_single_coil_at_rest_learns_nothing(rng):
    """What one reading says of eight emitters may as well be metal."""
    table, still = TOOL.select(np.array([4])), next(path(1))
    tracker = Tracker(MODEL, table, EXACT)
    for i in range(COUNT):
        flux = fluxes(MODEL, TOOL, *still[1:], rng) * warmed(1.0)(0.0)
        (found,) = tracker.update((i + 1) * STEP_NS, table.channel, flux[[4]])
    assert found.state != 'ok' and tracker._past.strengths.used is None


def test_a_bent_tool_and_metal_are_no_emitters(rng):
    def bent(i, flux):
        out = flux.copy()
        out[6:] *= 1.02
        return out

    tracker, *_ = tracked(rng, warmed(0.0), fault=bent)
    assert tracker._past.strengths.used is None


def test_references_take_the_strengths_over(rng):
    half = TrackingHalf(Tracker(MODEL, TOOL, EXACT), 10.0)
    for stamp, position, rotation in path(2 * SETTLED):
        flux = fluxes(MODEL, TOOL, position, rotation, rng) * warmed(1.0)(0.0)
        readings = FrameReadings(TOOL.channel, flux, np.zeros(9, dtype=int))
        if stamp == SETTLED * STEP_NS:
            assert half.tracker.emitter_strengths
            half.use(Answer(stamp, MODEL, True))
        half.step(stamp, readings)
    assert half.tracker.emitter_strengths == ''
