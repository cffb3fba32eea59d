"""Measures errors of poses and stamps themselves: jitter between neighbours, and grids of
polls.
"""

import numpy as np
from numpy.typing import NDArray

from anser_ros.apps.poses.effect import Sensing
from anser_ros.apps.poses.problem import PoseState

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


NEAR_S, NEAR_STEPS = 0.3, 3.0
"""Poses that are nearer in time, s or usual intervals, differ by noise and not by place."""


def jitter(sensing: Sensing) -> tuple[Array, Array]:
    """Return squared noise (n,) of poses beside near neighbours, and distances (n, 3).

    Squares are m^2, a coordinate; the distances, m, are those of the pose before, of the pose and
    of the one after it. Second differences of the residual across the velocity, so that neither a
    slow course nor an error of the stamps is in it.
    """
    rows = np.flatnonzero(sensing.used)
    time, velocity = sensing.view.time[rows], sensing.view.velocity[rows, :3]
    residual = sensing.residual[rows, :3]
    if rows.size < 3:
        return np.zeros(0), np.zeros((0, 3))
    along = velocity / np.maximum(np.linalg.norm(velocity, axis=1, keepdims=True), 1e-9)
    if sensing.stamp_s > 0:
        # Neighbours move another way, and errors of their stamps lie along theirs. What is the
        # same everywhere would change with the direction that is taken out of it.
        residual = _across(residual - np.median(residual, axis=0), along)
    second = residual[1:-1] - 0.5 * (residual[:-2] + residual[2:])
    second = _across(second, along[1:-1])
    usual = float(np.median(np.diff(time)))
    near = time[2:] - time[:-2] < max(NEAR_S, NEAR_STEPS * usual)
    square = np.sum(second**2, axis=1) / (1.5 * 2)
    distance = np.linalg.norm(sensing.view.measured[rows], axis=1)
    about = np.stack([distance[:-2], distance[1:-1], distance[2:]], axis=1)
    return square[near], about[near]


def _across(vectors: Array, along: Array) -> Array:
    """Vectors (n, 3) without their part along unit vectors (n, 3)."""
    return np.asarray(vectors - np.sum(vectors * along, axis=1, keepdims=True) * along)


def floor_of(state: PoseState) -> float:
    """Return the distance that jitter alone makes, m, from differences between neighbours."""
    squares = []
    for part in state.parts:
        is_resting = not part.view.velocity.any()  # each recording has an error of its own
        groups = np.unique(part.blocks) if is_resting else (None,)
        rows = [part.used if k is None else part.used & (part.blocks == k) for k in groups]
        sensings = [Sensing(part.view, part.residual, r, ~r, 0.0, 0.0, 0.0, 0.0) for r in rows]
        square = np.concatenate([jitter(sensing)[0] for sensing in sensings])
        noise = part.noise
        along = noise.stamp_s * np.linalg.norm(part.view.velocity[part.used, :3], axis=1)
        if square.size and along.size:
            squares.append(3 * float(np.mean(square)) + float(np.mean(along**2)))
    return float(np.sqrt(np.mean(squares))) if squares else 0.0
