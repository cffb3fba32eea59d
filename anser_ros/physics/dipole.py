"""Field and gradient of magnetic dipoles, and the flux density that a pick-up coil senses.

The field of a dipole m at the offset d is the article's equation (1),
``B = mu0/(4 pi) (3 (m . d) d / |d|^5 - m / |d|^3)``; its gradient follows by differentiation and
is symmetric and traceless outside the source. A coil of length L along its axis n senses the mean
of ``n . B`` over its length, which two-point Gauss-Legendre quadrature at +-L/(2 sqrt 3) gives
with an error of order L^4.
"""

import math

import numba
import numpy as np
from numpy.typing import NDArray

from anser_ros.physics.constants import DIPOLE_CONSTANT

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

GAUSS_OFFSET = 0.5 / math.sqrt(3.0)
"""Offset of the two Gauss-Legendre points from a coil's centre, as a fraction of its length."""


@numba.njit(cache=True, error_model='numpy')
def fill_flux_basis(points, axes, lengths, positions, directions, out):  # type: ignore[no-untyped-def]
    """Write each unit dipole's flux density along each coil's axis into ``out``, shape (P, N).

    The arguments are those of `flux_basis` as contiguous arrays; nothing is checked.
    """
    for p in range(points.shape[0]):
        nx, ny, nz = axes[p, 0], axes[p, 1], axes[p, 2]
        half = lengths[p] * GAUSS_OFFSET
        count = 1 if half == 0.0 else 2
        scale = DIPOLE_CONSTANT / count
        for j in range(positions.shape[0]):
            total = 0.0
            ux, uy, uz = directions[j, 0], directions[j, 1], directions[j, 2]
            nu = nx * ux + ny * uy + nz * uz
            for s in range(count):
                h = half * (1 - 2 * s)
                dx = points[p, 0] + h * nx - positions[j, 0]
                dy = points[p, 1] + h * ny - positions[j, 1]
                dz = points[p, 2] + h * nz - positions[j, 2]
                inv2 = 1.0 / (dx * dx + dy * dy + dz * dz)
                inv3 = inv2 * math.sqrt(inv2)
                du = dx * ux + dy * uy + dz * uz
                dn = dx * nx + dy * ny + dz * nz
                total += inv3 * (3.0 * du * dn * inv2 - nu)
            out[p, j] = scale * total


@numba.njit(cache=True, error_model='numpy')
def fill_field_and_gradient(point, positions, directions, basis):  # type: ignore[no-untyped-def]
    """Write each unit dipole's field and gradient at one point (m) into ``basis``, shape (9, N).

    Rows 0 to 2 hold B_x, B_y, B_z (T); rows 3 to 8 the gradient's xx, xy, xz, yy, yz, zz (T/m).
    """
    for j in range(positions.shape[0]):
        dx = point[0] - positions[j, 0]
        dy = point[1] - positions[j, 1]
        dz = point[2] - positions[j, 2]
        ux, uy, uz = directions[j, 0], directions[j, 1], directions[j, 2]
        inv2 = 1.0 / (dx * dx + dy * dy + dz * dz)
        k3 = DIPOLE_CONSTANT * inv2 * math.sqrt(inv2)
        k5 = 3.0 * k3 * inv2
        du = dx * ux + dy * uy + dz * uz
        basis[0, j] = k5 * du * dx - k3 * ux
        basis[1, j] = k5 * du * dy - k3 * uy
        basis[2, j] = k5 * du * dz - k3 * uz
        q = 5.0 * du * inv2
        basis[3, j] = k5 * (2.0 * ux * dx + du - q * dx * dx)
        basis[4, j] = k5 * (ux * dy + uy * dx - q * dx * dy)
        basis[5, j] = k5 * (ux * dz + uz * dx - q * dx * dz)
        basis[6, j] = k5 * (2.0 * uy * dy + du - q * dy * dy)
        basis[7, j] = k5 * (uy * dz + uz * dy - q * dy * dz)
        basis[8, j] = k5 * (2.0 * uz * dz + du - q * dz * dz)


@numba.njit(cache=True, error_model='numpy')
def _fill_flux_jacobian(points, axes, lengths, positions, directions, moments, flux, d_r, d_n):  # type: ignore[no-untyped-def]
    """Add fluxes and derivatives to ``flux``, ``d_r`` and ``d_n``, as `flux_jacobian` has them.

    These three and ``moments`` are real; their last axis holds the 2K parts (re, im by turns).
    """
    basis = np.empty((9, positions.shape[0]))
    point = np.empty(3)
    for p in range(points.shape[0]):
        half = lengths[p] * GAUSS_OFFSET
        count = 1 if half == 0.0 else 2
        for s in range(count):
            h = half * (1 - 2 * s)
            for i in range(3):
                point[i] = points[p, i] + h * axes[p, i]
            fill_field_and_gradient(point, positions, directions, basis)
            f = np.dot(basis, moments)
            n0, n1, n2 = axes[p, 0], axes[p, 1], axes[p, 2]
            for k in range(moments.shape[1]):
                gx = n0 * f[3, k] + n1 * f[4, k] + n2 * f[5, k]
                gy = n0 * f[4, k] + n1 * f[6, k] + n2 * f[7, k]
                gz = n0 * f[5, k] + n1 * f[7, k] + n2 * f[8, k]
                flux[p, k] += (n0 * f[0, k] + n1 * f[1, k] + n2 * f[2, k]) / count
                d_r[p, 0, k] += gx / count
                d_r[p, 1, k] += gy / count
                d_r[p, 2, k] += gz / count
                d_n[p, 0, k] += (f[0, k] + h * gx) / count
                d_n[p, 1, k] += (f[1, k] + h * gy) / count
                d_n[p, 2, k] += (f[2, k] + h * gz) / count


def _rows(values: NDArray[np.generic], width: int, what: str) -> Array:
    array = np.ascontiguousarray(values, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != width:
        raise ValueError(f'{what} must have shape (n, {width}), got {array.shape}')
    return array


def _sensors(
    points: NDArray[np.generic], axes: NDArray[np.generic], lengths: NDArray[np.generic] | None
) -> tuple[Array, Array, Array]:
    r, n = _rows(points, 3, 'points'), _rows(axes, 3, 'axes')
    if r.shape != n.shape:
        raise ValueError(f'points and axes must match, got {r.shape} and {n.shape}')
    if lengths is None:
        return r, n, np.zeros(r.shape[0])
    spans = np.ascontiguousarray(np.broadcast_to(lengths, r.shape[:1]), dtype=np.float64)
    return r, n, spans


def flux_basis(
    points: NDArray[np.generic],
    axes: NDArray[np.generic],
    lengths: NDArray[np.generic] | None,
    positions: NDArray[np.generic],
    directions: NDArray[np.generic],
) -> Array:
    """Return the flux density along each sensor's axis for dipoles of unit moment.

    This is the coupling matrix M of the article.

    Parameters
    ----------
    points : ndarray, shape (P, 3)
        Sensor centres, m, frame fg.
    axes : ndarray, shape (P, 3)
        Unit sensitive axes, frame fg.
    lengths : ndarray, shape (P,), or None
        Coil lengths, m; None or 0 for point sensors.
    positions, directions : ndarray, shape (N, 3)
        Dipole positions (m) and unit directions, frame fg.

    Returns
    -------
    ndarray, shape (P, N)
        Flux density per moment, T / (A m^2).

    Raises
    ------
    ValueError
        When the shapes do not fit together.
    """
    r, n, spans = _sensors(points, axes, lengths)
    q, u = _rows(positions, 3, 'positions'), _rows(directions, 3, 'directions')
    out = np.empty((r.shape[0], q.shape[0]))
    fill_flux_basis(r, n, spans, q, u, out)
    return out


def field_basis(
    points: NDArray[np.generic], positions: NDArray[np.generic], directions: NDArray[np.generic]
) -> Array:
    """Return the field of dipoles of unit moment.

    Parameters
    ----------
    points : ndarray, shape (P, 3)
        Where the field is wanted, m, frame fg.
    positions, directions : ndarray, shape (N, 3)
        Dipole positions (m) and unit directions, frame fg.

    Returns
    -------
    ndarray, shape (P, N, 3)
        Field vectors, frame fg, T / (A m^2).
    """
    r = _rows(points, 3, 'points')
    unit = np.eye(3)
    columns = [
        flux_basis(r, np.broadcast_to(axis, r.shape), None, positions, directions) for axis in unit
    ]
    return np.stack(columns, axis=2)


def flux_jacobian(
    points: NDArray[np.generic],
    axes: NDArray[np.generic],
    lengths: NDArray[np.generic] | None,
    positions: NDArray[np.generic],
    directions: NDArray[np.generic],
    moments: NDArray[np.generic],
) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """Return fluxes with their derivatives by the sensors' positions and axes.

    Parameters
    ----------
    points, axes, lengths, positions, directions
        As for `flux_basis`.
    moments : ndarray, shape (N, K), complex
        Dipole magnitudes for each of the K emitters, A m^2.

    Returns
    -------
    flux : ndarray, shape (P, K), complex
        Flux density along each sensor's axis, T.
    d_position : ndarray, shape (P, 3, K), complex
        Derivative by the sensor's position, T/m.
    d_axis : ndarray, shape (P, 3, K), complex
        Derivative by the components of the axis, T. The axis counts as a free vector, not as a
        unit vector, and the quadrature points move with it.

    Raises
    ------
    ValueError
        When the shapes do not fit together.
    """
    r, n, spans = _sensors(points, axes, lengths)
    q, u = _rows(positions, 3, 'positions'), _rows(directions, 3, 'directions')
    m = np.ascontiguousarray(moments, dtype=np.complex128).view(np.float64)
    flux = np.zeros((r.shape[0], m.shape[1]))
    d_r = np.zeros((r.shape[0], 3, m.shape[1]))
    d_n = np.zeros_like(d_r)
    _fill_flux_jacobian(r, n, spans, q, u, m, flux, d_r, d_n)
    return flux.view(np.complex128), d_r.view(np.complex128), d_n.view(np.complex128)
