"""Holds a recorded session as arrays, names topics of poses, and judges quaternions."""

import re
import unicodedata
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from anser_ros.arrays import Array, ComplexArray, Integers
from anser_ros.errors import ParameterError
from anser_ros.stamps import stamp_of
from anser_ros.wire.setup import Setup, topic_of

LENGTH_TOLERANCE = 1e-2
"""How far a quaternion's length may be from 1: as far as rounding to two decimals makes it;
angles, or other columns, are farther off."""


def unit_quaternions(given: ArrayLike) -> Array:
    """Return quaternions (..., 4) of unit length, and NaN in place of what is none."""
    quaternions = np.asarray(given, dtype=np.float64)
    length = np.linalg.norm(quaternions, axis=-1, keepdims=True)
    with np.errstate(invalid='ignore', divide='ignore'):
        unit = np.where(abs(length - 1.0) <= LENGTH_TOLERANCE, quaternions / length, np.nan)
    return np.asarray(unit)


MOST_ALIKE = 2.5  # poses with the same stamp from which on stamps are not those of the poses
MOST_ZERO = 0.5
"""Share of zero quaternions, a tracker's mark for no pose, from which on a table has no poses:
what was not seen half of the time is no recording, and columns of another meaning are zero."""


def check_not_zero(path: object, quaternions: Array) -> None:
    """Raise `ParameterError` where too many quaternions (n, 4) of a file are zero."""
    zero = int((quaternions == 0.0).all(axis=1).sum())
    if zero >= MOST_ZERO * len(quaternions) > 0:
        words = f'{zero} of {len(quaternions)} quaternions are zero'
        raise ParameterError(f'{path}: {words}: is it a file of poses, are the columns right?')


def pose_numbers(pose: Any) -> tuple[float, ...]:
    """Return x y z and the quaternion x y z w of a ``geometry_msgs/Pose``, whoever decoded it."""
    p, q = pose.position, pose.orientation
    return p.x, p.y, p.z, q.x, q.y, q.z, q.w


FLUX_TYPE, SETUP_TYPE = 'sensor_msgs/msg/PointCloud2', 'std_msgs/msg/String'
POSE_TYPE = 'geometry_msgs/msg/PoseStamped'
POSE_TYPES = (
    POSE_TYPE, 'geometry_msgs/msg/PoseWithCovarianceStamped', 'geometry_msgs/msg/TransformStamped',
    'nav_msgs/msg/Odometry', 'tf2_msgs/msg/TFMessage',
)  # fmt: skip
"""Types of messages that hold poses."""


def poses_in(topic: str, message: Any) -> list[tuple[str, int, tuple[float, ...]]]:
    """Return topic, stamp, ns, and x y z, quaternion x y z w of each pose in a message.

    Of transforms of `/tf` each child counts as a topic below it: ``/tf/pen``.
    """
    if hasattr(message, 'transforms'):
        parts = ((f'{topic}/{one.child_frame_id}', one) for one in message.transforms)
        return [pose for name, one in parts for pose in poses_in(name, one)]
    if hasattr(message, 'transform'):
        p, q = message.transform.translation, message.transform.rotation
        return [(topic, stamp_of(message), (p.x, p.y, p.z, q.x, q.y, q.z, q.w))]
    pose = message.pose if hasattr(message.pose, 'position') else message.pose.pose
    return [(topic, stamp_of(message), pose_numbers(pose))]


TRACKED, OPTICAL = '/tracked/', '/optical/'
"""What the topics of tracked and of optical poses begin with."""
ENDING = '/pose'
"""What the topics of poses end with."""
BODY = 'body'
"""What a body is called without a name."""
SCHEMA = 'anser_poses/1'
"""Schema of the setup document of a session of poses."""


def legal_name(text: str) -> str:
    """Return a name as near to a text as a topic can have: ``EM run-1`` is EM_run_1."""
    parted = unicodedata.normalize('NFKD', text.replace('ß', 'ss'))
    plain = parted.encode('ascii', 'ignore').decode()
    return topic_of(re.sub('[^a-zA-Z0-9_/]+', '_', plain).strip('_/') or BODY)


def tracked_topic(sensor: str) -> str:
    """Return the topic of a sensor of a tracker that gives poses."""
    return f'{TRACKED}{topic_of(sensor)}{ENDING}'


def optical_topic(body: str, namespace: str = OPTICAL) -> str:
    """Return the topic of a body's optical poses; a second board has another namespace."""
    return f'{namespace.rstrip("/")}/{topic_of(body)}{ENDING}'


def optical_stem(topic: str) -> str:
    """Return the stem of the body whose optical poses a topic has; empty for any other topic."""
    return topic.partition(OPTICAL)[2].removesuffix(ENDING)


def pose_setup(sensors: Iterable[str], body: str) -> str:
    """Return the setup document of a session of poses, as text."""
    return f'schema: {SCHEMA}\nsensors: [{", ".join(sensors)}]\nbody: {body}\n'


@dataclass(frozen=True)
class RecordedFluxes:
    """Holds the fluxes (F, S, K) of one topic, T, with flags (F, S), by ascending stamps (F,)."""

    stamp_ns: Integers
    channel: Integers
    flags: Integers
    flux: ComplexArray


@dataclass(frozen=True)
class PoseStream:
    """Holds poses of one topic: stamps (M,), positions (M, 3) in m, quaternions x y z w (M, 4)."""

    stamp_ns: Integers
    position: Array
    quaternion: Array


@dataclass(frozen=True)
class Bag:
    """Holds a recorded session: setup, fluxes, optical poses, and what was refused or lost."""

    path: str
    setup: Setup
    setup_text: str
    tool: RecordedFluxes | None
    reference: RecordedFluxes | None
    optical: dict[str, PoseStream]
    refused: dict[str, int] = field(default_factory=dict)
    lost: str = ''
