"""Who watches the graph from outside: poses, states and the exact truth, as they came."""

import bisect
import threading
import time
from collections import defaultdict
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.wire.setup import Setup, topic_of

NANO = 1e-9
"""Seconds in a nanosecond."""
FAR_M = 1e-3
"""An error is wrong beyond this, m, if it is beyond `MANY_SIGMAS` too."""
MANY_SIGMAS = 3.0
"""An error is wrong beyond so many stated sigmas, if it is beyond `FAR_M` too."""
WINDOW_S = 0.4
"""Length of the window, s, in which poses must come again for a chain to count as recovered: ten
frames, of which half must have a pose."""

TRUTH_GAP_S = 0.25
"""True poses further apart, s, tell nothing of the time between: the unit was started anew, and
its truth was heard later than its samples. Between closer ones a line is followed."""


class SeenPose(NamedTuple):
    """One pose, with its place and sigma."""

    arrival_s: float  # monotonic
    name: str
    stamp_s: float
    place: np.ndarray  # m
    sigma_m: float


class SeenState(NamedTuple):
    """One status line when it changed."""

    arrival_s: float  # monotonic
    name: str
    level: int
    words: str


class Witness:
    """A node in a thread of its own that keeps all that comes, and can publish and call too."""

    def __init__(self, setup: Setup, domain: int) -> None:
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
        from rclpy.executors import ExternalShutdownException
        from sensor_msgs.msg import PointCloud2

        from anser_ros.nodes.runtime import qos

        self.setup = setup
        self.poses: list[SeenPose] = []
        self.states: list[SeenState] = []
        self.last_flux: dict[str, Any] = {}
        self._truth: dict[str, list[tuple[float, ...]]] = defaultdict(list)
        self._words: dict[str, tuple[int, str]] = {}
        self.heard_s: dict[str, float] = {}
        self.values: dict[str, dict[str, str]] = {}
        self.context = rclpy.Context()
        self.context.init(domain_id=domain)
        self.node = rclpy.create_node('witness', namespace='anser', context=self.context)
        self._ended = ExternalShutdownException
        for name in (*(s.name for s in setup.tool_sensors), *setup.bodies):
            self.node.create_subscription(
                PoseWithCovarianceStamped, f'{topic_of(name)}/pose_with_covariance',
                self._pose_taker(name), qos.STREAM,
            )  # fmt: skip
        for body in setup.bodies:
            self.node.create_subscription(
                PoseStamped, f'/optical/{topic_of(body)}/pose', self._truth_taker(body), qos.STREAM
            )
        self.node.create_subscription(
            DiagnosticArray, '/diagnostics', self._on_diagnostics, qos.EVENTS
        )
        for which in ('tool', 'reference'):
            self.node.create_subscription(
                PointCloud2, f'{which}/flux', self._flux_taker(which), qos.STREAM
            )
        self._executor = make_executor(self.context)
        self._executor.add_node(self.node)
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._spin, name='witness', daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        while not self._ending.is_set():
            try:
                self._executor.spin_once(timeout_sec=0.1)
            except self._ended:
                return

    def close(self) -> None:
        """Leave the graph."""
        self._ending.set()
        self._thread.join(2.0)
        self._executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()

    def _pose_taker(self, name: str) -> Any:
        def take(message: Any) -> None:
            place, variance = message.pose.pose.position, message.pose.covariance
            self.poses.append(
                SeenPose(
                    time.monotonic(), name, stamp_s(message),
                    np.array([place.x, place.y, place.z]),
                    float(np.sqrt(variance[0] + variance[7] + variance[14])),
                )
            )  # fmt: skip

        return take

    def _truth_taker(self, body: str) -> Any:
        def take(message: Any) -> None:
            p, q = message.pose.position, message.pose.orientation
            self._truth[body].append((stamp_s(message), p.x, p.y, p.z, q.x, q.y, q.z, q.w))

        return take

    def _flux_taker(self, which: str) -> Any:
        def take(message: Any) -> None:
            self.last_flux[which] = message

        return take

    def _on_diagnostics(self, message: Any) -> None:
        now = time.monotonic()
        for status in message.status:
            seen = (status.level[0], status.message)
            self.heard_s[status.name] = now
            self.values[status.name] = {pair.key: pair.value for pair in status.values}
            if self._words.get(status.name) != seen:
                self._words[status.name] = seen
                self.states.append(SeenState(now, status.name, *seen))

    def forget_truth(self) -> None:
        """Forget the true poses so far."""
        for rows in self._truth.values():
            rows.clear()

    def count(self, since_s: float, until_s: float) -> dict[str, int]:
        """Return the number of poses by name that came in a time."""
        found: dict[str, int] = defaultdict(int)
        for pose in reversed(self.poses):
            if pose.arrival_s < since_s:
                break
            if pose.arrival_s < until_s:
                found[pose.name] += 1
        return found

    def errors(self, since_s: float, until_s: float) -> list[tuple[SeenPose, float]]:
        """Return the poses that came in a time with their errors, m; infinite without a truth.

        Those of a time in which the unit's truth was not heard, as after its restart, are not
        among them.
        """
        chosen = [pose for pose in self.poses if since_s <= pose.arrival_s < until_s]
        tracks = {body: _Track(rows) for body, rows in self._truth.items() if len(rows) > 1}
        specs = {spec.name: spec for spec in self.setup.tool_sensors}
        out = []
        for pose in chosen:
            spec = specs.get(pose.name)
            track = tracks.get(spec.body if spec is not None else pose.name)
            if track is not None and track.lacks(pose.stamp_s):
                continue
            local = np.zeros(3) if spec is None else np.array(spec.position_m)
            truth = None if track is None else track.at(pose.stamp_s, local)
            error = np.inf if truth is None else float(np.linalg.norm(pose.place - truth))
            out.append((pose, error))
        return out


class _Track:
    """The true poses of a body."""

    def __init__(self, rows: list[tuple[float, ...]]) -> None:
        table = sorted(rows)
        self._time = [row[0] for row in table]
        self._rows = np.array(table)

    def lacks(self, time_s: float) -> bool:
        """Return whether a time is in a gap between true poses."""
        right = bisect.bisect_left(self._time, time_s)
        inside = 0 < right < len(self._time)
        return inside and self._time[right] - self._time[right - 1] > TRUTH_GAP_S

    def at(self, time_s: float, local: np.ndarray) -> np.ndarray | None:
        """Return where a point of the body (m) was at a time."""
        right = bisect.bisect_left(self._time, time_s)
        if right in (0, len(self._time)):
            return None
        left = right - 1
        span = self._time[right] - self._time[left]
        share = (time_s - self._time[left]) / span if span > 0 else 0.0
        one, two = self._rows[left], self._rows[right]
        other = two[4:] if one[4:] @ two[4:] > 0 else -two[4:]
        turn = Rotation.from_quat(one[4:] + share * (other - one[4:]))
        return one[1:4] + share * (two[1:4] - one[1:4]) + turn.apply(local)


def is_wrong(pose: SeenPose, error_m: float) -> bool:
    """Return whether a pose that was published is so wrong that it should not have been."""
    return error_m > max(MANY_SIGMAS * pose.sigma_m, FAR_M)


def stamp_s(message: Any) -> float:
    """Return the stamp of a message, s."""
    return message.header.stamp.sec + NANO * message.header.stamp.nanosec


def make_executor(context: Any) -> Any:
    """Return an executor for a context that is not the process's."""
    from rclpy.executors import SingleThreadedExecutor

    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:
        return SingleThreadedExecutor(context=context)
    return EventsExecutor(context=context)
