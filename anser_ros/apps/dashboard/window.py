"""Keeps the last seconds of a live system as a session."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from anser_ros.sessions.session import Session, session_of
from anser_ros.stamps import NANO, Order, order_of
from anser_ros.wire.points import FluxPoints
from anser_ros.wire.recorded import Bag, PoseStream, RecordedFluxes, unit_quaternions
from anser_ros.wire.setup import Setup

LIVE = 'live'
"""What stands in place of a path in the sessions of a running system."""
MARGIN_NS = 1_000_000_000
"""How much longer than fluxes poses are kept, ns, because their clock may be ahead."""


@dataclass
class _Fluxes:
    """Readings of one topic: stamp, fluxes (S, K) and flags (S,), all of the same channels."""

    channel: NDArray[np.int64] | None = None
    rows: deque[tuple[int, NDArray[np.complex128], NDArray[np.int64]]] = field(
        default_factory=deque
    )

    def stream(self) -> RecordedFluxes | None:
        if not self.rows or self.channel is None:
            return None
        stamps, flux, flags = zip(*self.rows, strict=True)
        return RecordedFluxes(np.array(stamps), self.channel, np.array(flags), np.array(flux))


class SlidingWindow:
    """Keeps what came in the last seconds by the stamps, thinned to a number of frames.

    ``frames`` is the most readings of a topic that are kept, spread evenly over the window;
    ``first_ns`` the stamp of the first reading of all, 0 before; ``restarts`` how often time ran
    backwards, and all was forgotten.
    """

    def __init__(self, setup: Setup, length_s: float, frames: int) -> None:
        self.setup = setup
        self._length_ns = round(length_s / NANO)
        self._step_ns = self._length_ns // frames
        self.first_ns, self.restarts = 0, 0
        self._tool, self._reference = _Fluxes(), _Fluxes()
        self._poses: dict[str, deque[tuple[int, tuple[float, ...]]]] = {}

    def take_tool(self, stamp_ns: int, points: FluxPoints) -> None:
        """Keep the tools' fluxes of one stamp, unless they are late or too close to the last."""
        self._take(self._tool, stamp_ns, points)

    def take_reference(self, stamp_ns: int, points: FluxPoints) -> None:
        """Keep the references' fluxes of one stamp, under the same rule."""
        self._take(self._reference, stamp_ns, points)

    def take_pose(self, body: str, stamp_ns: int, pose: Sequence[float]) -> None:
        """Keep an optical pose (x y z in m, quaternion x y z w), unless it is late or no pose."""
        values = (*pose[:3], *unit_quaternions(pose[3:]).tolist())
        if not np.isfinite(values).all():
            return
        rows = self._poses.setdefault(body, deque())
        order = order_of(stamp_ns, rows[-1][0] if rows else 0)
        if order in (Order.SAME, Order.LATE):
            return
        if order is Order.BACK:
            rows.clear()
        rows.append((stamp_ns, values))
        # The poses' clock may be ahead of the fluxes'.
        while rows[0][0] < stamp_ns - self._length_ns - MARGIN_NS:
            rows.popleft()

    def _take(self, fluxes: _Fluxes, stamp_ns: int, points: FluxPoints) -> None:
        channel = np.asarray(points.channel, dtype=np.int64)
        rows = fluxes.rows
        if order_of(stamp_ns, rows[-1][0] if rows else 0) is Order.BACK:
            self._forget()
        elif rows and stamp_ns < rows[-1][0] + self._step_ns:
            return
        if fluxes.channel is None or not np.array_equal(channel, fluxes.channel):
            fluxes.channel = channel
            rows.clear()
        self.first_ns = self.first_ns or stamp_ns
        rows.append((stamp_ns, np.array(points.flux), np.array(points.flags, dtype=np.int64)))
        while rows[0][0] < stamp_ns - self._length_ns:
            rows.popleft()

    def _forget(self) -> None:
        """Start again: a replay has begun again, or the clock was set."""
        self.restarts += 1
        self.first_ns = 0
        self._tool.rows.clear()
        self._reference.rows.clear()

    @property
    def span_s(self) -> float:
        """Return the time between the oldest and the newest reading that is kept, s."""
        spans = [f.rows[-1][0] - f.rows[0][0] for f in (self._tool, self._reference) if f.rows]
        return max(spans, default=0) * NANO

    def session(self) -> Session | None:
        """Return what is in the window, None without fluxes; raises `BagError` as `session_of`."""
        tool, reference = self._tool.stream(), self._reference.stream()
        if tool is None and reference is None:
            return None
        optical = {}
        for body, rows in self._poses.items():
            values = np.array([pose for _, pose in rows])
            stamps = np.array([stamp for stamp, _ in rows])
            optical[body] = PoseStream(stamps, values[:, :3], values[:, 3:])
        return session_of(Bag(LIVE, self.setup, '', tool, reference, optical))
