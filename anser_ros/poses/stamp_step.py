"""Finds the grid of a poll in stamps."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FINEST_S = 2e-3  # finest step of a poll, s: at 0.5 m/s a finer one moves poses by 0.3 mm rms
ON_STEP = 0.95  # share of the stamps that lie on a grid for it to be one
RATE_SHARE = 0.9
"""Share of the intervals that are one step from which the step is the tracker's own rate, with
some poses lost, and no poll's: another clock falls into step for less."""
SHARED = 0.05
"""Share of poses under the stamp of the pose before them from which a grid is a poll's, whatever
its intervals: a tracker gives each pose a time of its own. Smaller takes a few poses that were
sent together for a poll; larger leaves a poll that is hardly slower than its tracker unnamed."""


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
        return float(np.median(steps)) if is_shared else 0.0
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
        off = np.abs(steps - np.round(steps / step) * step)
        if np.mean(off < 0.02 * step + 2e-6) > ON_STEP:
            is_rate = np.mean(np.round(every / step) == 1) > RATE_SHARE
            return 0.0 if is_rate and not is_shared else step
    return 0.0
