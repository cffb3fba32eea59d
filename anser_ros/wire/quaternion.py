"""Judges whether four numbers that came from outside are the quaternion of a rotation."""

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
