"""Holds poses over time, sessions of several streams, and the last seconds of running trackers."""

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from anser_ros.errors import PlausibilityError
from anser_ros.physics.pose_track import LONGEST_GAP_S, PoseTrack
from anser_ros.stamps import NANO, Order, order_of

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

REFERENCE = 'optical'
"""Name of the reference among a session's streams."""
FARTHEST = 1e6
"""Coordinate, m, from which on it is a device's marker for no pose and no position: no tracker
sees a thousand kilometres, NDI's marker is 3.7e28."""
NO_TURN = 0.1
"""Norm of a quaternion below which it is a marker for no pose; a rounded one has a norm near 1."""
LEAP_M, LEAP_RAD, LEAP_TIMES = 0.01, 0.25, 3.0
"""How far a pose is from the line between its neighbours if it leaps: m, rad, and in distances of
these from each other. A hand that shakes turns back within 5 mm at 20 poses a second."""
LONGEST_JUMP = 3  # rounds; each takes out one pose of a run, or two from its ends
NOT_UNIT = 0.05
"""How far the norm of a quaternion may be from one: four digits are given by the coarsest form.
Smaller refuses rounded files; larger takes other numbers for quaternions."""


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

    @property
    def size(self) -> int:
        """Return the number of poses."""
        return int(self.time.size)

    @property
    def rotation(self) -> Array:
        """Return rotation matrices, shape (n, 3, 3), from the sensor's frame to the tracker's."""
        return np.asarray(Rotation.from_quat(self.quaternion).as_matrix()).reshape(-1, 3, 3)

    def rows(self, keep: NDArray[np.generic] | slice) -> 'PoseSequence':
        """Return the poses that are named by index, mask or slice."""
        return replace(
            self,
            time=self.time[keep],
            position=self.position[keep],
            quaternion=self.quaternion[keep],
        )

    @property
    def repeated(self) -> Mask:
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


def jumping_poses(poses: PoseSequence) -> Mask:
    """Return the mask (n,) of single poses, or a few, that leap away from those before and after
    them.

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
    rounding; zero or not finite for no pose.

    Raises `PlausibilityError` when quaternions that are no markers are not of unit length.
    """
    norm = np.linalg.norm(quaternion, axis=1)
    whole = np.isfinite(position).all(axis=1) & (np.abs(position) < FARTHEST).all(axis=1)
    whole &= np.isfinite(norm) & (norm > NO_TURN) & (norm < FARTHEST)
    crooked = whole & (np.abs(norm - 1) > NOT_UNIT)
    if 2 * int(crooked.sum()) > max(int(whole.sum()), 1):
        raise PlausibilityError(
            f'{name}: quaternions have a norm of {np.median(norm[whole]):.3g}, not 1'
        )
    whole &= ~crooked
    order = np.argsort(time[whole], kind='stable')
    return PoseSequence(
        name,
        time[whole][order],
        position[whole][order],
        (quaternion[whole] / norm[whole, None])[order],
        np.sort(time[~whole]),
        int(np.count_nonzero(np.diff(time) < 0)),
    )


LIVE = 'live'
"""What stands in place of a path in the sessions of running trackers."""
MOST_POSES = 6000
"""Poses of a stream that are kept at most: a minute of 100 Hz."""


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
