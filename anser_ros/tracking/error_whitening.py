"""Whitening by noise and model error in one kernel, for models that change every frame."""

import math

import numba
import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import TrackingError
from anser_ros.physics.constants import DIPOLE_CONSTANT
from anser_ros.physics.dipole import GAUSS_OFFSET

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
def _fill_couplings(points, axes, lengths, dipoles, basis, away):  # type: ignore[no-untyped-def]
    """Write each unit dipole's flux in each coil, and each coil's distance from the nearest."""
    px, py, pz = dipoles[0], dipoles[1], dipoles[2]
    ux, uy, uz = dipoles[3], dipoles[4], dipoles[5]
    for p in range(points.shape[0]):
        nx, ny, nz = axes[p, 0], axes[p, 1], axes[p, 2]
        half = lengths[p] * GAUSS_OFFSET
        count = 1 if half == 0.0 else 2
        scale, row, nearest = DIPOLE_CONSTANT / count, basis[p], np.inf
        for s in range(count):
            h = half * (1 - 2 * s)
            x, y, z = points[p, 0] + h * nx, points[p, 1] + h * ny, points[p, 2] + h * nz
            for j in range(px.shape[0]):
                dx, dy, dz = x - px[j], y - py[j], z - pz[j]
                square = dx * dx + dy * dy + dz * dz
                inv2 = 1.0 / square
                inv3 = scale * inv2 * math.sqrt(inv2)
                du = dx * ux[j] + dy * uy[j] + dz * uz[j]
                dn = dx * nx + dy * ny + dz * nz
                nu = nx * ux[j] + ny * uy[j] + nz * uz[j]
                value = inv3 * (3.0 * du * dn * inv2 - nu)
                row[j] = value if s == 0 else row[j] + value
        for j in range(px.shape[0]):
            dx, dy, dz = points[p, 0] - px[j], points[p, 1] - py[j], points[p, 2] - pz[j]
            nearest = min(nearest, dx * dx + dy * dy + dz * dz)
        away[p] = math.sqrt(nearest)


@numba.njit(cache=True, error_model='numpy')
def _fill_all(points, axes, lengths, dipoles, modes, sigma, errors, out, away):  # type: ignore[no-untyped-def]
    width = sigma.shape[0]
    basis, factor = np.empty((points.shape[0], dipoles.shape[1])), np.empty((width, width))
    _fill_couplings(points, axes, lengths, dipoles, basis, away)
    errors[:] = np.dot(basis, modes).reshape(errors.shape)
    good = True
    for s in range(points.shape[0]):
        good &= _fill_whitening(errors[s], sigma, factor, out[s])
    return good


def error_whitening(
    points: Array,
    axes: Array,
    lengths: Array,
    dipoles: Array,
    modes: Array,
    sigma: Array,
) -> tuple[Array, Array, Array]:
    """What the model's error does to coils, and what makes their residuals of unit covariance.

    Parameters
    ----------
    points, axes : ndarray, shape (S, 3)
        Coil centres (m) and unit axes, frame fg.
    lengths : ndarray, shape (S,)
        Coil lengths, m.
    dipoles : ndarray, shape (6, N)
        The dipoles whose moments are uncertain: rows of `RealField.columns`.
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
    away : ndarray, shape (S,)
        Distance from the nearest of the dipoles, m.

    Raises
    ------
    TrackingError
        Where the covariance is not finite.
    """
    count, width = len(points), len(sigma)
    errors = np.empty((count, modes.shape[1] // width, width))
    whitening = np.empty((count, width, width))
    away = np.empty(count)
    if not _fill_all(points, axes, lengths, dipoles, modes, sigma, errors, whitening, away):
        raise TrackingError('the model covariance must be finite')
    return errors, whitening, away
