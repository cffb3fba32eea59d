"""Finds the grid of a poll in stamps."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FINEST_S = 2e-3  # finest step of a poll, s: at 0.5 m/s a finer one moves poses by 0.3 mm rms
ON_STEP = 0.95  # share of the stamps that lie on a grid for it to be one
RATE_SHARE = 0.9
"""Share of the intervals that are one step from which the step may be the tracker's own rate, with
some poses lost, and no poll's: another clock falls into step for less."""
FEWEST_BEATS, ON_BEAT = 4, 0.7
"""Distances between the intervals that are not one step, and the share of them that differ by one
interval at most, from which they are two clocks' beat; poses lost at random make it once in
1000."""
SHARED = 0.05
"""Share of poses under the stamp of the pose before them from which a grid is a poll's, whatever
its intervals: a tracker gives each pose a time of its own."""


def stamp_step(time: Array) -> float:
    """Return the step, s, that all intervals between stamps are multiples of, or zero."""
    every = np.diff(time)
    steps = every[every > FINEST_S / 2]
    if steps.size < 20:
        return 0.0
    is_shared = np.mean(every == 0) > SHARED
    kinds = np.unique(np.round(steps, 5))
    if kinds.size < 2:
        # One interval alone is a rate and not a grid, unless it holds several poses.
        step = float(np.median(steps))
        return step if is_shared or _is_beat(every, step) else 0.0
    # Intervals differ by whole steps, and are some steps themselves.
    apart = np.diff(kinds)
    apart = apart[apart > FINEST_S]
    base = float(np.percentile(steps, 2))
    trials = [*apart[:1].tolist(), *(base / divisor for divisor in range(1, 9))]
    for trial in trials:
        step = float(trial)
        if step < FINEST_S:
            continue
        counts = np.round(steps / step)
        step = float(np.sum(steps * counts) / np.sum(counts**2))
        counts = np.round(steps / step)
        off = np.abs(steps - counts * step)
        if np.mean((off < 0.02 * step + 2e-6) & (counts > 0)) > ON_STEP:
            is_rate = np.mean(np.round(every / step) == 1) > RATE_SHARE
            return 0.0 if is_rate and not is_shared and not _is_beat(every, step) else step
    return 0.0


def _is_beat(every: Array, step: float) -> bool:
    """Whether intervals of no step, or of two, come as regularly as those of two clocks do.

    A tracker and its poll are out of step by a little more with each pose, and the next interval
    of another length comes when that is a whole step again. Longer intervals are pauses.
    """
    apart = np.diff(np.flatnonzero(np.isin(np.round(every / step), (0, 2))))
    return apart.size >= FEWEST_BEATS and bool(
        np.mean(np.abs(apart - np.median(apart)) <= 1) > ON_BEAT
    )
