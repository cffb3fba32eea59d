"""Whitens by noise and model error in one kernel, for models that change every frame."""

import math

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import TrackingError
from anser_ros.kernel_cache import kernel
from anser_ros.physics.constants import DIPOLE_CONSTANT
from anser_ros.physics.dipole import GAUSS_OFFSET

Array = NDArray[np.float64]

SAME_PLACE_M = 1e-6
"""Dipoles nearer to each other than this, m, are components of one: rounding moves them apart by
less, and no layout has neighbours within a millimetre."""


@kernel
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


@kernel
def _fill_spacing(positions, spacing):  # type: ignore[no-untyped-def]
    for i in range(positions.shape[0]):
        nearest = np.inf
        for j in range(positions.shape[0]):
            dx, dy = positions[i, 0] - positions[j, 0], positions[i, 1] - positions[j, 1]
            dz = positions[i, 2] - positions[j, 2]
            square = dx * dx + dy * dy + dz * dz
            if square > SAME_PLACE_M**2:
                nearest = min(nearest, square)
        spacing[i] = math.sqrt(nearest) if nearest < np.inf else 0.0


def source_spacing(positions: Array, floor_m: float) -> Array:
    """Return how far dipoles where tools may be are from their neighbours, m, shape (N,).

    Dipoles that stand for metal do not determine the field between themselves and others of their
    kind. Those lower than ``floor_m`` are below all tools and get 0.
    """
    spacing = np.empty(len(positions))
    _fill_spacing(np.ascontiguousarray(positions), spacing)
    spacing[positions[:, 2] < floor_m] = 0.0
    return spacing


@kernel
def _fill_couplings(points, axes, lengths, dipoles, spacing, basis, away, among):  # type: ignore[no-untyped-def]
    """Write each unit dipole's flux in each coil, and how near each coil is to them."""
    px, py, pz = dipoles[0], dipoles[1], dipoles[2]
    ux, uy, uz = dipoles[3], dipoles[4], dipoles[5]
    for p in range(points.shape[0]):
        nx, ny, nz = axes[p, 0], axes[p, 1], axes[p, 2]
        half = lengths[p] * GAUSS_OFFSET
        count = 1 if half == 0.0 else 2
        scale, row, nearest, deepest = DIPOLE_CONSTANT / count, basis[p], np.inf, 0.0
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
            square = dx * dx + dy * dy + dz * dz
            nearest = min(nearest, square)
            deepest = max(deepest, spacing[j] * spacing[j] / square)
        away[p], among[p] = math.sqrt(nearest), math.sqrt(deepest)


@kernel
def _fill_all(  # type: ignore[no-untyped-def]
    points, axes, lengths, dipoles, spacing, modes, sigma, errors, out, away, among
):  # fmt: skip
    width = sigma.shape[0]
    basis, factor = np.empty((points.shape[0], dipoles.shape[1])), np.empty((width, width))
    _fill_couplings(points, axes, lengths, dipoles, spacing, basis, away, among)
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
    spacing: Array,
    modes: Array,
    sigma: Array,
) -> tuple[Array, Array, Array, Array]:
    """Return the model's error at coils, and the factors that make their residuals white.

    Parameters
    ----------
    points, axes : ndarray, shape (S, 3)
        Coil centres (m) and unit axes, frame fg.
    lengths : ndarray, shape (S,)
        Coil lengths, m.
    dipoles : ndarray, shape (6, N)
        The dipoles whose moments are uncertain: rows of `RealField.columns`.
    spacing : ndarray, shape (N,)
        Their `source_spacing`, m.
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
    among : ndarray, shape (S,)
        Spacing over distance, of the dipole for which that is largest: above 1 a coil is where
        the dipoles are no description of the field.

    Raises
    ------
    TrackingError
        Where the covariance is not finite.
    """
    count, width = len(points), len(sigma)
    errors = np.empty((count, modes.shape[1] // width, width))
    whitening = np.empty((count, width, width))
    away, among = np.empty(count), np.empty(count)
    if not _fill_all(
        points, axes, lengths, dipoles, spacing, modes, sigma, errors, whitening, away, among
    ):
        raise TrackingError('the model covariance must be finite')
    return errors, whitening, away, among
