"""Publishes poses: one pair of topics per sensor or body, and /tf where it is installed."""

import math
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TransformStamped

from anser_ros.nodes.runtime import qos
from anser_ros.nodes.runtime.diagnostics import Level, Status
from anser_ros.pose_states import OK, STALE
from anser_ros.stamps import SECOND_NS, is_live
from anser_ros.tracking.estimate import PoseEstimate
from anser_ros.tracking.rotations import quaternion_of_axis, quaternion_of_rotation
from anser_ros.wire.setup import topic_of

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # the wheels don't have it
    TFMessage = None


@dataclass
class Tally:
    """Counts what happened to one sensor or body since the last diagnostics."""

    begin_s: float = field(default_factory=time.monotonic)
    frames: int = 0
    poses: int = 0
    latency_s: float = math.nan
    latest_s: float = -math.inf


class PoseTopic:
    """Publishes a sensor's or body's two pose topics; its messages are built once, refilled."""

    def __init__(self, node: Any, name: str, frame_id: str, prefix: str = '') -> None:
        self.name = name
        stem = topic_of(name)
        self._pose = node.create_publisher(PoseStamped, f'{stem}/pose', qos.STREAM)
        self._uncertain = node.create_publisher(
            PoseWithCovarianceStamped, f'{stem}/pose_with_covariance', qos.STREAM
        )
        self._plain, self._full = PoseStamped(), PoseWithCovarianceStamped()
        board = f'{prefix}{frame_id}'
        self._plain.header.frame_id = self._full.header.frame_id = board
        self.transform = TransformStamped()
        self.transform.header.frame_id = board
        self.transform.child_frame_id = f'{prefix}{stem}'
        self._values: tuple[Any, ...] = ()
        self.estimate: PoseEstimate | None = None
        self.states: Counter[str] = Counter()
        self.tally = Tally()

    @property
    def listeners(self) -> int:
        """Return how many subscriptions get what is published now."""
        both = self._pose, self._uncertain
        return sum(publisher.get_subscription_count() for publisher in both)

    def is_matched(self, node: Any) -> bool:
        """Return whether all who subscribe to the topics would get what is published now."""
        return all(
            publisher.get_subscription_count() >= node.count_subscribers(publisher.topic_name)
            for publisher in (self._pose, self._uncertain)
        )

    def destroy(self, node: Any) -> None:
        """Take the topics off the graph."""
        node.destroy_publisher(self._pose)
        node.destroy_publisher(self._uncertain)

    def take(self, estimate: PoseEstimate, now_ns: int) -> bool:
        """Publish an estimate that is good; return whether the state is another than before."""
        changed = self.estimate is None or self.estimate.state != estimate.state
        self.estimate = estimate
        self.states[estimate.state] += 1
        self.tally.frames += 1
        self.tally.latest_s = time.monotonic()
        if estimate.state == OK:
            self._publish(estimate)
            self.tally.poses += 1
            if is_live(estimate.stamp_ns, now_ns) and estimate.stamp_ns <= now_ns:
                self.tally.latency_s = (now_ns - estimate.stamp_ns) / SECOND_NS
        return changed

    def _publish(self, estimate: PoseEstimate) -> None:
        if estimate.rotation is None:
            x, y, z, w = quaternion_of_axis(estimate.axis)
        else:
            x, y, z, w = quaternion_of_rotation(estimate.rotation)
        px, py, pz = estimate.position.tolist()
        sec, nanosec = divmod(estimate.stamp_ns, SECOND_NS)
        self._values = sec, nanosec, px, py, pz, x, y, z, w
        self._fill(self._plain.header.stamp, self._plain.pose)
        self._pose.publish(self._plain)

    def _fill(self, stamp: Any, pose: Any) -> None:
        """Write the pose just taken into a message."""
        place, turn = pose.position, pose.orientation
        stamp.sec, stamp.nanosec, place.x, place.y, place.z, *_ = self._values
        turn.x, turn.y, turn.z, turn.w = self._values[5:]

    def publish_covariance(self) -> None:
        """Publish the good pose just taken once more, with its covariance.

        This is a separate step, so that no sensor's plain pose waits for the other messages of
        another sensor.
        """
        if self.estimate is None or self.estimate.state != OK:
            return
        self._fill(self._full.header.stamp, self._full.pose.pose)
        self._full.pose.covariance = self.estimate.covariance.ravel()
        self._uncertain.publish(self._full)
        header, move = self.transform.header, self.transform.transform
        place, turn = move.translation, move.rotation
        header.stamp.sec, header.stamp.nanosec, place.x, place.y, place.z, *_ = self._values
        turn.x, turn.y, turn.z, turn.w = self._values[5:]

    def state(self, stale_after_s: float) -> tuple[str, str]:
        """Return the state as it is now, silence included, and its reason."""
        if self.estimate is None:
            return STALE, 'no fluxes yet'
        silent_s = time.monotonic() - self.tally.latest_s
        if silent_s > stale_after_s:
            return STALE, f'no fluxes for {silent_s:.1f} s'
        return self.estimate.state, self.estimate.reason

    def status(self, stale_after_s: float) -> Status:
        """Return the line of ``/diagnostics`` and begin a new interval."""
        tally, self.tally = self.tally, Tally(latest_s=self.tally.latest_s)
        estimate = self.estimate
        state, reason = self.state(stale_after_s)
        if estimate is None:
            return Status(self.name, Level.STALE, state, {'reason': reason})
        seconds = max(time.monotonic() - tally.begin_s, 1e-3)
        values: dict[str, object] = {
            'state': state,
            'reason': reason,
            'rate_hz': tally.poses / seconds,
            'frame_rate_hz': tally.frames / seconds,
            'latency_s': tally.latency_s,
            'sigma_position_m': estimate.sigma_position_m,
            'residual_t': estimate.residual_t,
            'chi2_per_freedom': estimate.chi2,
            'model': estimate.model_id,
        }
        values.update({f'frames_{name}': count for name, count in sorted(self.states.items())})
        level = Level.OK if state == OK else Level.STALE if state == STALE else Level.WARN
        return Status(self.name, level, state, values)


def transform_publisher(node: Any) -> Any:
    """Return a publisher of /tf, or None where its message type is not installed."""
    if TFMessage is None:
        return None
    return node.create_publisher(TFMessage, '/tf', qos.EVENTS)


def transform_message(topics: list[PoseTopic]) -> Any:
    """Return one /tf message with the transforms of these topics."""
    return TFMessage(transforms=[topic.transform for topic in topics])
