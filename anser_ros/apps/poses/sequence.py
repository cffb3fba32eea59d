"""Holds poses over time, sessions of several streams, and the body's path between its poses."""

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.linalg import solve_banded
from scipy.spatial.transform import Rotation

from anser_ros.arrays import AnyArray, Array, Booleans
from anser_ros.errors import DiagnosisError, PlausibilityError
from anser_ros.physics.pose_track import LONGEST_GAP_S, PoseTrack
from anser_ros.stamps import NANO, Order, order_of
from anser_ros.wire.recorded import MOST_ALIKE

REFERENCE = 'optical'  # name of the reference among a session's streams
FARTHEST = 1e6
"""Coordinate, m, from which it is a marker for no pose and no position; NDI's is 3.7e28."""
MOST_MARKED = 0.5
"""Share of places with three equal coordinates, such as 0 or -9999, below which they are markers
for no pose: none is measured so, and of what was drawn or simulated they are more."""
NO_TURN = 0.1
"""Norm of a quaternion below which it is a marker for no pose; a rounded one has a norm near 1."""
LEAP_M, LEAP_RAD, LEAP_TIMES = 0.01, 0.25, 3.0
"""How far a pose is from the line between its neighbours if it leaps: m, rad, and in distances of
these from each other. A hand that shakes turns back within 5 mm at 20 poses a second."""
LEAST_STEP_S, LEAST_INTERVALS, MOST_STEPS = 0.1, 3.0, 5
"""Least leap of stamps, s and intervals, that may be a step of a clock, and most of them."""
STRETCH, FEWEST_POSES, LEAST_WAY_M = 5, 50, 3e-3
"""Poses before and after a leap that tell the pace, poses of a stream that is looked at, and the
way, m, that a body would have to go within a leap."""
LONGEST_JUMP = 3  # rounds; each takes out one pose of a run, or two from its ends
NOT_UNIT = 0.05  # how far the norm of a quaternion may be from one: smaller refuses rounded files


@dataclass(frozen=True)
class PoseSequence:
    """Holds poses of one sensor or body in the order of their stamps."""

    name: str
    time: Array  # (n,), stamps, s since the session's start, ascending
    position: Array  # (n, 3), m, in the frame of the tracker that gave them
    # (n, 4), unit, from the sensor's frame to the tracker's, in the order x y z w.
    quaternion: Array
    missing: Array  # (k,), stamps, s, under which the device said that it has no pose
    unordered: int = 0  # poses whose stamp was before that of the pose written before them
    # Time, s, and size, s, of every step of the clock that gave the stamps.
    steps: tuple[tuple[float, float], ...] = ()

    @property
    def size(self) -> int:
        """Return the number of poses."""
        return int(self.time.size)

    @property
    def rotation(self) -> Array:
        """Return rotation matrices, shape (n, 3, 3), from the sensor's frame to the tracker's."""
        return np.asarray(Rotation.from_quat(self.quaternion).as_matrix()).reshape(-1, 3, 3)

    def rows(self, keep: AnyArray | slice) -> 'PoseSequence':
        """Return the poses that are named by index, mask or slice."""
        return replace(
            self,
            time=self.time[keep],
            position=self.position[keep],
            quaternion=self.quaternion[keep],
        )

    @property
    def repeated(self) -> Booleans:
        """Return the mask (n,) of poses that are those before them, number for number."""
        same = (np.diff(self.position, axis=0) == 0).all(axis=1)
        same &= (np.diff(self.quaternion, axis=0) == 0).all(axis=1)
        return np.concatenate([[False], same]) if self.size else np.zeros(0, dtype=bool)

    def track(self) -> PoseTrack:
        """Return the first of each run of the same pose, as a track that can be interpolated."""
        fresh = self.rows(~self.repeated)
        _, first = np.unique(fresh.time, return_index=True)
        return PoseTrack(fresh.time[first], fresh.position[first], fresh.quaternion[first])


def missing_words(poses: PoseSequence) -> str:
    """Return how many poses of a stream are none, in words; empty where all are."""
    if not poses.missing.size:
        return ''
    count = poses.size + poses.missing.size
    return (
        f'{poses.missing.size} of {count} poses of {poses.name} have no numbers, and are left out'
    )


@dataclass(frozen=True)
class PoseSession:
    """Holds one recording of a tracker that gives poses, with an optical reference."""

    path: str  # where it comes from, for messages
    start_ns: int  # the stamp at time 0
    sensors: Mapping[str, PoseSequence]  # tracked poses, all of one rigid body
    # Poses of the body by the optical tracker, in the optical frame and on its own clock.
    reference: PoseSequence | None
    lost: str = ''  # what could not be read, in words; empty when nothing is missing

    @property
    def streams(self) -> dict[str, PoseSequence]:
        """All sequences by name: the sensors, and the reference, if any, as `REFERENCE`."""
        reference = self.reference
        return {**self.sensors, **({} if reference is None else {REFERENCE: reference})}


def jumping_poses(poses: PoseSequence) -> Booleans:
    """Return the mask (n,) of poses, at most a few in a row, that leap away from their neighbours.

    A marker found in its second solution does this: it is far away between two poses that agree.
    """
    away = np.zeros(poses.size, dtype=bool)
    for _ in range(LONGEST_JUMP):
        rows = np.flatnonzero(~away)
        if rows.size < 5:
            break
        near = poses.rows(rows)
        share = (near.time[1:-1] - near.time[:-2]) / np.maximum(
            near.time[2:] - near.time[:-2], 1e-9
        )
        between = near.position[:-2] + share[:, None] * (near.position[2:] - near.position[:-2])
        far = np.linalg.norm(near.position[1:-1] - between, axis=1)
        wide = np.linalg.norm(near.position[2:] - near.position[:-2], axis=1)
        turns = Rotation.from_quat(near.quaternion)
        turned = (turns[:-2].inv() * turns[1:-1]).magnitude()
        around = (turns[:-2].inv() * turns[2:]).magnitude()
        leap = (far > LEAP_M) & (far > LEAP_TIMES * wide)
        leap |= (turned > LEAP_RAD) & (turned > LEAP_TIMES * around)
        leap &= near.time[2:] - near.time[:-2] < LONGEST_GAP_S * 4
        if not leap.any():
            break
        away[rows[1:-1][leap]] = True
    return away


def sequence_of(name: str, time: Array, position: Array, quaternion: Array) -> PoseSequence:
    """Return a sequence from rows as they were written: sorted, markers for no pose taken out.

    ``time`` (n,): s, in any order; ``position`` (n, 3): m; not finite, or beyond all measure,
    where there is no pose; ``quaternion`` (n, 4): in the order x y z w, of unit length up to
    rounding; zero or not finite for no pose. Raises `PlausibilityError` when quaternions that are
    no markers are not of unit length.
    """
    norm = np.linalg.norm(quaternion, axis=1)
    whole = np.isfinite(position).all(axis=1) & (np.abs(position) < FARTHEST).all(axis=1)
    whole &= np.isfinite(norm) & (norm > NO_TURN) & (norm < FARTHEST)
    alike = whole & (position == position[:, :1]).all(axis=1)
    if alike.sum() < MOST_MARKED * whole.sum():
        whole &= ~alike
    crooked = whole & (np.abs(norm - 1) > NOT_UNIT)
    if 2 * int(crooked.sum()) > max(int(whole.sum()), 1):
        raise PlausibilityError(
            f'{name}: quaternions have a norm of {np.median(norm[whole]):.3g}, not 1'
        )
    whole &= ~crooked
    turn = quaternion[whole] / norm[whole, None]
    rows = np.column_stack([time[whole], position[whole], turn])
    rows = rows[np.argsort(rows[:, 0], kind='stable')]
    rows = rows[(np.diff(rows, axis=0, prepend=np.nan) != 0).any(axis=1)]  # some stand twice
    return PoseSequence(
        name,
        rows[:, 0],
        rows[:, 1:4],
        rows[:, 4:],
        np.sort(time[~whole]),
        int(np.count_nonzero(np.diff(time) < 0)),
        _steps(time[whole], position[whole]),
    )


def _steps(time: Array, position: Array) -> tuple[tuple[float, float], ...]:
    """Where stamps leap while the body goes on as from one pose to the next: a clock was set."""
    if time.size < FEWEST_POSES:
        return ()
    gaps = np.diff(time)
    usual = float(np.median(gaps))
    leaps = np.flatnonzero(np.abs(gaps - usual) > max(LEAST_STEP_S, LEAST_INTERVALS * usual))
    found = []
    for k in leaps[: MOST_STEPS + 1]:
        if usual <= 0.0 or k < STRETCH or k + STRETCH + 1 >= time.size:
            continue
        before = (position[k] - position[k - STRETCH]) / STRETCH
        after = (position[k + 1 + STRETCH] - position[k + 1]) / STRETCH
        pace = 0.5 * (before + after)
        way = float(np.linalg.norm(pace) * abs(gaps[k]) / usual)
        off = np.linalg.norm(position[k + 1] - position[k] - pace)
        turned = np.linalg.norm(after - before)
        if way > LEAST_WAY_M and off < 0.2 * way and turned < 0.5 * np.linalg.norm(pace):
            found.append((float(time[k]), float(gaps[k] - usual)))
    return tuple(found) if len(found) <= MOST_STEPS else ()


def stamp_words(session: PoseSession) -> str:
    """Return where clocks of a session step, in words.

    Raises `PlausibilityError` when several poses of a stream have each stamp.
    """
    words = []
    for name, poses in session.streams.items():
        stamps = np.unique(poses.time)
        each = poses.size / max(stamps.size, 1)
        if poses.size >= FEWEST_POSES and each > MOST_ALIKE:
            is_cut = np.allclose(np.diff(stamps), np.rint(np.diff(stamps)))
            why = 'cut to seconds?' if is_cut else 'does the driver set header.stamp?'
            raise PlausibilityError(
                f'{session.path}: {each:.0f} poses of {name} have each stamp: {why}'
            )
        words += [
            f'the clock of {name} steps by {size:.1f} s at {time:.1f} s'
            for time, size in poses.steps
        ]
    return '; '.join(words)


LIVE = 'live'  # what stands in place of a path in the sessions of running trackers
MOST_POSES = 6000  # poses of a stream that are kept at most: a minute of 100 Hz


class PoseWindow:
    """Keeps what came in the last seconds by the stamps of each stream.

    ``sensors``: names of the tracked streams; the reference is `REFERENCE`.

    ``restarts``: how often the stamps of a stream ran backwards, and all was forgotten;
    ``first_ns``: stamp of the first pose of all; 0 before.
    """

    def __init__(self, sensors: Sequence[str], length_s: float) -> None:
        self._length_ns = round(length_s / NANO)
        self._rows: dict[str, deque[tuple[int, tuple[float, ...]]]] = {
            name: deque(maxlen=MOST_POSES) for name in (*sensors, REFERENCE)
        }
        self.restarts, self.first_ns = 0, 0

    def take(self, name: str, stamp_ns: int, pose: Sequence[float]) -> None:
        """Keep a pose (x y z in m, quaternion x y z w) of a stream; NaN where it has none."""
        rows = self._rows[name]
        if order_of(stamp_ns, rows[-1][0] if rows else 0) is Order.BACK:
            self.restarts, self.first_ns = self.restarts + 1, 0
            for one in self._rows.values():
                one.clear()
        self.first_ns = self.first_ns or stamp_ns
        rows.append((stamp_ns, tuple(pose)))
        while rows[0][0] < stamp_ns - self._length_ns:
            rows.popleft()

    @property
    def span_s(self) -> float:
        """Return the time between the oldest and the newest tracked pose that is kept, s."""
        spans = [r[-1][0] - r[0][0] for n, r in self._rows.items() if n != REFERENCE and r]
        return max(spans, default=0) * NANO

    def session(self, without: Iterable[str] = ()) -> PoseSession | None:
        """Return what is in the window, without some streams; None while nothing is tracked.

        Raises `PlausibilityError` when quaternions are not of unit length.
        """
        left_out = set(without)
        kept = {n: list(r) for n, r in self._rows.items() if r and n not in left_out}
        if not set(kept) - {REFERENCE}:
            return None
        start = min(rows[0][0] for rows in kept.values())
        streams = {name: _sequence(name, rows, start) for name, rows in kept.items()}
        reference = streams.pop(REFERENCE, None)
        return PoseSession(LIVE, start, streams, reference)


def _sequence(
    name: str, rows: Sequence[tuple[int, tuple[float, ...]]], start: int
) -> PoseSequence:
    time = np.array([stamp - start for stamp, _ in rows]) * NANO
    table = np.array([pose for _, pose in rows], dtype=np.float64).reshape(-1, 7)
    return sequence_of(name, time, table[:, :3], table[:, 3:])


FEWEST_PATH_POSES = 4
"""Poses without which there is no path: a cubic piece needs the poses about it."""
MEDIAN_GAPS, NEAREST = 2.5, 0.2
"""Gap in median intervals over which a slow reference is interpolated: one pose may be lost; and
interval in these of poses of which one is enough: their stamps may err, and slopes burst."""
STEPS_A_TAU = 20
"""Steps of a filter's grid in its time constant: eight make it too short by three sigmas."""
SMALLEST_STEP_S = 0.002  # grid of a filter, s: a hand moves by 0.2 mm in it


@dataclass(frozen=True, eq=False)
class OpticalPath:
    """Describes a body's path: cubic pieces through its poses, a parabola's slopes at each."""

    knots: Array  # (m,), times of the poses, s
    longest_gap: float  # gap over which nothing is interpolated, s
    # Whether all is at rest whenever there is a pose: what differs is noise and no velocity.
    is_at_rest: bool
    _spline: CubicHermiteSpline
    source: 'OpticalPath | None' = None  # of a filtered path, known where this is known

    @classmethod
    def through(cls, track: PoseTrack, is_at_rest: bool = False) -> 'OpticalPath':
        """Return the path through a track's poses.

        Raises `DiagnosisError` when there are too few poses.
        """
        steps = np.diff(track.time, prepend=-np.inf)
        apart = steps > NEAREST * np.median(steps)
        time, place, turn = track.time[apart], track.position[apart], track.quaternion[apart]
        if time.size < FEWEST_PATH_POSES:
            raise DiagnosisError(
                f'fewer than {FEWEST_PATH_POSES} poses of the reference differ: is it at rest?'
            )
        flips = np.sign(np.einsum('ij,ij->i', turn[1:], turn[:-1]))
        turn[1:] *= np.cumprod(np.where(flips < 0, -1.0, 1.0))[:, None]
        values = np.concatenate([place, turn], axis=1)
        gap = max(LONGEST_GAP_S, MEDIAN_GAPS * float(np.median(np.diff(time))))
        # Nothing is known of the motion in a gap: each side of it is a path of its own.
        slopes = np.zeros_like(values)
        edges = np.concatenate([[0], np.flatnonzero(np.diff(time) > gap) + 1, [time.size]])
        for a, b in pairwise(edges.tolist()):
            if b - a > 1:
                slopes[a:b] = np.gradient(values[a:b], time[a:b], axis=0)
        return cls(time, gap, is_at_rest, CubicHermiteSpline(time, values, slopes))

    def at(self, time: Array) -> tuple[Array, Array, Array, Booleans]:
        """Return positions (n, 3), rotations (n, 3, 3), velocities (n, 6) in the optical frame,
        validity.

        Times without a valid path get the nearest pose, at rest.
        """
        place, turn, norm, valid = self.fixed(time)
        slopes = self._spline(np.clip(time, self.knots[0], self.knots[-1]), 1)
        rate = slopes[:, 3:] / norm
        velocity = np.zeros((time.size, 6))
        velocity[:, :3] = slopes[:, :3]
        vector, scalar, d_vector, d_scalar = turn[:, :3], turn[:, 3:], rate[:, :3], rate[:, 3:]
        velocity[:, 3:] = 2 * (d_vector * scalar - d_scalar * vector - np.cross(d_vector, vector))
        velocity[~valid | self.is_at_rest] = 0.0
        matrices = np.asarray(Rotation.from_quat(turn).as_matrix()).reshape(-1, 3, 3)
        return place, matrices, velocity, valid

    def fixed(self, time: Array) -> tuple[Array, Array, Array, Booleans]:
        """Return positions (n, 3), quaternions (n, 4), their norm before, and validity."""
        values = self._spline(np.clip(time, self.knots[0], self.knots[-1]))
        norm = np.maximum(np.linalg.norm(values[:, 3:], axis=1, keepdims=True), 1e-6)
        valid = self._valid(time)
        if self.source is not None:
            valid = valid & self.source._valid(time)
        return values[:, :3], values[:, 3:] / norm, norm, valid

    def _valid(self, time: Array) -> Booleans:
        """Where it is interpolated: between poses that are near each other."""
        right = np.clip(np.searchsorted(self.knots, time, side='left'), 1, self.knots.size - 1)
        inside = (time >= self.knots[0]) & (time <= self.knots[-1])
        near = self.knots[right] - self.knots[right - 1] <= self.longest_gap
        return np.asarray(inside & near)

    def jitter(self, lever: Array) -> float:
        """Return the rms, m a coordinate, by which a point (3,) of the body leaves its own course.

        The course is the cubic through the two poses before and the two after; a hand's motion
        leaves it by some micrometres.
        """
        place, turn, _, _ = self.at(self.knots)
        point, time = place + turn @ lever, self.knots
        four = np.arange(time.size - 4) + np.array([[0], [1], [3], [4]])
        near, about = time[four] - time[2:-2], point[four]
        weight = np.stack([_share_at_zero(near, k) for k in range(4)])
        off = point[2:-2] - np.einsum('kn,kni->ni', weight, about)
        whole = near[3] - near[0] < 4 * self.longest_gap
        size = off[whole] / np.sqrt(1 + np.sum(weight**2, axis=0))[whole, None]
        return float(np.sqrt(np.mean(size**2))) if size.size else 0.0


def _share_at_zero(nodes: Array, k: int) -> Array:
    """Lagrange's weight of node k of nodes (4, n) at zero."""
    others = [j for j in range(4) if j != k]
    return np.asarray(np.prod([-nodes[j] / (nodes[k] - nodes[j]) for j in others], axis=0))


@lru_cache(maxsize=8)  # a fit asks again and again for the same filter
def filtered(path: OpticalPath, tau: float, two_sided: bool = False) -> OpticalPath:
    """Return a path behind a first-order low pass with a time constant, s.

    Two-sided, it looks as far ahead as back, with the same width and no delay.
    """
    tau = tau / np.sqrt(2) if two_sided else tau
    step = max(SMALLEST_STEP_S, tau / STEPS_A_TAU)
    grid = np.arange(path.knots[0], path.knots[-1] + step, step)
    values = path._spline(np.minimum(grid, path.knots[-1]))
    keep = float(np.exp(-step / tau))
    # A straight line between samples goes through the filter exactly.
    late = (1 - keep) * tau / step
    passed, size = values, grid.size
    recursion = np.stack([np.ones(size), np.full(size, -keep)])
    for way in (1, -1) if two_sided else (1,):
        moved = passed[::way] - passed[::way][0]
        driven = (1 - late) * moved
        driven[1:] += (late - keep) * moved[:-1]
        passed = (solve_banded((1, 0), recursion, driven) + passed[::way][0])[::way]
    spline = CubicHermiteSpline(grid, passed, np.gradient(passed, grid, axis=0))
    return OpticalPath(grid, path.longest_gap, path.is_at_rest, spline, path)
