"""Holds what the live view shows: the newest of every coil and body, and their last minutes."""

import math
import struct
import time
from collections import deque
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from anser_ros.apps.dashboard.nodes import traces
from anser_ros.arrays import Array
from anser_ros.nodes.operator_words import causes
from anser_ros.nodes.runtime.diagnostics import LastStatus
from anser_ros.wire.setup import Setup

HISTORY = 240
"""Points of the curves over time: two minutes at half a second per point."""
FRESH_S = 0.6
"""Age, s, up to which a pose is shown: at the lowest rate of poses, 5 Hz, three are missing."""
OPTICAL_KEPT = 400
"""Optical poses kept of a body, some seconds: the next point of the curves needs the last."""
WINDOW_S = 10.0
"""Time over which the figures before and after a change are taken, s."""
SIGMAS = 3.0
"""Half axes of the ellipsoids, in standard deviations: 97 % of positions lie inside."""
POSE, COVARIANCE = 7, 36
"""Numbers of a pose, and of its covariance."""


def read_pose(data: bytes) -> tuple[float, Array]:
    """Return stamp (s) and the numbers (7 or 43) of a serialised pose, with covariance or without.

    Raises `ValueError`, `struct.error` when the bytes are no such message.
    """
    order = '<' if data[1] & 1 else '>'
    sec, nanosec, length = struct.unpack_from(f'{order}iII', data, 4)
    # Doubles lie at multiples of eight, counted from behind the four bytes of the header.
    offset = 4 + 8 * math.ceil((12 + length) / 8)
    if (len(data) - offset) // 8 not in (POSE, POSE + COVARIANCE):
        raise ValueError(f'{len(data)} bytes are not a pose message')
    count = (len(data) - offset) // 8
    return sec + 1e-9 * nanosec, np.frombuffer(data, f'{order}f8', count, offset).astype(float)


class LiveView:
    """Holds arrays of all targets, by their numbers.

    ``statuses`` has what nodes reported last, by ``node`` or ``node: part``.
    """

    def __init__(
        self, setup: Setup, namespace: str, statuses: dict[str, LastStatus] | None = None
    ) -> None:
        self.setup, self.namespace = setup, namespace
        self.statuses = {} if statuses is None else statuses
        self.targets = traces.targets_of(setup)
        self.bodies = {target.body for target in self.targets}
        count = len(self.targets)
        self._received_s = np.full(count, -np.inf)
        self._pose = np.full((count, POSE), np.nan)
        self._covariance = np.full((count, 3, 3), np.nan)
        self._optical = {body: traces.OpticalTrace() for body in self.bodies}
        self._recent = [traces.PoseTrace(target) for target in self.targets]
        self._came = np.zeros(count)
        self._latency_s: list[float] = []
        self._since_s = time.monotonic()
        self.rate_hz = np.zeros(count)
        self.latency_s = math.nan
        # Distance to the optical pose at the last point, m; NaN where none is.
        self.error_m = np.full(count, np.nan)
        self.points: deque[tuple[float, Array, Array, Array]] = deque(maxlen=HISTORY)

    # What comes in ------------------------------------------------------------------------

    def take_pose(self, number: int, received: Iterable[tuple[bytes, Mapping[str, int]]]) -> None:
        """Take the poses of a target that have come, of which the last one is shown."""
        messages = list(received)
        if not messages:
            return
        self._came[number] += len(messages)
        newest, info = messages[-1]
        sent_ns = info.get('received_timestamp') or info.get('source_timestamp') or 0
        stamp_s, values = read_pose(newest)
        if not np.isfinite(values).all():
            raise ValueError('a pose is not finite')
        self._pose[number] = values[:POSE]
        self._covariance[number] = values[POSE:].reshape(6, 6)[:3, :3]
        self._received_s[number] = time.monotonic()
        if sent_ns:
            self._latency_s.append(traces.latency_of(1e-9 * sent_ns, stamp_s))
        self._recent[number].stamp_s.append(stamp_s)
        self._recent[number].position.append(tuple(values[:3]))

    def take_optical(self, body: str, received: Iterable[tuple[bytes, Mapping[str, int]]]) -> None:
        trace = self._optical[body]
        for data, _ in received:
            stamp_s, values = read_pose(data)
            trace.add(stamp_s, tuple(values[:3]), tuple(values[3:POSE]))
        trace.forget(OPTICAL_KEPT)

    # What is shown ------------------------------------------------------------------------

    def frame(self) -> list[Any]:
        """Return for every target its place, quaternion and half axes (m), or None without pose.

        A row has 16 numbers: x, y, z, qx, qy, qz, qw and three vectors, the half axes.
        """
        fresh = time.monotonic() - self._received_s < FRESH_S
        rows: list[Any] = [None] * len(self.targets)
        index = np.flatnonzero(fresh)
        if index.size:
            variance, turn = np.linalg.eigh(self._covariance[index])
            axes = turn * (SIGMAS * np.sqrt(np.maximum(variance, 0.0)))[:, None, :]
            values = np.concatenate(
                [self._pose[index], axes.transpose(0, 2, 1).reshape(len(index), 9)], axis=1
            )
            for number, row in zip(index.tolist(), values.round(6).tolist(), strict=True):
                rows[number] = row
        return rows

    def sigma_m(self) -> Array:
        """Return the poses' own uncertainty, m; NaN where no pose came lately."""
        trace: Array = np.trace(self._covariance, axis1=1, axis2=2)
        fresh = time.monotonic() - self._received_s < FRESH_S
        return np.where(fresh, np.sqrt(trace), np.nan)

    def last_status(self, name: str) -> LastStatus:
        """Return the last status of a target from the tracker."""
        return self.statuses.get(f'{self.namespace}/tracker: {name}', LastStatus(1, 'waiting', {}))

    def residual_t(self) -> Array:
        """Return the residual of every target's fluxes, T."""
        return np.array([_number(self.last_status(t.name), 'residual_t') for t in self.targets])

    def tracked(self) -> Array:
        """Return the share of frames with a pose of every target."""
        pairs = [
            [_number(self.last_status(t.name), key) for key in ('rate_hz', 'frame_rate_hz')]
            for t in self.targets
        ]
        poses, frames = np.array(pairs).reshape(-1, 2).T
        shares = np.full(len(poses), np.nan)
        np.divide(poses, frames, out=shares, where=frames > 0)
        return shares

    def reasons(self) -> list[str]:
        return causes(self.statuses, self.namespace, self.setup.flux_rate_hz)

    def add_point(self) -> None:
        """Work out rates, and the next point of the curves: time, error, residual, tracked."""
        now_s = time.monotonic()
        elapsed_s = max(now_s - self._since_s, 1e-3)
        self.rate_hz, self._since_s = self._came / elapsed_s, now_s
        self._came = np.zeros(len(self.targets))
        if self._latency_s:
            self.latency_s = float(np.median(self._latency_s))
            self._latency_s = []
        self.error_m = self._errors()
        self.points.append((time.time(), self.error_m, self.residual_t(), self.tracked()))

    def _errors(self) -> Array:
        optical = {body: trace.track() for body, trace in self._optical.items()}
        found = np.full(len(self.targets), np.nan)
        for number, recent in enumerate(self._recent):
            track = optical[recent.target.body]
            if track is not None:
                found[number] = traces.middle(recent.distances(track), _rms)
        self._recent = [traces.PoseTrace(target) for target in self.targets]
        return found

    def figures(self, since_s: float = -math.inf) -> dict[str, float | None]:
        """Return how well it went lately, not before a time (of ``time.time``), over all coils.

        These are the mean share of frames with a pose, the root mean square distance of poses from
        the optical ones, and that of all fluxes from the model.
        """
        begin_s = max(since_s, time.time() - WINDOW_S)
        points = [point[1:] for point in self.points if point[0] >= begin_s]
        coils = len(self.setup.tool_sensors)
        columns = zip(*points, strict=True) if points else ((),) * 3
        error, residual, tracked = (np.array(values)[..., :coils] for values in columns)
        return {
            'tracked_percent': known(100.0 * traces.middle(tracked, np.mean)),
            'error_mm': known(1e3 * traces.middle(error, _rms)),
            'residual_pt': known(1e12 * traces.middle(residual, _rms)),
        }


def known(value: float, digits: int = 3) -> float | None:
    """Return a number as a page takes it: rounded, None where it is not known."""
    return round(float(value), digits) if math.isfinite(value) else None


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _number(status: LastStatus | None, key: str) -> float:
    try:
        return math.nan if status is None else float(status.values[key])
    except (KeyError, ValueError):
        return math.nan
