"""Finds where a tool rested, and assesses a tool left alone: jitter, drift, Allan deviation."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.spatial.transform import Rotation

from anser_ros.apps.poses.assessment.intervals import (
    LEVEL,
    IntervalEstimate,
    deviation_interval,
    independent_for_mean,
    independent_for_variance,
)
from anser_ros.apps.poses.sequence import PoseSequence
from anser_ros.arrays import Array
from anser_ros.errors import FitError

WINDOW_S, WINDOW_POSES = 0.25, 3.0
"""Window whose middle pose is compared with its neighbours', s and poses: noise has fallen in it,
and a hand has moved by more than a pause may."""
FEWEST_WINDOWS = 4
"""Windows of a pause, each half over the one before: fewer don't show whether the tool moved."""
NOISE_TIMES = 5.0  # windows' own scatter by which their middle may differ in a pause
LEAST_MOVE_M, LEAST_MOVE_RAD = 0.7e-3, 0.012
"""Difference that is a move whatever the noise, m, rad: a hand on a divot moves a tool less."""
MOST_MOVE_M, MOST_MOVE_RAD = 2.5e-3, 0.05
"""Difference that is a move however noisy: m, rad. A scan that steps on with every pose is noise
by its differences, and no rest."""
LONGER = 1.5
"""Share of the shortest pause that the fewest windows of a noisy tracker may take."""
LONGEST_SILENCE_S = 1.0  # silence that ends a pause: it is not known where the tool was meanwhile


@dataclass(frozen=True)
class PauseRule:
    """States what counts as a point."""

    least_s: float = 1.0  # shortest pause
    # pauses in a row that are nearer to each other are one point: a tool that was let go of, or
    # touched
    apart_m: float = 5e-3
    apart_rad: float = 0.05


@dataclass(frozen=True)
class StillPoint:
    """Describes a place where the tool rested."""

    # s since the recording's start
    begin_s: float
    end_s: float
    position: Array  # (3,), mean, m, tracker's frame
    rotation: Array  # (3, 3), mean rotation
    jitter_m: float  # root mean square distance of a pose from the mean
    n: int  # poses


def point_of(poses: PoseSequence) -> StillPoint:
    """Return the point of poses that all belong to it; poses far off the median take no part.

    Raises `FitError` when there is no pose.
    """
    if not poses.size:
        raise FitError(f'{poses.name}: no pose')
    middle = np.median(poses.position, axis=0)
    far = np.linalg.norm(poses.position - middle, axis=1)
    kept = poses.rows(far <= max(8 * float(np.median(far)), 1e-6))
    mean = kept.position.mean(axis=0)
    return StillPoint(
        float(kept.time[0]), float(kept.time[-1]), mean,
        np.asarray(Rotation.from_quat(kept.quaternion).mean().as_matrix()),
        float(np.sqrt(np.mean(np.sum((kept.position - mean) ** 2, axis=1)))), kept.size,
    )  # fmt: skip


def still_points(poses: PoseSequence, rule: PauseRule | None = None) -> list[StillPoint]:
    """Return all pauses of a recording, in their order."""
    rule = rule or PauseRule()
    if poses.size < 2 * WINDOW_POSES:
        return []
    length = max(WINDOW_S, WINDOW_POSES * float(np.median(np.diff(poses.time))))
    rows = _windows(poses.time, length)
    # The middle of a longer window is quieter, as long as a pause still has some of them.
    while rows and 2 * length * (FEWEST_WINDOWS + 1) / 2 <= rule.least_s * LONGER:
        if NOISE_TIMES * _noise(poses, rows)[0] < MOST_MOVE_M:
            break
        length *= 2
        rows = _windows(poses.time, length)
    if not rows:
        return []
    place = np.array([np.median(poses.position[a:b], axis=0) for a, b in rows])
    turns = Rotation.concatenate(
        [Rotation.from_quat(poses.quaternion[a:b]).mean() for a, b in rows]
    )
    noise = _noise(poses, rows)
    moved_m = float(np.clip(NOISE_TIMES * noise[0], LEAST_MOVE_M, MOST_MOVE_M))
    moved_rad = float(np.clip(NOISE_TIMES * noise[1], LEAST_MOVE_RAD, MOST_MOVE_RAD))
    begins = np.array([poses.time[a] for a, _ in rows])
    ends = np.array([poses.time[b - 1] for _, b in rows])
    runs = _runs(place, turns, begins, ends, (moved_m, moved_rad), rule.least_s)
    points = [
        point_of(poses.rows(np.arange(rows[i][0], rows[j][1])))
        for i, j in (_without_ends(i, j, len(rows)) for i, j in runs)
    ]
    return _merged(poses, points, rule)


def _windows(time: Array, length: float) -> list[tuple[int, int]]:
    """First and beyond-last row of windows of some length, s, each half over the one before.

    Those with fewer than two poses are left out.
    """
    begins = np.arange(time[0], time[-1], length / 2)
    first = np.searchsorted(time, begins - 1e-9)
    last = np.searchsorted(time, begins + length - 1e-9)
    return [(int(a), int(b)) for a, b in zip(first, last, strict=True) if b - a > 1]


def _noise(poses: PoseSequence, rows: Sequence[tuple[int, int]]) -> tuple[float, float]:
    """Noise, m and rad, of the mean of a window at rest: of the quiet ones."""
    places, angles = [], []
    for a, b in rows:
        count = b - a
        steps = np.diff(poses.position[a:b], axis=0)
        places.append(np.sqrt(np.mean(np.sum(steps**2, axis=1)) / 2 / count))
        turns = Rotation.from_quat(poses.quaternion[a:b])
        size = (turns[:-1].inv() * turns[1:]).magnitude()
        angles.append(np.sqrt(np.mean(size**2) / 2 / count))
    return float(np.percentile(places, 25)), float(np.percentile(angles, 25))


def _runs(
    place: Array, turns: Rotation, begins: Array, ends: Array, moved: tuple[float, float],
    least_s: float,
) -> list[tuple[int, int]]:  # fmt: skip
    """First and last window of each stretch that stays where it is for long enough."""
    runs, first, count = [], 0, len(place)
    while first < count:
        last = first
        while last + 1 < count:
            middle = np.median(place[first : last + 1], axis=0)
            is_near = np.linalg.norm(place[last + 1] - middle) < moved[0]
            turned = (turns[first + (last - first) // 2].inv() * turns[last + 1]).magnitude()
            is_near &= turned < moved[1]
            if not is_near or begins[last + 1] - ends[last] > LONGEST_SILENCE_S:
                break
            last += 1
        if ends[last] - begins[first] >= least_s and last - first + 1 >= FEWEST_WINDOWS:
            runs.append((first, last))
            first = last + 1
        else:
            first += 1
    return runs


def _without_ends(first: int, last: int, count: int) -> tuple[int, int]:
    """A run without its ends, in which the tool came and went; one of all windows stays whole."""
    is_all = last - first == count - 1
    return (first, last) if is_all or last - first < 3 else (first + 1, last - 1)


def _merged(
    poses: PoseSequence, points: Sequence[StillPoint], rule: PauseRule
) -> list[StillPoint]:
    """Points in a row that are one."""
    found: list[StillPoint] = []
    for point in points:
        if found:
            before = found[-1]
            turn = Rotation.from_matrix(before.rotation).inv() * Rotation.from_matrix(
                point.rotation
            )
            near = np.linalg.norm(point.position - before.position) < rule.apart_m
            if near and turn.magnitude() < rule.apart_rad:
                inside = (poses.time >= before.begin_s) & (poses.time <= before.end_s)
                inside |= (poses.time >= point.begin_s) & (poses.time <= point.end_s)
                found[-1] = point_of(poses.rows(inside))
                continue
        found.append(point)
    return found


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
    """Holds the overlapping Allan deviation of one coordinate, with its 95 % interval.

    The interval is chi-square with Greenhall's degrees of freedom, for the noise that each
    averaging time shows.
    """

    tau_s: Array  # (k,), averaging times
    deviation_m: Array  # (k,)
    low_m: Array
    high_m: Array


def assess_rest(
    poses: PoseSequence,
) -> tuple[dict[str, IntervalEstimate], dict[str, AllanCurve], float]:
    """Return figures by name, Allan deviations by axis, and the share of poses that these are of.

    That are those of the longest evenly spaced stretch. Raises `FitError` when there are too few
    poses, or the tool was moved.
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
    return estimates, allan, (last - first) / poses.size


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
    """Return the overlapping Allan deviation of evenly spaced values, m, at octaves of time."""
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
    base: PoseSequence, others: Sequence[PoseSequence]
) -> dict[str, IntervalEstimate]:
    """Return distance (m) and angle (rad) of each recording's mean pose from that without metal.

    Recordings count from 1. The interval is of the distance: the shift's own uncertainty along it
    (errors that are alike in time count once), and never below zero. Raises `FitError` when a
    recording has too few poses.
    """
    found, wide = {}, float(stats.norm.ppf(0.5 + LEVEL / 2))
    place, turn, *variances = _mean(base)
    for name, poses in enumerate(others, start=1):
        place_now, turn_now, *variances_now = _mean(poses)
        shifts = place_now - place, (turn.inv() * turn_now).as_rotvec()
        for k, key in enumerate(('position_shift_{}_m', 'orientation_shift_{}_rad')):
            sigma = float(np.sqrt(np.max(variances[k] + variances_now[k])))
            size = float(np.linalg.norm(shifts[k]))
            found[key.format(name)] = IntervalEstimate(
                size, max(size - wide * sigma, 0), size + wide * sigma
            )
    return found


def _mean(poses: PoseSequence) -> tuple[Array, Rotation, Array, Array]:
    """Mean position and rotation, and the variances of both by axis."""
    if poses.size < FEWEST_REST_POSES:
        raise FitError(
            f'{poses.name}: a tool at rest needs at least {FEWEST_REST_POSES} poses, '
            f'got {poses.size}'
        )
    point = point_of(poses)
    middle = Rotation.from_matrix(point.rotation)
    angles = (middle.inv() * Rotation.from_quat(poses.quaternion)).as_rotvec()
    variances = [
        np.array([np.var(v[:, k]) / independent_for_mean(v[:, k]) for k in range(3)])
        for v in (poses.position, angles)
    ]
    return point.position, middle, variances[0], variances[1]
