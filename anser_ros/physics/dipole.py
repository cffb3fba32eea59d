"""Computes field and gradient of magnetic dipoles, and the flux that a pick-up coil senses.

The field of a dipole m at the offset d is the article's equation (1),
``B = mu0/(4 pi) (3 (m . d) d / |d|^5 - m / |d|^3)``; its gradient follows by differentiation and
is symmetric and traceless outside the source. A coil of length L along its axis n senses the mean
of ``n . B`` over its length, which two-point Gauss-Legendre quadrature at +-L/(2 sqrt 3) gives
with an error of order L^4.
"""

import math
from collections.abc import Callable

import numpy as np

from anser_ros.arrays import AnyArray, Array, ComplexArray
from anser_ros.kernel_cache import kernel
from anser_ros.parallel import in_order, slices, slices_of
from anser_ros.physics.constants import DIPOLE_CONSTANT

GAUSS_OFFSET = 0.5 / math.sqrt(3.0)
"""Offset of the two Gauss-Legendre points from a coil's centre, as a fraction of its length."""
AT_ONCE = 16
"""Points whose couplings to all dipoles are kept at once: what the processor's cache holds."""
POINTS_A_THREAD = 512
"""Points that one thread works out, a millisecond's work."""


def dipole_rows(positions: Array, directions: Array) -> Array:
    """Return x, y, z, u_x, u_y, u_z of dipoles as rows (6, N), which vector registers can load."""
    return np.ascontiguousarray(np.concatenate([positions, directions], axis=1).T)


@kernel(nogil=True)
def fill_flux_basis(points, axes, lengths, dipoles, out):  # type: ignore[no-untyped-def]
    """Write each unit dipole's flux density along each coil's axis into ``out``, shape (P, N).

    The arguments are those of `flux_basis` as contiguous arrays, dipoles as `dipole_rows`; nothing
    is checked.
    """
    x, y, z = dipoles[0], dipoles[1], dipoles[2]
    u, v, w = dipoles[3], dipoles[4], dipoles[5]
    for p in range(points.shape[0]):
        nx, ny, nz = axes[p, 0], axes[p, 1], axes[p, 2]
        half = lengths[p] * GAUSS_OFFSET
        count = 1 if half == 0.0 else 2
        scale, row = DIPOLE_CONSTANT / count, out[p]
        for s in range(count):
            h = half * (1 - 2 * s)
            px, py, pz = points[p, 0] + h * nx, points[p, 1] + h * ny, points[p, 2] + h * nz
            for j in range(x.shape[0]):
                dx, dy, dz = px - x[j], py - y[j], pz - z[j]
                inv2 = 1.0 / (dx * dx + dy * dy + dz * dz)
                inv3 = inv2 * math.sqrt(inv2)
                du = dx * u[j] + dy * v[j] + dz * w[j]
                dn = dx * nx + dy * ny + dz * nz
                nu = nx * u[j] + ny * v[j] + nz * w[j]
                value = scale * (inv3 * (3.0 * du * dn * inv2 - nu))
                row[j] = value if s == 0 else row[j] + value


@kernel(nogil=True)
def fill_coil_basis(points, axes, lengths, dipoles, out):  # type: ignore[no-untyped-def]
    """Write what each unit dipole does to each coil into ``out``, shape (P, 7, N).

    Row 0 holds the flux, rows 1 to 3 its derivatives by the position, rows 4 to 6 those by the
    free axis vector (the Gauss points move with it). One product with the moments gives all of it.
    The other arguments are those of `fill_flux_basis`. Loops run along the rows and write few
    arrays each, so that they go through vector registers.
    """
    px, py, pz = dipoles[0], dipoles[1], dipoles[2]
    vx, vy, vz = dipoles[3], dipoles[4], dipoles[5]
    work = np.empty((4, dipoles.shape[1]))
    along, across, away, near = work[0], work[1], work[2], work[3]
    for p in range(points.shape[0]):
        point, axis, basis = points[p], axes[p], out[p]
        half = lengths[p] * GAUSS_OFFSET
        count = 1 if half == 0.0 else 2
        scale, flux = DIPOLE_CONSTANT / count, basis[0]
        nx, ny, nz = axis[0], axis[1], axis[2]
        for s in range(count):
            h = half * (1 - 2 * s)
            x, y, z = point[0] + h * nx, point[1] + h * ny, point[2] + h * nz
            for j in range(px.shape[0]):
                dx, dy, dz = x - px[j], y - py[j], z - pz[j]
                ux, uy, uz = vx[j], vy[j], vz[j]
                inv2 = 1.0 / (dx * dx + dy * dy + dz * dz)
                k3 = scale * inv2 * math.sqrt(inv2)
                k5 = 3.0 * k3 * inv2
                du = dx * ux + dy * uy + dz * uz
                dn = dx * nx + dy * ny + dz * nz
                nu = nx * ux + ny * uy + nz * uz
                a = k5 * du
                along[j], across[j], near[j] = a, k5 * dn, k3
                away[j] = k5 * (nu - 5.0 * du * dn * inv2)
                value = a * dn - k3 * nu
                flux[j] = value if s == 0 else flux[j] + value
            for i in range(3):
                n, at = axis[i], point[i] + h * axis[i]
                places, directions = dipoles[i], dipoles[3 + i]
                slope, turn = basis[1 + i], basis[4 + i]
                for j in range(places.shape[0]):
                    d, u = at - places[j], directions[j]
                    g = along[j] * n + across[j] * u + away[j] * d
                    b = along[j] * d - near[j] * u + h * g
                    if s == 0:
                        slope[j], turn[j] = g, b
                    else:
                        slope[j] += g
                        turn[j] += b


@kernel(nogil=True)
def fill_fields(points, dipoles, out):  # type: ignore[no-untyped-def]
    """Write each unit dipole's field at points into ``out``, shape (P, 3 or 9, N).

    Rows 0 to 2 hold B_x, B_y, B_z (T); where there are more, rows 3 to 8 hold the gradient's xx,
    xy, xz, yy, yz, zz (T/m). ``dipoles`` is from `dipole_rows`. One row at a time: a loop that
    writes to several is not turned to vector registers.
    """
    count = dipoles.shape[1]
    offset, work = np.empty((3, count)), np.empty((5, count))
    inverse, near, along, k5, k7 = work[0], work[1], work[2], work[3], work[4]
    dx, dy, dz = offset[0], offset[1], offset[2]
    u, v, w = dipoles[3], dipoles[4], dipoles[5]
    for p in range(points.shape[0]):
        for i in range(3):
            way, origin, at = offset[i], dipoles[i], points[p, i]
            for j in range(count):
                way[j] = at - origin[j]
        for j in range(count):
            inverse[j] = 1.0 / (dx[j] * dx[j] + dy[j] * dy[j] + dz[j] * dz[j])
        for j in range(count):
            near[j] = DIPOLE_CONSTANT * inverse[j] * math.sqrt(inverse[j])
        for j in range(count):
            along[j] = dx[j] * u[j] + dy[j] * v[j] + dz[j] * w[j]
        for j in range(count):
            k5[j] = 3.0 * near[j] * inverse[j]
        for i in range(3):
            row, way, direction = out[p, i], offset[i], dipoles[3 + i]
            for j in range(count):
                row[j] = k5[j] * along[j] * way[j] - near[j] * direction[j]
        if out.shape[1] == 3:
            continue
        for j in range(count):
            k7[j] = 5.0 * along[j] * inverse[j]
        place = 3
        for a in range(3):
            for b in range(a, 3):
                row, first, second = out[p, place], offset[a], offset[b]
                ua, ub, same = dipoles[3 + a], dipoles[3 + b], 1.0 if a == b else 0.0
                for j in range(count):
                    mixed = ua[j] * second[j] + ub[j] * first[j] - k7[j] * first[j] * second[j]
                    row[j] = k5[j] * (mixed + same * along[j])
                place += 1


def rows_of(values: AnyArray, width: int, what: str) -> Array:
    """Return values as contiguous rows (n, width); raises `ValueError` for any other shape."""
    array = np.ascontiguousarray(values, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != width:
        raise ValueError(f'{what} must have shape (n, {width}), got {array.shape}')
    return array


def _sensors(
    points: AnyArray, axes: AnyArray, lengths: AnyArray | None
) -> tuple[Array, Array, Array]:
    r, n = rows_of(points, 3, 'points'), rows_of(axes, 3, 'axes')
    if r.shape != n.shape:
        raise ValueError(f'points and axes must match, got {r.shape} and {n.shape}')
    if lengths is None:
        return r, n, np.zeros(r.shape[0])
    # A copy, since kernels are compiled once more for an array that cannot be written to.
    return r, n, np.array(np.broadcast_to(lengths, r.shape[:1]), dtype=np.float64)


def _dipoles(positions: AnyArray, directions: AnyArray) -> Array:
    return dipole_rows(rows_of(positions, 3, 'positions'), rows_of(directions, 3, 'directions'))


def flux_basis(
    points: AnyArray,
    axes: AnyArray,
    lengths: AnyArray | None,
    positions: AnyArray,
    directions: AnyArray,
) -> Array:
    """Return the flux along each sensor's axis by dipoles of unit moment: M of the article.

    Sensor centres ``points`` (m), unit ``axes`` (P, 3) and dipole ``positions`` (m) with unit
    ``directions`` (N, 3) are in the frame fg; coil ``lengths`` (P,), m, are None or 0 for point
    sensors. The result (P, N) is the flux density per moment, T / (A m^2). Raises `ValueError`
    when the shapes do not fit together.
    """
    (r, n, spans), dipoles = _sensors(points, axes, lengths), _dipoles(positions, directions)
    out = np.empty((len(r), dipoles.shape[1]))
    fill_flux_basis(r, n, spans, dipoles, out)
    return out


def field_basis(points: AnyArray, positions: AnyArray, directions: AnyArray) -> Array:
    """Return the field (P, N, 3), T / (A m^2), of dipoles of unit moment.

    ``points`` (P, 3) are in m; ``positions`` (m) and unit ``directions`` (N, 3) are the dipoles',
    all in the frame fg.
    """
    r, dipoles = rows_of(points, 3, 'points'), _dipoles(positions, directions)
    out = np.empty((len(r), 3, dipoles.shape[1]))
    fill_fields(r, dipoles, out)
    return np.moveaxis(out, 1, 2)


def dipole_field(
    points: AnyArray, positions: AnyArray, directions: AnyArray, moments: AnyArray
) -> ComplexArray:
    """Return the field of dipoles, shape (P, 3, K), T; arguments as for `field_basis`.

    ``moments`` (N, K), complex, are the dipoles' magnitudes for each of the K emitters, A m^2.
    """
    r, dipoles = rows_of(points, 3, 'points'), _dipoles(positions, directions)
    m = np.ascontiguousarray(moments, dtype=np.complex128).view(np.float64)
    return _made(lambda here, out: fill_fields(r[here], dipoles, out), len(r), 3, m).view(
        np.complex128
    )


def _made(fill: Callable[[slice, Array], None], points: int, width: int, moments: Array) -> Array:
    """Return what moments (N, C) make at P points, (P, width, C).

    ``fill`` writes what unit dipoles make at a slice of the points, (p, width, N).
    """
    count, columns = moments.shape
    out = np.empty((points, width, columns))

    def work(rows: slice) -> None:
        basis = np.empty((AT_ONCE, width, count))
        for here in slices_of(rows, AT_ONCE):
            few = basis[: here.stop - here.start]
            fill(here, few)
            rows_made = width * len(few)
            np.matmul(
                few.reshape(rows_made, count), moments, out=out[here].reshape(rows_made, columns)
            )

    in_order(work, slices(points, POINTS_A_THREAD))
    return out


def flux_and_slopes(
    points: AnyArray,
    axes: AnyArray,
    lengths: AnyArray | None,
    positions: AnyArray,
    directions: AnyArray,
    moments: Array,
) -> Array:
    """Return `flux_jacobian`'s results for real moments (N, C) side by side, shape (P, 7, C)."""
    (r, n, spans), dipoles = _sensors(points, axes, lengths), _dipoles(positions, directions)
    return _made(
        lambda here, out: fill_coil_basis(r[here], n[here], spans[here], dipoles, out),
        len(r), 7, moments,
    )  # fmt: skip


def flux_jacobian(
    points: AnyArray,
    axes: AnyArray,
    lengths: AnyArray | None,
    positions: AnyArray,
    directions: AnyArray,
    moments: AnyArray,
) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """Return fluxes with their derivatives by the sensors' positions and axes.

    Arguments as for `flux_basis`; ``moments`` (N, K), complex, are the dipoles' magnitudes for
    each of the K emitters, A m^2. Returns the flux density along each sensor's axis (P, K), T, and
    its derivatives (P, 3, K) by the sensor's position, T/m, and by the components of the axis, T.
    The axis counts as a free vector, not as a unit one, and the quadrature points move with it.
    Raises `ValueError` when the shapes do not fit together.
    """
    m = np.ascontiguousarray(moments, dtype=np.complex128).view(np.float64)
    parts = flux_and_slopes(points, axes, lengths, positions, directions, m).view(np.complex128)
    return parts[:, 0], parts[:, 1:4], parts[:, 4:]
