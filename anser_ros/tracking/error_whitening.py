"""Whitening by noise and model error in one kernel, for models that change every frame."""

import math

import numba
import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import TrackingError
from anser_ros.physics.dipole import fill_flux_basis

Array = NDArray[np.float64]


@numba.njit(cache=True, error_model='numpy')
def _fill_whitening(errors, sigma, factor, out):  # type: ignore[no-untyped-def]
    """Write the inverse Cholesky factor of ``diag(sigma)^2 + E^T E``; False if there is none."""
    width = sigma.shape[0]
    scaled = errors / sigma
    factor[:] = np.dot(scaled.T, scaled)
    for i in range(width):
        factor[i, i] += 1.0
        for j in range(i + 1):
            total = factor[i, j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i > j:
                factor[i, j] = total / factor[j, j]
            elif total > 0.0 and math.isfinite(total):
                factor[i, i] = math.sqrt(total)
            else:
                return False
    for j in range(width):
        for i in range(width):
            out[i, j] = 0.0
        out[j, j] = 1.0 / factor[j, j]
        for i in range(j + 1, width):
            total = 0.0
            for k in range(j, i):
                total += factor[i, k] * out[k, j]
            out[i, j] = -total / factor[i, i]
    for i in range(width):
        for j in range(i + 1):
            out[i, j] /= sigma[j]
    return True


@numba.njit(cache=True, error_model='numpy')
def _fill_all(points, axes, lengths, positions, directions, modes, sigma, errors, out):  # type: ignore[no-untyped-def]
    width = sigma.shape[0]
    basis, factor = np.empty((points.shape[0], positions.shape[0])), np.empty((width, width))
    fill_flux_basis(points, axes, lengths, positions, directions, basis)
    errors[:] = np.dot(basis, modes).reshape(errors.shape)
    good = True
    for s in range(points.shape[0]):
        good &= _fill_whitening(errors[s], sigma, factor, out[s])
    return good


def error_whitening(
    points: Array,
    axes: Array,
    lengths: Array,
    positions: Array,
    directions: Array,
    modes: Array,
    sigma: Array,
) -> tuple[Array, Array]:
    """What the model's error does to coils, and what makes their residuals of unit covariance.

    Parameters
    ----------
    points, axes : ndarray, shape (S, 3)
        Coil centres (m) and unit axes, frame fg.
    lengths : ndarray, shape (S,)
        Coil lengths, m.
    positions, directions : ndarray, shape (N, 3)
        The dipoles whose moments are uncertain.
    modes : ndarray, shape (N, R 2K)
        Moments' errors of one standard deviation each, A m^2.
    sigma : ndarray, shape (2K,)
        Standard deviation of each flux component, T.

    Returns
    -------
    errors : ndarray, shape (S, R, 2K)
        Flux errors of one standard deviation each, T.
    whitening : ndarray, shape (S, 2K, 2K)
        1/T, lower triangular.

    Raises
    ------
    TrackingError
        Where the covariance is not finite.
    """
    count, width = len(points), len(sigma)
    errors = np.empty((count, modes.shape[1] // width, width))
    whitening = np.empty((count, width, width))
    if not _fill_all(
        points, axes, lengths, positions, directions, modes, sigma, errors, whitening
    ):
        raise TrackingError('the model covariance must be finite')
    return errors, whitening
