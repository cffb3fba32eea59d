"""How well a pose is known: its covariance, and whether its residual is what the noise allows.

A pose is wrong by the flux noise and by what is wrong with the field model. Both enter the
whitening, so the inverse of the whitened normal matrix is the covariance. Roll about a coil's axis
is not observable: the rotation covariance is that of the tilt plus ``roll_variance a a^T``.
"""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from anser_ros.physics.dipole import flux_basis

Array = NDArray[np.float64]

ROLL_VARIANCE = math.pi**2 / 3.0
"""Variance (rad^2) of an angle that may be anything in +-pi."""

UNKNOWN_VARIANCE = 1.0
"""Upper bound (m^2 or rad^2) of a variance along a direction that the fluxes don't determine."""


def chi2_limit(degrees_of_freedom: int, probability: float) -> float:
    """Chi-square that noise alone exceeds with the given probability."""
    return float(chdtri(max(degrees_of_freedom, 1), probability))


def model_error_modes(
    modes: NDArray[np.complex128],
    positions: Array,
    directions: Array,
    points: Array,
    axes: Array,
    lengths: Array,
) -> Array:
    """Flux errors that the moments' uncertainty causes at given sensors.

    Parameters
    ----------
    modes : ndarray, shape (R, N, K), complex
        Low-rank factor of the moments' covariance: the moments are wrong by
        ``sum_r xi_r modes[r]`` with independent unit normal ``xi``, A m^2.
    positions, directions : ndarray, shape (N, 3)
        Dipoles.
    points, axes : ndarray, shape (S, 3)
        Sensors, m and unit vectors, frame fg.
    lengths : ndarray, shape (S,)
        Coil lengths, m.

    Returns
    -------
    ndarray, shape (R, S, 2K)
        T; real and imaginary part by turns.
    """
    basis = flux_basis(points, axes, lengths, positions, directions)
    flux = np.ascontiguousarray(np.einsum('sn,rnk->rsk', basis, modes, optimize=True))
    return flux.view(np.float64)


def bounded_inverse(information: Array) -> Array:
    """Inverse of an information matrix whose weak directions are held to `UNKNOWN_VARIANCE`.

    Parameters
    ----------
    information : ndarray, shape (n, n)
        Symmetric, positive semidefinite.

    Returns
    -------
    ndarray, shape (n, n)
        Covariance.
    """
    scale = np.sqrt(np.maximum(np.diag(information), 1e-30))
    scaled = information / np.outer(scale, scale)
    values, vectors = np.linalg.eigh(scaled)
    weights = 1.0 / np.maximum(values, 1e-14)
    covariance = (vectors * weights) @ vectors.T / np.outer(scale, scale)
    variance = np.diag(covariance)
    if (variance > UNKNOWN_VARIANCE).any():
        shrink = np.minimum(1.0, np.sqrt(UNKNOWN_VARIANCE / variance))
        covariance = covariance * np.outer(shrink, shrink)
    return np.asarray(covariance)


def coil_covariance(normal: Array, axis: Array, roll_variance: float = ROLL_VARIANCE) -> Array:
    """Covariance of a single coil's pose.

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
    helper = np.zeros(3)
    helper[int(np.argmin(np.abs(axis)))] = 1.0
    first = np.cross(axis, helper)
    first /= math.sqrt(float(first @ first))
    second = np.cross(axis, first)
    # A turn w moves the axis by w x n: about `first` by -second, about `second` by +first.
    reduced, back = np.zeros((5, 6)), np.zeros((6, 5))
    reduced[:3, :3] = back[:3, :3] = np.eye(3)
    reduced[3, 3:], reduced[4, 3:] = -second, first
    back[3:, 3], back[3:, 4] = first, second
    inner = bounded_inverse(reduced @ normal @ reduced.T)
    covariance = back @ inner @ back.T
    covariance[3:, 3:] += roll_variance * np.outer(axis, axis)
    return np.asarray(covariance)
