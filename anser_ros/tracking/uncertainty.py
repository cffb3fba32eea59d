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
from anser_ros.tracking.descent import damped_step

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
"""Pivot of a scaled information matrix from which on its factor is used; with a smaller one
rounding is felt, and what the fluxes hardly determine is looked for among the eigenvectors."""


@kernel
def bounded_inverse(information):  # type: ignore[no-untyped-def]
    """Return the covariance of a symmetric, positive semidefinite information matrix.

    Directions that it hardly determines get `UNKNOWN_VARIANCE`.
    """
    n = information.shape[0]
    scale, scaled, covariance = np.empty(n), np.empty((n, n)), np.empty((n, n))
    factor, unit, column = np.empty((n, n)), np.zeros(n), np.empty(n)
    for i in range(n):
        scale[i] = 1.0 / math.sqrt(max(information[i, i], 1e-30))
    for i in range(n):
        for j in range(n):
            scaled[i, j] = information[i, j] * scale[i] * scale[j]
    is_sure = True
    for j in range(n):
        unit[j] = 1.0
        is_sure &= damped_step(scaled, unit, 0.0, factor, column)
        is_sure &= factor[j, j] * factor[j, j] > SMALLEST_PIVOT
        unit[j] = 0.0
        for i in range(j, n):
            covariance[i, j] = covariance[j, i] = column[i]
    if not is_sure:
        values, vectors = np.linalg.eigh(scaled)
        for i in range(n):
            for j in range(n):
                covariance[i, j] = 0.0
                for k in range(n):
                    part = vectors[i, k] * vectors[j, k]
                    covariance[i, j] += part / max(values[k], 1e-14)
    for i in range(n):
        for j in range(n):
            covariance[i, j] *= scale[i] * scale[j]
    for i in range(n):
        if covariance[i, i] > UNKNOWN_VARIANCE:
            shrink = math.sqrt(UNKNOWN_VARIANCE / covariance[i, i])
            for j in range(n):
                covariance[i, j] *= shrink
            for j in range(n):
                covariance[j, i] *= shrink
    return covariance


@kernel
def coil_covariance(normal, axis, roll_variance):  # type: ignore[no-untyped-def]
    """Return the covariance (6, 6) of a coil's position and rotation vector, both in fg, m and
    rad.

    ``normal`` (6, 6) is ``J^T J`` of the whitened residuals by position (per m) and free axis
    vector; ``roll_variance``, rad^2, is given to the rotation about the axis.
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

    ``axes`` and ``next_axes`` hold all axes of a body, or that of a coil, in columns: (3, 3) or
    (3, 1). ``share`` is the error's standard deviation in units of the motion. Returns the square
    root of the trace of the position's covariance, m.
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
