"""Computes how well a pose is known, and whether its residual is what the noise allows.

The error of a pose comes from the flux noise and from the error of the field model. Both enter the
whitening, so the inverse of the whitened normal matrix is the covariance. Roll about a coil's axis
is not observable: the rotation covariance is that of the tilt plus ``roll_variance a a^T``.
"""

import math
from functools import lru_cache

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from anser_ros.physics.tangent import fill_tangent

Array = NDArray[np.float64]

ROLL_VARIANCE = math.pi**2 / 3.0
"""Variance (rad^2) of an angle that may be anything in +-pi."""

UNKNOWN_VARIANCE = 1.0
"""Upper bound (m^2 or rad^2) of a variance along a direction that the fluxes don't determine."""


@lru_cache(maxsize=256)
def chi2_limit(degrees_of_freedom: int, probability: float) -> float:
    """Return chi-square that noise alone exceeds with the given probability."""
    return float(chdtri(max(degrees_of_freedom, 1), probability))


@numba.njit(cache=True, error_model='numpy')
def bounded_inverse(information):  # type: ignore[no-untyped-def]
    """Return the covariance of a symmetric, positive semidefinite information matrix.

    Directions that it hardly determines get `UNKNOWN_VARIANCE`.
    """
    n = information.shape[0]
    scale = np.empty(n)
    for i in range(n):
        scale[i] = 1.0 / math.sqrt(max(information[i, i], 1e-30))
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    for i in range(n):
        values[i] = 1.0 / max(values[i], 1e-14)
    covariance = np.dot(vectors * values, vectors.T) * np.outer(scale, scale)
    for i in range(n):
        if covariance[i, i] > UNKNOWN_VARIANCE:
            shrink = math.sqrt(UNKNOWN_VARIANCE / covariance[i, i])
            covariance[i, :] *= shrink
            covariance[:, i] *= shrink
    return covariance


@numba.njit(cache=True, error_model='numpy')
def coil_covariance(normal, axis, roll_variance):  # type: ignore[no-untyped-def]
    """Return the covariance of a single coil's pose.

    Parameters
    ----------
    normal : ndarray, shape (6, 6)
        ``J^T J`` of the whitened residuals by position (per m) and free axis vector.
    axis : ndarray, shape (3,)
        Unit sensitive axis, frame fg.
    roll_variance : float
        rad^2, given to the rotation about the axis.

    Returns
    -------
    ndarray, shape (6, 6)
        m^2, m rad, rad^2: position, then rotation vector, both in fg.
    """
    t = np.empty((2, 3))
    fill_tangent(axis, t)
    # A turn w moves the axis by w x n: about t[0] by -t[1], about t[1] by t[0].
    reduced, back = np.zeros((5, 6)), np.zeros((6, 5))
    for i in range(3):
        reduced[i, i] = 1.0
        back[i, i] = 1.0
        reduced[3, 3 + i], reduced[4, 3 + i] = -t[1, i], t[0, i]
        back[3 + i, 3], back[3 + i, 4] = t[0, i], t[1, i]
    inner = bounded_inverse(np.dot(np.dot(reduced, normal), reduced.T))
    covariance = np.dot(np.dot(back, inner), back.T)
    for i in range(3):
        for j in range(3):
            covariance[3 + i, 3 + j] += roll_variance * axis[i] * axis[j]
    return covariance


@numba.njit(cache=True, error_model='numpy')
def add_motion(covariance, position, next_position, axes, next_axes, share):  # type: ignore[no-untyped-def]
    """Add to a pose's covariance (6, 6), in place, a part of its last motion as an error.

    Parameters
    ----------
    covariance : ndarray, shape (6, 6)
        Of position and rotation vector, fg.
    position, next_position : ndarray, shape (3,)
        m.
    axes, next_axes : ndarray, shape (3, 3) or (3, 1)
        All axes of a body, or that of a coil, in columns.
    share : float
        Standard deviation of the error in units of the motion.

    Returns
    -------
    float
        Square root of the trace of the position's covariance, m.
    """
    move = np.zeros(6)
    # Each axis n turns by w x n; the sum of n x (w x n) over three axes is 2 w, over one it is w.
    part = share / (2.0 if axes.shape[1] == 3 else 1.0)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        move[i] = share * (next_position[i] - position[i])
        for c in range(axes.shape[1]):
            turn = axes[j, c] * next_axes[k, c] - axes[k, c] * next_axes[j, c]
            move[3 + i] += part * turn
    for i in range(6):
        for j in range(6):
            covariance[i, j] += move[i] * move[j]
    return math.sqrt(covariance[0, 0] + covariance[1, 1] + covariance[2, 2])
