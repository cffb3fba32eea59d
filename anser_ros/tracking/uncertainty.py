"""Computes how well a pose is known, and whether its residual is what the noise allows.

The error of a pose comes from the flux noise and from the error of the field model. Both enter the
whitening, so the inverse of the whitened normal matrix is the covariance. Roll about a coil's axis
is not observable: the rotation covariance is that of the tilt plus ``roll_variance a a^T``.
"""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from anser_ros.kernel_cache import kernel
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


SMALLEST_PIVOT = 1e-9
"""Pivot of a scaled information matrix from which on its factor is inverted; with a smaller one
rounding is felt, and what the fluxes hardly determine is looked for among the eigenvectors."""


@kernel
def inverse_by_factor(matrix, inverse):  # type: ignore[no-untyped-def]
    """Write the inverse of a symmetric matrix (n, n) of unit diagonal into ``inverse``.

    Returns whether all pivots were large enough; otherwise what is written means nothing.
    """
    n = matrix.shape[0]
    root = np.zeros((n, n))  # the inverse of the lower triangular factor, from the factor itself
    for j in range(n):
        pivot = matrix[j, j]
        for k in range(j):
            pivot -= root[j, k] * root[j, k]
        if not pivot > SMALLEST_PIVOT:
            return False
        root[j, j] = math.sqrt(pivot)
        for i in range(j + 1, n):
            left = matrix[i, j]
            for k in range(j):
                left -= root[i, k] * root[j, k]
            root[i, j] = left / root[j, j]
    for j in range(n):
        root[j, j] = 1.0 / root[j, j]
        for i in range(j + 1, n):
            left = 0.0
            for k in range(j, i):
                left -= root[i, k] * root[k, j]
            root[i, j] = left / root[i, i]
    for i in range(n):
        for j in range(i, n):
            total = 0.0
            for k in range(j, n):
                total += root[k, i] * root[k, j]
            inverse[i, j] = inverse[j, i] = total
    return True


@kernel
def bounded_inverse(information):  # type: ignore[no-untyped-def]
    """Return the covariance of a symmetric, positive semidefinite information matrix.

    Directions that it hardly determines get `UNKNOWN_VARIANCE`.
    """
    n = information.shape[0]
    scale, scaled, covariance = np.empty(n), np.empty((n, n)), np.empty((n, n))
    for i in range(n):
        scale[i] = 1.0 / math.sqrt(max(information[i, i], 1e-30))
    for i in range(n):
        for j in range(n):
            scaled[i, j] = information[i, j] * scale[i] * scale[j]
    if not inverse_by_factor(scaled, covariance):
        values, vectors = np.linalg.eigh(scaled)
        for i in range(n):
            values[i] = 1.0 / max(values[i], 1e-14)
        covariance[:] = np.dot(vectors * values, vectors.T)
    for i in range(n):
        for j in range(n):
            covariance[i, j] *= scale[i] * scale[j]
    for i in range(n):
        if covariance[i, i] > UNKNOWN_VARIANCE:
            shrink = math.sqrt(UNKNOWN_VARIANCE / covariance[i, i])
            covariance[i, :] *= shrink
            covariance[:, i] *= shrink
    return covariance


@kernel
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
    # A turn w moves the axis by w x n: about t[0] by -t[1], about t[1] by t[0]. So of the six
    # columns of the normal matrix five are left, and two of them become three of a turn.
    half, information = np.empty((5, 6)), np.empty((5, 5))
    for j in range(6):
        for i in range(3):
            half[i, j] = normal[i, j]
        half[3, j] = half[4, j] = 0.0
        for c in range(3):
            half[3, j] -= t[1, c] * normal[3 + c, j]
            half[4, j] += t[0, c] * normal[3 + c, j]
    for i in range(5):
        for j in range(3):
            information[i, j] = half[i, j]
        information[i, 3] = information[i, 4] = 0.0
        for c in range(3):
            information[i, 3] -= half[i, 3 + c] * t[1, c]
            information[i, 4] += half[i, 3 + c] * t[0, c]
    inner, covariance = bounded_inverse(information), np.empty((6, 6))
    for i in range(3):
        for j in range(3):
            covariance[i, j] = inner[i, j]
            turned = inner[i, 3] * t[0, j] + inner[i, 4] * t[1, j]
            covariance[i, 3 + j] = covariance[3 + j, i] = turned
            turns = roll_variance * axis[i] * axis[j]
            for k in range(2):
                for m in range(2):
                    turns += t[k, i] * inner[3 + k, 3 + m] * t[m, j]
            covariance[3 + i, 3 + j] = turns
    return covariance


@kernel
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
