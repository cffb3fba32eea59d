"""Finds error and latency of a moving tool by its speed, against a moving reference.

Hand-eye gives the two frames and the offset of the clocks. A late pose is displaced backwards
along its velocity, so the error along the velocity divided by the speed is a time: the latency
that remains beside the common offset, for each group of speeds.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.apps.poses.assessment.intervals import (
    BLOCKS,
    LEVEL,
    IntervalEstimate,
    blocks_of_time,
    cluster_weights,
    summarised,
)
from anser_ros.apps.poses.hand_eye import HandEye
from anser_ros.errors import FitError

Array = NDArray[np.float64]

GROUPS = 5  # groups of speeds, with equal numbers of poses: a row of the table each
FEWEST_MOVING_POSES = 100
"""Fewer leave a group less than 20, whose 95th percentile would be one pose."""
SLOWEST_M_S = 0.02
"""Median speed below which a recording is of a rest, where a jitter of 0.1 mm is 5 ms of
latency."""


@dataclass(frozen=True)
class SpeedGroup:
    """Holds poses of similar speed."""

    low_m_s: float
    high_m_s: float
    mean_m_s: float
    n: int
    # root mean square distance, m: with the clocks' offset taken out, and as it is met by who
    # takes a pose for that of its stamp on the reference's clock
    error_m: IntervalEstimate
    error_live_m: IntervalEstimate
    # of the poses against the reference, s, the common offset included
    latency_s: IntervalEstimate


@dataclass(frozen=True)
class Dynamics:
    """Holds what a moving tool shows."""

    estimates: dict[str, IntervalEstimate]
    groups: tuple[SpeedGroup, ...]
    # (n,), of every pose
    speed_m_s: Array
    error_m: Array


def assess_motion(found: HandEye, sensor: str, rng: np.random.Generator) -> Dynamics:
    """Assess one sensor of a session whose frames and clocks are known.

    Raises
    ------
    FitError
        When there are too few poses, or the tool hardly moved.
    """
    part = next(p for p in found.fit.state.parts if p.view.sensor == sensor)
    used = part.used
    if np.count_nonzero(used) < FEWEST_MOVING_POSES:
        raise FitError(
            f'{np.count_nonzero(used)} poses with a reference; {FEWEST_MOVING_POSES} are needed'
        )
    rest, velocity, time = (
        part.residual[used, :3],
        part.view.velocity[used, :3],
        part.view.time[used],
    )
    speed = np.linalg.norm(velocity, axis=1)
    if float(np.median(speed)) < SLOWEST_M_S or found.offset_s is None:
        raise FitError(
            f'the median speed of the tool was {1e3 * np.median(speed):.0f} mm/s; move it at '
            f'{1e3 * SLOWEST_M_S:.0f} mm/s or more, at several speeds'
        )
    offset, sigma = found.offset_s
    # A late pose is where the tool was: back along the velocity by speed times latency.
    live = rest - offset * velocity
    error, error_live = np.linalg.norm(rest, axis=1), np.linalg.norm(live, axis=1)
    clusters = blocks_of_time(time)
    edges = np.quantile(speed, np.linspace(0, 1, GROUPS + 1))
    groups = []
    for k in range(GROUPS):
        inside = (speed >= edges[k]) & ((speed < edges[k + 1]) | (k == GROUPS - 1))
        weights = cluster_weights(clusters[inside], rng)
        count = int(np.unique(clusters[inside]).size)
        late = _latency(rest[inside], velocity[inside], weights, offset, sigma)
        groups.append(
            SpeedGroup(
                float(edges[k]), float(edges[k + 1]), float(speed[inside].mean()),
                int(inside.sum()), summarised(error[inside], weights, count)['RMS'],
                summarised(error_live[inside], weights, count)['RMS'], late,
            )
        )  # fmt: skip
    weights = cluster_weights(clusters, rng)
    whole = summarised(error, weights, BLOCKS)
    estimates = {
        'dynamic_error_rms_m': whole['RMS'],
        'dynamic_error_prc95_m': whole['P95'],
        'dynamic_error_live_rms_m': summarised(error_live, weights, BLOCKS)['RMS'],
        'latency_s': _latency(rest, velocity, weights, offset, sigma),
        'speed_prc95_m_s': IntervalEstimate(float(np.percentile(speed, 95))),
    }
    return Dynamics(estimates, tuple(groups), speed, error)


def _latency(
    rest: Array, velocity: Array, weights: Array, offset: float, sigma: float
) -> IntervalEstimate:
    """The offset and what is left beside it, s, with the offset's own uncertainty."""
    along, square = np.sum(rest * velocity, axis=1), np.sum(velocity**2, axis=1)
    value = offset - float(along.sum() / max(square.sum(), 1e-300))
    drawn = offset - (weights @ along) / np.maximum(weights @ square, 1e-300)
    low, high = np.quantile(drawn, [0.5 - LEVEL / 2, 0.5 + LEVEL / 2])
    wide = 1.96 * sigma
    return IntervalEstimate(
        value,
        value - float(np.hypot(value - low, wide)),
        value + float(np.hypot(high - value, wide)),
    )
