"""Takes numbers of a pose message, and judges whether four are the quaternion of a rotation."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

LENGTH_TOLERANCE = 1e-2
"""How far the length of a quaternion may be from 1. Components rounded to two decimals make it
wrong by up to this, and normalising mends that; angles, or columns of something else, are farther
off. Smaller refuses rounded files; larger takes other numbers for quaternions."""


def unit_quaternions(given: ArrayLike) -> NDArray[np.float64]:
    """Return quaternions (..., 4) of unit length, and NaN in place of what is none."""
    quaternions = np.asarray(given, dtype=np.float64)
    length = np.linalg.norm(quaternions, axis=-1, keepdims=True)
    with np.errstate(invalid='ignore', divide='ignore'):
        unit = np.where(abs(length - 1.0) <= LENGTH_TOLERANCE, quaternions / length, np.nan)
    return np.asarray(unit)


def pose_numbers(pose: Any) -> tuple[float, ...]:
    """Return x y z and the quaternion x y z w of a ``geometry_msgs/Pose``, whoever decoded it."""
    p, q = pose.position, pose.orientation
    return p.x, p.y, p.z, q.x, q.y, q.z, q.w
