"""Reads poses that a field_model receives, and refuses those of another frame."""

import numpy as np
from geometry_msgs.msg import PoseStamped
from numpy.typing import NDArray

from anser_ros.errors import FrameError
from anser_ros.tracking.rotations import rotation_of_quaternion
from anser_ros.wire.quaternion import unit_quaternions

Array = NDArray[np.float64]


def pose_in(message: PoseStamped, frame_id: str, body: str) -> tuple[Array, Array]:
    """Return position (3,), m, and rotation (3, 3) of a body in a frame.

    Raises
    ------
    FrameError
        When the pose is given in another frame, or is no pose.
    """
    if message.header.frame_id != frame_id:
        raise FrameError(f'the pose of {body} is in {message.header.frame_id!r}, not {frame_id!r}')
    p, q = message.pose.position, message.pose.orientation
    quaternion = unit_quaternions((q.x, q.y, q.z, q.w))
    position = np.array([p.x, p.y, p.z])
    if not (np.isfinite(position).all() and np.isfinite(quaternion).all()):
        raise FrameError(f'the pose of {body} is not finite, or its quaternion has no unit length')
    return position, rotation_of_quaternion(quaternion)
