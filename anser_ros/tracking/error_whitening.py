"""Whitens by noise and model error in one kernel, for models that change every frame."""

import math

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import TrackingError
from anser_ros.kernel_cache import kernel
from anser_ros.physics.dipole import fill_flux_basis

Array = NDArray[np.float64]

SAME_PLACE_M = 1e-6
"""Dipoles nearer to each other than this, m, are components of one: rounding moves them apart by
less, and no layout has neighbours within a millimetre."""


@kernel
def _fill_whitening(errors, sigma, factor, out):  # type: ignore[no-untyped-def]
    """Write the inverse Cholesky factor of ``diag(sigma)^2 + E^T E``; False if there is none."""
    width = sigma.shape[0]
    scaled = np.empty(errors.shape)
    for r in range(errors.shape[0]):
        for i in range(width):
            scaled[r, i] = errors[r, i] / sigma[i]
    gram = np.dot(scaled.T, scaled)
    for i in range(width):
        gram[i, i] += 1.0
        for j in range(i + 1):
            total = gram[i, j]
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


def source_spacing(positions: Array, floor_m: float) -> Array:
    """Return how far dipoles where tools may be are from their neighbours, m, shape (N,).

    Dipoles that stand for metal do not determine the field between themselves and others of their
    kind. Those lower than ``floor_m`` are below all tools and get 0.
    """
    square = np.zeros((len(positions), len(positions)))
    for column in positions.T:
        square += (column[:, None] - column) ** 2
    square[square <= SAME_PLACE_M**2] = np.inf
    nearest = np.sqrt(square.min(axis=1, initial=np.inf))
    return np.where((nearest < np.inf) & (positions[:, 2] >= floor_m), nearest, 0.0)


@kernel
def _fill_all(  # type: ignore[no-untyped-def]
    points, axes, lengths, dipoles, spacing, modes, sigma, errors, out, away, among
):  # fmt: skip
    """Write what `error_whitening` returns; False where a covariance has no factor."""
    width = sigma.shape[0]
    basis, factor = np.empty((points.shape[0], dipoles.shape[1])), np.empty((width, width))
    fill_flux_basis(points, axes, lengths, dipoles, basis)
    flat = np.dot(basis, modes)
    good = True
    for s in range(points.shape[0]):
        for r in range(errors.shape[1]):
            for k in range(width):
                errors[s, r, k] = flat[s, r * width + k]
        good &= _fill_whitening(errors[s], sigma, factor, out[s])
        nearest, deepest = np.inf, 0.0
        for j in range(dipoles.shape[1]):
            square = 0.0
            for i in range(3):
                square += (points[s, i] - dipoles[i, j]) ** 2
            nearest = min(nearest, square)
            deepest = max(deepest, spacing[j] * spacing[j] / square)
        away[s], among[s] = math.sqrt(nearest), math.sqrt(deepest)
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

    The S coils have centres ``points`` (m), unit ``axes`` (S, 3), frame fg, and ``lengths``, m.
    The N ``dipoles``, rows of `RealField.columns`, have uncertain moments: ``modes`` (N, R 2K) are
    errors of one standard deviation each, A m^2, ``spacing`` is `source_spacing`, m. ``sigma``
    (2K,) is each flux component's standard deviation, T.

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
