"""Keeps the last seconds of running trackers of poses as the session that they would record."""

from collections import deque
from collections.abc import Iterable, Sequence

import numpy as np

from anser_ros.poses.sequence import REFERENCE, PoseSequence, PoseSession, sequence_of
from anser_ros.stamps import NANO, Order, order_of

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
