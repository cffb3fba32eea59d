"""Finds where a tool rested: pauses of a recording, each a point with mean pose and scatter."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from anser_ros.apps.poses.sequence import PoseSequence
from anser_ros.errors import FitError

Array = NDArray[np.float64]

WINDOW_S, WINDOW_POSES = 0.25, 3.0
"""Window whose middle pose is compared with its neighbours', s and poses: noise has fallen in it,
and a hand has moved by more than a pause may."""
FEWEST_WINDOWS = 4
"""Windows of a pause, each half over the one before: fewer don't show whether the tool moved."""
NOISE_TIMES = 5.0  # windows' own scatter by which their middle may differ in a pause
LEAST_MOVE_M, LEAST_MOVE_RAD = 0.7e-3, 0.012
"""Difference that is a move whatever the noise: m, rad. A hand that holds a tool on a divot moves
it by less."""
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

    Raises
    ------
    FitError
        When there is no pose.
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
    """Return all pauses of a recording, in their order.

    Parameters
    ----------
    poses : PoseSequence
    rule : PauseRule, optional
    """
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
    """A run without its first and last window, in which the tool came and went; one of all windows
    is a recording in which it did not, and is kept whole.
    """
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
