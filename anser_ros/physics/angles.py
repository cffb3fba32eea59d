"""Computes angles between axes and of rotations, and rotations nearest to matrices.

Angles are in rad, by arctangent: small ones are exact too.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def axis_angles(first: Array, second: Array) -> Array:
    """Return the angles between axes of any length but zero, shape (...), rad, 0 to pi.

    Parameters
    ----------
    first, second : ndarray, shape (..., 3)
        Both in the same frame; NaN where one is not known, which gives NaN.
    """
    sine = np.linalg.norm(np.cross(first, second), axis=-1)
    return np.asarray(np.arctan2(sine, np.sum(first * second, axis=-1)))


def rotation_angles(matrices: Array) -> Array:
    """Return the angles of rotation matrices, shape (...), rad, 0 to pi.

    Parameters
    ----------
    matrices : ndarray, shape (..., 3, 3)
        Proper rotations, or NaN, which gives NaN.
    """
    transposed = np.swapaxes(matrices, -1, -2)
    # The skew part has each component of the axis twice, times the sine.
    sine = np.linalg.norm(matrices - transposed, axis=(-2, -1)) / np.sqrt(8.0)
    cosine = 0.5 * (np.trace(matrices, axis1=-2, axis2=-1) - 1.0)
    return np.asarray(np.arctan2(sine, cosine))


def nearest_rotation(matrices: Array) -> Array:
    """Return the proper rotations (..., n, n) nearest to matrices (Kabsch).

    They are ``U diag(1, ..., 1, det) V^T`` of the singular value decomposition.
    """
    u, _, vt = np.linalg.svd(matrices)
    u[..., -1] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return np.asarray(u @ vt)
