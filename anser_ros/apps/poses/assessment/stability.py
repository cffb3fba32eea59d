"""Assesses a tool left alone: jitter, drift, Allan deviation, and the shift that metal makes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.spatial.transform import Rotation

from anser_ros.apps.poses.assessment.intervals import (
    LEVEL,
    IntervalEstimate,
    deviation_interval,
    independent_for_mean,
    independent_for_variance,
)
from anser_ros.apps.poses.assessment.stillness import point_of
from anser_ros.apps.poses.sequence import PoseSequence
from anser_ros.errors import FitError

Array = NDArray[np.float64]

FEWEST_STILL_POSES = 50  # fewer determine a standard deviation to worse than 10 %
AXES = ('x', 'y', 'z')
EVEN = 1.5
"""Interval of two poses, in median intervals, from which on the series is not evenly spaced."""
HOUR_S = 3600.0  # seconds in an hour
FARTHEST_M = 0.02
"""Extent of the poses, m, from which on they are of a tool that was moved: the central 90 %."""
LEAST_TERMS = 4  # averages of a shown Allan deviation: fewer leave it uncertain by half
ALPHAS = (2, 1, 0, -1, -2)  # exponents of frequency that allantools has intervals for


@dataclass(frozen=True)
class AllanCurve:
    """Holds the overlapping Allan deviation of one coordinate."""

    tau_s: Array  # (k,), averaging times
    # (k,), m, with its 95 % interval (chi-square with Greenhall's degrees of freedom, for the
    # noise that each averaging time shows)
    deviation: Array
    low: Array
    high: Array


@dataclass(frozen=True)
class Rest:
    """Holds what a tool at rest shows."""

    estimates: dict[str, IntervalEstimate]  # by their names in ``accuracy.json``
    allan: dict[str, AllanCurve]  # by axis
    # share of the poses that are in the longest evenly spaced stretch, which Allan's is of
    even_share: float


def assess_rest(poses: PoseSequence) -> Rest:
    """Assess poses of a tool that was left alone.

    Raises
    ------
    FitError
        When there are too few, or the tool was moved.
    """
    if poses.size < FEWEST_STILL_POSES:
        raise FitError(
            f'a tool at rest needs at least {FEWEST_STILL_POSES} poses, '
            f'better some minutes of them; got {poses.size}'
        )
    low, high = np.percentile(poses.position, [5, 95], axis=0)
    extent = float(np.linalg.norm(high - low))
    if extent > FARTHEST_M:
        raise FitError(
            f'the tool moved by {1e3 * extent:.0f} mm: the protocol rest needs a tool that '
            'stays in place'
        )
    turns = Rotation.from_quat(poses.quaternion)
    angles = (turns.mean().inv() * turns).as_rotvec()
    estimates: dict[str, IntervalEstimate] = {}
    for name, unit, values in (('position', 'm', poses.position), ('orientation', 'rad', angles)):
        estimates |= _jitter(f'{name}_jitter', unit, values)
        estimates |= _drift(f'{name}_drift', unit, poses.time, values)
    first, last = _longest_even(poses.time)
    even = poses.position[first:last]
    rate = 1 / float(np.median(np.diff(poses.time)))
    allan = {axis: allan_deviation(even[:, k], rate) for k, axis in enumerate(AXES)}
    return Rest(estimates, allan, (last - first) / poses.size)


def _jitter(name: str, unit: str, values: Array) -> dict[str, IntervalEstimate]:
    """Standard deviations by axis, their root sum of squares, and the 95th percentile."""
    rest = values - values.mean(axis=0)
    freedoms = [independent_for_variance(rest[:, k]) - 1 for k in range(3)]
    deviations = np.std(rest, axis=0, ddof=1)
    found = {
        f'{name}_{axis}_{unit}': deviation_interval(float(deviations[k]), max(freedoms[k], 1.0))
        for k, axis in enumerate(AXES)
    }
    variances = deviations**2
    # Degrees of freedom of a sum of variances after Satterthwaite.
    together = float(
        variances.sum() ** 2 / max(np.sum(variances**2 / np.maximum(freedoms, 1)), 1e-300)
    )
    found[f'{name}_rms_{unit}'] = deviation_interval(
        float(np.sqrt(variances.sum())), max(together, 1.0)
    )
    size = np.linalg.norm(rest, axis=1)
    found[f'{name}_prc95_{unit}'] = IntervalEstimate(float(np.percentile(size, 95)))
    return found


def _drift(name: str, unit: str, time: Array, values: Array) -> dict[str, IntervalEstimate]:
    """Slope by axis in an hour, with an interval that counts errors alike in time once."""
    when = time - time.mean()
    square = max(float(when @ when), 1e-300)
    found = {}
    for k, axis in enumerate(AXES):
        slope = float(when @ values[:, k]) / square
        rest = values[:, k] - values[:, k].mean() - slope * when
        count = independent_for_mean(rest)
        sigma = float(np.std(rest)) * np.sqrt(time.size / count / square)
        wide = float(stats.t.ppf(0.5 + LEVEL / 2, max(count - 2, 1))) * sigma
        found[f'{name}_{axis}_{unit}_per_h'] = IntervalEstimate(
            HOUR_S * slope, HOUR_S * (slope - wide), HOUR_S * (slope + wide)
        )
    return found


def _longest_even(time: Array) -> tuple[int, int]:
    """First and beyond-last row of the longest stretch of evenly spaced stamps."""
    steps = np.diff(time)
    breaks = np.flatnonzero(steps > EVEN * np.median(steps)) + 1
    edges = np.concatenate([[0], breaks, [time.size]])
    longest = int(np.argmax(np.diff(edges)))
    return int(edges[longest]), int(edges[longest + 1])


def allan_deviation(values: Array, rate_hz: float) -> AllanCurve:
    """Return the overlapping Allan deviation of evenly spaced values, m, at octaves of averaging
    time.
    """
    import allantools  # no other assessment needs it

    tau, deviation, _, terms = allantools.oadev(
        values - values.mean(), rate=rate_hz, data_type='freq', taus='octave'
    )
    shown = (np.asarray(terms) >= LEAST_TERMS) & (np.asarray(deviation) > 0)
    tau, deviation = np.asarray(tau)[shown], np.asarray(deviation)[shown]
    low, high = [], []
    for k, (averaged, value) in enumerate(zip(tau, deviation, strict=True)):
        count = max(round(averaged * rate_hz), 1)
        freedoms = allantools.edf_greenhall(
            _noise_kind(tau, deviation, k), 2, count, values.size + 1, overlapping=True,
            modified=False,
        )  # fmt: skip
        interval = deviation_interval(float(value), max(float(freedoms), 1.0))
        low.append(interval.low)
        high.append(interval.high)
    return AllanCurve(tau, deviation, np.array(low), np.array(high))


def _noise_kind(tau: Array, deviation: Array, k: int) -> int:
    """Exponent of the noise's spectrum, from the slope of the deviation about one time.

    With a spectrum as the power ``a`` of frequency the deviation goes as ``-(a + 1) / 2``.
    """
    near = slice(max(k - 1, 0), min(k + 2, tau.size))
    if tau[near].size < 2:
        return 0
    slope = float(np.polyfit(np.log(tau[near]), np.log(deviation[near]), 1)[0])
    wanted = -2 * slope - 1
    return min((a for a in ALPHAS if a <= 0), key=lambda a: abs(a - wanted))


FEWEST_REST_POSES = 10  # poses of a rest, without which its mean has no uncertainty


def metal_shifts(
    base: PoseSequence, others: Sequence[tuple[str, PoseSequence]]
) -> dict[str, IntervalEstimate]:
    """Return distance (m) and angle (rad) of each recording's mean pose from that without metal.

    The interval is of the distance: the shift's own uncertainty along it (errors that are alike in
    time count once), and never below zero.

    Raises
    ------
    FitError
        When a recording has too few poses.
    """
    found = {}
    first = _mean(base)
    for name, poses in others:
        second = _mean(poses)
        for k, unit in ((0, 'm'), (1, 'rad')):
            if k == 0:
                shift = second[0] - first[0]
            else:
                turn = Rotation.from_matrix(first[1]).inv() * Rotation.from_matrix(second[1])
                shift = turn.as_rotvec()
            sigma = float(np.sqrt(np.max(first[2 + k] + second[2 + k])))
            size = float(np.linalg.norm(shift))
            wide = float(stats.norm.ppf(0.5 + LEVEL / 2)) * sigma
            what = 'position' if k == 0 else 'orientation'
            found[f'{what}_shift_{name}_{unit}'] = IntervalEstimate(
                size, max(size - wide, 0), size + wide
            )
    return found


def _mean(poses: PoseSequence) -> tuple[Array, Array, Array, Array]:
    """Mean position and rotation, and the variances of both by axis."""
    if poses.size < FEWEST_REST_POSES:
        raise FitError(
            f'{poses.name}: a tool at rest needs at least {FEWEST_REST_POSES} poses, '
            f'got {poses.size}'
        )
    point = point_of(poses)
    turns = Rotation.from_quat(poses.quaternion)
    angles = (Rotation.from_matrix(point.rotation).inv() * turns).as_rotvec()
    variances = [
        np.array([np.var(v[:, k]) / independent_for_mean(v[:, k]) for k in range(3)])
        for v in (poses.position, angles)
    ]
    return point.position, point.rotation, variances[0], variances[1]
