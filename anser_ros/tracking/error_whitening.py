"""Whitening by noise and model error in one kernel, for models that change every frame."""

import math

import numba
import numpy as np
from numpy.typing import NDArray

from anser_ros.physics.dipole import fill_flux_basis

Array = NDArray[np.float64]


@numba.njit(cache=True, error_model='numpy')
def _fill_whitening(point, axis, length, positions, directions, modes, sigma, factor, out):  # type: ignore[no-untyped-def]
    """Write the inverse Cholesky factor of ``diag(sigma)^2 + modes^T modes``; False if none."""
    width = sigma.shape[0]
    basis = np.empty((1, positions.shape[0]))
    fill_flux_basis(point, axis, length, positions, directions, basis)
    scaled = np.dot(basis, modes).reshape(-1, width)
    for r in range(scaled.shape[0]):
        for k in range(width):
            scaled[r, k] /= sigma[k]
    for i in range(width):
        for j in range(i + 1):
            total = 1.0 if i == j else 0.0
            for r in range(scaled.shape[0]):
                total += scaled[r, i] * scaled[r, j]
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


def error_whitening(
    point: Array,
    axis: Array,
    length: float,
    positions: Array,
    directions: Array,
    modes: Array,
    sigma: Array,
) -> Array | None:
    """Matrix that turns a coil's flux residual into one of unit covariance.

    Parameters
    ----------
    point, axis : ndarray, shape (3,)
        Coil centre (m) and unit axis, frame fg.
    length : float
        Coil length, m.
    positions, directions : ndarray, shape (N, 3)
        The model's dipoles.
    modes : ndarray, shape (N, R 2K)
        Moments' errors of one standard deviation each, A m^2.
    sigma : ndarray, shape (2K,)
        Standard deviation of each flux component, T.

    Returns
    -------
    ndarray, shape (2K, 2K), or None
        1/T, lower triangular; None where the covariance is not finite.
    """
    width = len(sigma)
    out, factor = np.empty((width, width)), np.empty((width, width))
    good = _fill_whitening(
        np.ascontiguousarray(point[None], dtype=np.float64),
        np.ascontiguousarray(axis[None], dtype=np.float64),
        np.array([length]), positions, directions, modes, sigma, factor, out,
    )  # fmt: skip
    return out if good else None
