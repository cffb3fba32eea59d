"""Computes the figures of ASTM F2554: readings of one point, and distances of known points.

ASTM F2554, "Standard Practice for Measurement of Positional Accuracy of Computer Assisted Surgical
Systems": how far readings of one location scatter while the tool is turned about it, and how far
distances between points of a phantom are from the true ones.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from anser_ros.apps.poses.assessment.hummel import ErrorGroup, grouped, rigid_distance
from anser_ros.apps.poses.assessment.intervals import (
    IntervalEstimate,
    blocks_of_time,
    mitk_statistics,
    summarised,
    vertex_weights,
)
from anser_ros.apps.poses.assessment.stillness import StillPoint
from anser_ros.apps.poses.sequence import PoseSequence
from anser_ros.errors import FitError

Array = NDArray[np.float64]

FEWEST_READINGS = 10  # of a point: fewer give no mean that a bad reading leaves alone
MOST_READINGS = 2000  # that take part, evenly over the recording: two million pairs of them
FAR_M = 0.05
"""Extent of readings, m, beyond which they are no readings of one location."""
FEWEST_FOR_OUTLIER = 6
"""Points without which none is said to stand alone: a rigid fit has six unknowns."""
ALONE = 0.5
"""Share of a rigid fit's error that is left without a point that stands alone."""


def single_point(
    poses: PoseSequence, rng: np.random.Generator
) -> tuple[ErrorGroup, dict[str, IntervalEstimate]]:
    """Return distances of the readings from their mean, mm, and the largest between two, m.

    Parameters
    ----------
    poses : PoseSequence
        Of the tip, while it stays at one location.
    rng : Generator
        Draws the intervals.

    Raises
    ------
    FitError
        When there are too few readings, or they are of several locations.
    """
    if poses.size < FEWEST_READINGS:
        raise FitError(f'a point needs at least {FEWEST_READINGS} readings, got {poses.size}')
    rows = np.linspace(0, poses.size - 1, min(poses.size, MOST_READINGS)).astype(int)
    place, time = poses.position[rows], poses.time[rows]
    spread = float(
        np.linalg.norm(np.percentile(place, 95, axis=0) - np.percentile(place, 5, axis=0))
    )
    if spread > FAR_M:
        raise FitError(
            f'the readings extend over {1e3 * spread:.0f} mm: they were taken at several '
            'locations, or are those of the sensor instead of the tip (state the tip with '
            '--tip)'
        )
    size = 1e3 * np.linalg.norm(place - place.mean(axis=0), axis=1)
    group = grouped('mm', [f'Reading at {t:.2f} s' for t in time], size,
                    [blocks_of_time(time)], rng)  # fmt: skip
    return group, {'span_m': IntervalEstimate(_span(place))}


def _span(place: Array) -> float:
    """Largest distance of two of some places, m; exact for those that are farthest out."""
    rest = place - place.mean(axis=0)
    outer = rest[np.argsort(-np.linalg.norm(rest, axis=1))[:200]]
    return float(np.max(np.linalg.norm(outer[:, None] - outer[None], axis=2)))


def point_to_point(
    points: Sequence[StillPoint], true: Array, rng: np.random.Generator
) -> tuple[ErrorGroup, dict[str, IntervalEstimate]]:
    """Return errors of all distances between points, mm, and what a rigid fit leaves, m.

    Parameters
    ----------
    points : sequence of StillPoint
        As they were touched.
    true : ndarray, shape (n, 3)
        Their places on the phantom, m, in any frame, in the same order.
    rng : Generator
        Draws the intervals.

    Raises
    ------
    FitError
        When the numbers differ, there are too few, or the order is not that of the truth.
    """
    if len(points) != len(true):
        raise FitError(f'{len(points)} points were found, but the truth has {len(true)}')
    if len(points) < 3:
        raise FitError(f'distances need at least three points, got {len(points)}')
    place = np.array([p.position for p in points])
    first, second = np.triu_indices(len(points), 1)
    measured = np.linalg.norm(place[first] - place[second], axis=1)
    wanted = np.linalg.norm(true[first] - true[second], axis=1)
    signed = 1e3 * (measured - wanted)
    if float(np.median(np.abs(signed))) > 0.25 * 1e3 * float(np.median(wanted)):
        raise FitError(
            f'the median error of the distances is {np.median(np.abs(signed)):.0f} mm: the '
            'points are not in the order of the truth, or a unit is wrong'
        )
    pairs = np.stack([first, second], axis=1)
    words = [f'Distance {a + 1} to {b + 1}' for a, b in pairs]
    weights = vertex_weights(pairs, rng)
    group = ErrorGroup(
        'mm', tuple(words), np.abs(signed), signed,
        summarised(np.abs(signed), weights, len(points)),
    )  # fmt: skip
    mean = summarised(signed, weights, len(points))['Mean']
    return group, {
        'mean_error_m': IntervalEstimate(1e-3 * mean.value, 1e-3 * mean.low, 1e-3 * mean.high),
        'standard_deviation_of_error_m': IntervalEstimate(
            1e-3 * mitk_statistics(signed)['Sample Standard Deviation']
        ),
        'least_error_m': IntervalEstimate(1e-3 * float(signed.min())),
        'greatest_error_m': IntervalEstimate(1e-3 * float(signed.max())),
        'rigid_fit_m': IntervalEstimate(rigid_distance(true, place)),
    }


def standing_alone(place: Array, true: Array) -> tuple[int, float, float] | None:
    """Return the one point that a rigid fit is much better without, and what both fits leave.

    Causes are a marker found in its second solution, or a tip that was not in its divot. Returns
    None if no single point stands alone, or if there are too few points.
    """
    count = len(place)
    if count < FEWEST_FOR_OUTLIER:
        return None
    whole = rigid_distance(true, place)
    rest = [
        rigid_distance(np.delete(true, k, axis=0), np.delete(place, k, axis=0))
        for k in range(count)
    ]
    best = int(np.argmin(rest))
    return (best, whole, rest[best]) if rest[best] < ALONE * whole else None
