"""Publishes poses: one pair of topics per sensor or body, and /tf where it is installed."""

import math
import struct
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TransformStamped
from rclpy.serialization import serialize_message
from yaml import YAMLError

from anser_ros.errors import ParameterError
from anser_ros.nodes.runtime import qos
from anser_ros.nodes.runtime.diagnostics import Level, Status
from anser_ros.nodes.runtime.parameters import from_file
from anser_ros.physics.rotations import (
    quaternion_of_axis,
    quaternion_of_rotation,
    rotation_of_quaternion,
)  # fmt: skip
from anser_ros.pose_states import FRAMES_IN, OK, STALE
from anser_ros.stamps import SECOND_NS, is_live, pack_stamp, set_stamp
from anser_ros.tracking.estimate import PoseEstimate
from anser_ros.wire.recorded import unit_quaternions
from anser_ros.wire.setup import FIELD_GENERATOR, topic_of
from anser_ros.wire.text_files import read_text, read_yaml

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # the wheels don't have it
    TFMessage = None


class PackedMessage:
    """Keeps the bytes of a message of a frame that begins with a header and ends with ``count``
    doubles, which are published in half the time of a message.
    """

    def __init__(self, kind: type, frame_id: str, count: int) -> None:
        message = kind()
        message.header.frame_id = frame_id
        self._bytes = bytearray(serialize_message(message))
        self._numbers = struct.Struct(f'<{count}d')
        self._offset = len(self._bytes) - self._numbers.size

    def packed(self, stamp_ns: int, *numbers: float) -> bytes:
        """Return the message's bytes with a stamp, ns, and its numbers."""
        pack_stamp(self._bytes, stamp_ns)
        self._numbers.pack_into(self._bytes, self._offset, *numbers)
        return bytes(self._bytes)


class PoseTopic:
    """Publishes a sensor's or body's two pose topics; their bytes are made once, refilled."""

    def __init__(self, node: Any, name: str, frame_id: str, prefix: str = '') -> None:
        self.name = name
        stem = topic_of(name)
        self._pose = node.create_publisher(PoseStamped, f'{stem}/pose', qos.STREAM)
        self._uncertain = node.create_publisher(
            PoseWithCovarianceStamped, f'{stem}/pose_with_covariance', qos.STREAM
        )
        board = f'{prefix}{frame_id}'
        self._plain = PackedMessage(PoseStamped, board, 7)
        self._full = PackedMessage(PoseWithCovarianceStamped, board, 7 + 36)
        self._transform = TransformStamped()
        self._transform.header.frame_id = board
        self._transform.child_frame_id = f'{prefix}{stem}'
        self._values: tuple[float, ...] = ()
        self.estimate: PoseEstimate | None = None
        self.states: Counter[str] = Counter()
        self.latest_s, self._latency_s = -math.inf, math.nan
        self._reported = time.monotonic(), 0, 0  # and how many frames and poses there were

    @property
    def listeners(self) -> int:
        """Return how many subscriptions get what is published now."""
        return sum(one.get_subscription_count() for one in (self._pose, self._uncertain))

    def is_matched(self, node: Any) -> bool:
        """Return whether all who subscribe to the topics would get what is published now."""
        return all(
            one.get_subscription_count() >= node.count_subscribers(one.topic_name)
            for one in (self._pose, self._uncertain)
        )

    def destroy(self, node: Any) -> None:
        """Take the topics off the graph."""
        node.destroy_publisher(self._pose)
        node.destroy_publisher(self._uncertain)

    def publish(self, estimate: PoseEstimate) -> None:
        """Publish a good estimate to subscribers, and nothing else, as other topics wait."""
        if estimate.state != OK:
            return
        if estimate.rotation is None:
            x, y, z, w = quaternion_of_axis(estimate.axis)
        else:
            x, y, z, w = quaternion_of_rotation(estimate.rotation)
        self._values = *estimate.position.tolist(), x, y, z, w
        if self._pose.get_subscription_count():
            self._pose.publish(self._plain.packed(estimate.stamp_ns, *self._values))

    def note(self, estimate: PoseEstimate, now_ns: int) -> bool:
        """Count an estimate of a time, ns, and publish a good one once more, with its covariance;
        return whether the state is another than before.
        """
        changed = self.estimate is None or self.estimate.state != estimate.state
        self.estimate = estimate
        self.states[estimate.state] += 1
        self.latest_s = time.monotonic()
        if estimate.state == OK:
            if is_live(estimate.stamp_ns, now_ns) and estimate.stamp_ns <= now_ns:
                self._latency_s = (now_ns - estimate.stamp_ns) / SECOND_NS
            if self._uncertain.get_subscription_count():
                numbers = *self._values, *estimate.covariance.ravel().tolist()
                self._uncertain.publish(self._full.packed(estimate.stamp_ns, *numbers))
        return changed

    def transform(self, stamp_ns: int) -> TransformStamped:
        """Return the transform of the good pose just published, which had a stamp, ns."""
        moved = self._transform
        set_stamp(moved.header.stamp, stamp_ns)
        fill(moved, self._values)
        return moved

    def state(self, stale_after_s: float) -> tuple[str, str]:
        """Return the state as it is now, silence included, and its reason."""
        if self.estimate is None:
            return STALE, 'no fluxes yet'
        silent_s = time.monotonic() - self.latest_s
        if silent_s > stale_after_s:
            return STALE, f'no fluxes for {silent_s:.1f} s'
        return self.estimate.state, self.estimate.reason

    def status(self, stale_after_s: float) -> Status:
        """Return the line of ``/diagnostics`` and begin a new interval."""
        begin_s, frames, poses = self._reported
        self._reported = time.monotonic(), self.states.total(), self.states[OK]
        seconds = max(self._reported[0] - begin_s, 1e-3)
        latency_s, self._latency_s = self._latency_s, math.nan
        estimate = self.estimate
        state, reason = self.state(stale_after_s)
        if estimate is None:
            return Status(self.name, Level.STALE, state, {'reason': reason})
        values: dict[str, object] = {
            'state': state,
            'reason': reason,
            'rate_hz': (self._reported[2] - poses) / seconds,
            'frame_rate_hz': (self._reported[1] - frames) / seconds,
            'latency_s': latency_s,
            'sigma_position_m': estimate.sigma_position_m,
            'residual_t': estimate.residual_t,
            'chi2_per_freedom': estimate.chi2,
            'checks': estimate.checks,
            'model': estimate.model_id,
        }
        values.update({f'{FRAMES_IN}{name}': count for name, count in sorted(self.states.items())})
        level = Level.OK if state == OK else Level.STALE if state == STALE else Level.WARN
        return Status(self.name, level, state, values)


def board_pose_of(table: Any) -> tuple[float, ...]:
    """Return x y z, m, and quaternion x y z w of the board that a tracker's parameters state.

    A file of ``anser handeye`` has the way from the other tracker's frame to the board's. Raises
    `ParameterError` when a pose is no pose, or is missing where there is a parent frame.
    """
    stated: tuple[float, ...] = table.board_pose
    numbers: tuple[float, ...] = from_file(
        'registration_file', table.registration_file, _registration, stated
    )
    is_pose = len(numbers) == 7 and bool(np.isfinite(unit_quaternions(numbers[3:])).all())
    if not (is_pose and np.isfinite(numbers).all()) and (numbers or table.parent_frame):
        raise ParameterError(f'parameter board_pose: x y z qx qy qz qw needed, got {numbers}')
    return numbers


def _registration(path: Path) -> tuple[float, ...]:
    """The board's pose of a file; raises `ParameterError` when it has none."""
    try:
        found = read_yaml(read_text(path))
        if 'board_pose' in found:
            return tuple(map(float, found['board_pose']))
        turn = rotation_of_quaternion(np.array(found['registration_quaternion_xyzw'])).T
        place = -turn @ np.array(found['registration_translation_m'], dtype=float)
    except (KeyError, TypeError, ValueError, YAMLError) as error:
        raise ParameterError(f'{path}: no pose ({error})') from error
    return *place.tolist(), *quaternion_of_rotation(turn)


def state_board(node: Any, publisher: Any, table: Any) -> Any:
    """State the board's pose in its parent frame, if it has one, for those who come later too.

    Return the publisher of /tf_static, which is made with the first statement.
    """
    numbers = board_pose_of(table)
    if not table.parent_frame:
        return publisher
    if TFMessage is None:
        node.warn('no_tf_static', 'no /tf_static: tf2_msgs is not installed')
        return publisher
    publisher = publisher or node.create_publisher(TFMessage, '/tf_static', qos.LATCHED)
    found = TransformStamped(child_frame_id=f'{table.frame_prefix}{FIELD_GENERATOR}')
    found.header.frame_id = table.parent_frame
    found.header.stamp = node.get_clock().now().to_msg()
    fill(found, numbers)
    publisher.publish(TFMessage(transforms=[found]))
    return publisher


def fill(moved: TransformStamped, numbers: tuple[float, ...]) -> None:
    """Write x y z, m, and the quaternion x y z w into a transform."""
    place, turn = moved.transform.translation, moved.transform.rotation
    place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w = numbers


def transform_publisher(node: Any) -> Any:
    """Return a publisher of /tf, or None where its message type is not installed."""
    return None if TFMessage is None else node.create_publisher(TFMessage, '/tf', qos.EVENTS)


def transform_message(topics: list[PoseTopic], stamp_ns: int) -> Any:
    """Return one /tf message with the transforms of these topics."""
    return TFMessage(transforms=[topic.transform(stamp_ns) for topic in topics])
