"""Finds a coil's pose without any guess: a scan of a precomputed grid, then polish of the best
few.

For a given position the fluxes are linear in the axis, ``y = B^T n`` with the emitters' fields as
columns of B. With ``B B^T = L L^T`` the unexplained power at a grid point is ``|y|^2 - |c|^2``,
``c = L^-1 B y``, and the axis is ``L^-T c``: one small product per point. That a true axis has
length one is a constraint that distinguishes positions; its cost is added to second order.

From far away the joint descent is slow and ends in false minima, because position and axis trade
against each other. So the first descent is by position alone, with the best axis at every position
(variable projection: Golub and Pereyra 1973, with Kaufman's simplification), the coil taken for a
point; the joint descent that follows knows its length.
"""

import math
from dataclasses import dataclass

import numpy as np

from anser_ros.arrays import Array, Integers
from anser_ros.errors import TrackingError
from anser_ros.kernel_cache import inlined, kernel
from anser_ros.physics.dipole import dipole_field, fill_fields
from anser_ros.physics.rotations import fill_tangent
from anser_ros.physics.volume import TrackedVolume
from anser_ros.tracking.descent import damped_step
from anser_ros.tracking.solve import CoilSolution, RealField, solve_coil

LARGEST_MOVE_M = 0.05
"""Longest step of the position, m; beyond it the linearised field is no guide any more."""
AXIS_STEPS = 3
"""Newton steps that bring the linear solution for the axis to unit length; they converge
quadratically from a start that is nearly a unit vector."""
NEAR = 1e-4
"""A relative fall of chi-square below this ends the descent: the joint one does the rest."""


@inlined
def _turn(field, flux, axis, tangent, plane, residual):  # type: ignore[no-untyped-def]
    """Best small turn of the axis in a given whitened field (3, 2K); returns chi-square after it.

    ``plane`` (2, 2K) is left with the orthonormal directions that turns of the axis reach.
    """
    width = flux.shape[0]
    chi2 = 0.0
    for step in range(AXIS_STEPS + 1):
        chi2 = 0.0
        for k in range(width):
            residual[k] = flux[k] - (
                axis[0] * field[0, k] + axis[1] * field[1, k] + axis[2] * field[2, k]
            )
            chi2 += residual[k] * residual[k]
        fill_tangent(axis, tangent)
        a00, a01, a11, g0, g1 = 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(width):
            u = (
                tangent[0, 0] * field[0, k]
                + tangent[0, 1] * field[1, k]
                + tangent[0, 2] * field[2, k]
            )
            v = (
                tangent[1, 0] * field[0, k]
                + tangent[1, 1] * field[1, k]
                + tangent[1, 2] * field[2, k]
            )
            plane[0, k], plane[1, k] = u, v
            a00 += u * u
            a01 += u * v
            a11 += v * v
            g0 += u * residual[k]
            g1 += v * residual[k]
        if step == AXIS_STEPS:
            break
        determinant = max(a00 * a11 - a01 * a01, 1e-12 * a00 * a11 + 1e-300)
        x, y = (a11 * g0 - a01 * g1) / determinant, (a00 * g1 - a01 * g0) / determinant
        size = math.sqrt(x * x + y * y)
        if size > 1.0:
            x, y = x / size, y / size
        norm = 0.0
        for i in range(3):
            axis[i] += x * tangent[0, i] + y * tangent[1, i]
            norm += axis[i] * axis[i]
        for i in range(3):
            axis[i] /= math.sqrt(norm)
    length = math.sqrt(max(a00, 1e-300))
    dot = 0.0
    for k in range(width):
        plane[0, k] /= length
        dot += plane[0, k] * plane[1, k]
    length = 1e-300
    for k in range(width):
        plane[1, k] -= dot * plane[0, k]
        length += plane[1, k] * plane[1, k]
    for k in range(width):
        plane[1, k] /= math.sqrt(length)
    return chi2


@inlined
def _look(  # type: ignore[no-untyped-def]
    position, axis, flux, inverse_sigma, dipoles, moments, basis, tangent, plane, residual, normal,
    gradient,
):  # fmt: skip
    """Best axis at a position; returns chi-square with it.

    ``normal`` (3, 3) and ``gradient`` (3,) are left for a step of the position.
    """
    width = flux.shape[0]
    fill_fields(position.reshape(1, 3), dipoles, basis)
    f = np.dot(basis[0], moments)
    for k in range(width):
        for i in range(9):
            f[i, k] *= inverse_sigma[k]
    chi2 = _turn(f[:3], flux, axis, tangent, plane, residual)
    n0, n1, n2 = axis[0], axis[1], axis[2]
    slopes = f[3:6]
    for k in range(width):
        xx, xy, xz, yy, yz, zz = f[3, k], f[4, k], f[5, k], f[6, k], f[7, k], f[8, k]
        slopes[0, k] = n0 * xx + n1 * xy + n2 * xz
        slopes[1, k] = n0 * xy + n1 * yy + n2 * yz
        slopes[2, k] = n0 * xz + n1 * yz + n2 * zz
    for i in range(3):
        for p in range(2):
            dot = 0.0
            for k in range(width):
                dot += plane[p, k] * slopes[i, k]
            for k in range(width):
                slopes[i, k] -= dot * plane[p, k]
    for i in range(3):
        gradient[i] = 0.0
        for k in range(width):
            gradient[i] += slopes[i, k] * residual[k]
        for j in range(i + 1):
            total = 0.0
            for k in range(width):
                total += slopes[i, k] * slopes[j, k]
            normal[i, j] = normal[j, i] = total
    return chi2


@kernel
def descend_projected(  # type: ignore[no-untyped-def]
    position, axis, flux, inverse_sigma, dipoles, moments, low, high, budget,
):  # fmt: skip
    """Move ``position`` and ``axis`` (in place) towards a minimum.

    ``flux`` is in tesla, ``dipoles`` (6, N) are `solve.RealField.columns`. Returns chi-square (of
    a point coil) and the evaluations used.
    """
    width = flux.shape[0]
    basis, white = np.empty((1, 9, dipoles.shape[1])), np.empty(width)
    for k in range(width):
        white[k] = flux[k] * inverse_sigma[k]
    tangent, plane, residual = np.empty((2, 3)), np.empty((2, width)), np.empty(width)
    normal, gradient, new_normal, new_gradient = (
        np.zeros((3, 3)), np.zeros(3), np.zeros((3, 3)), np.zeros(3)
    )  # fmt: skip
    step, factor, new_position, new_axis = np.empty(3), np.empty((3, 3)), np.empty(3), np.empty(3)
    for i in range(3):
        new_position[i], new_axis[i] = position[i], axis[i]
    chi2, damping, used = np.inf, 1e-3, 0
    while used < budget:
        trial = _look(
            new_position, new_axis, white, inverse_sigma, dipoles, moments, basis, tangent, plane,
            residual, new_normal, new_gradient,
        )  # fmt: skip
        used += 1
        if trial < chi2:
            done = chi2 - trial < NEAR * chi2
            damping *= 0.2 if used > 1 else 1.0
            chi2 = trial
            for i in range(3):
                position[i], axis[i] = new_position[i], new_axis[i]
            normal, new_normal = new_normal, normal
            gradient, new_gradient = new_gradient, gradient
            if done:
                break
        else:
            damping = max(8.0 * damping, 1e-4)
        if damping > 1e8 or not damped_step(normal, gradient, damping, factor, step):
            break
        size = math.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
        part, moved = min(1.0, LARGEST_MOVE_M / max(size, 1e-300)), 0.0
        for i in range(3):
            new_position[i] = min(max(position[i] + part * step[i], low[i]), high[i])
            moved = max(moved, abs(new_position[i] - position[i]))
            new_axis[i] = axis[i]
        if moved < 1e-6:
            break
    return chi2, used


SAME_PLACE_M, SAME_AXIS = 2e-3, 0.05
"""Two solutions closer than this (m; chord of the unit axes) are one. On the drawn board, with 80
poses from 30 starts each, those of one pose were within 0.1 mm and 0.0005, those of two poses 3 cm
and 0.5 apart. Larger, and a rival that makes a pose ambiguous is overlooked; smaller, and one
solution is found to rival itself."""

PROJECTED_BUDGET = 25
"""Evaluations that the descent of a start may take with the axis eliminated, before the joint
descent; starts that need more are in a wrong valley."""
HOPELESS = 100.0
"""Starts whose descent ends so many times above the gate and the best one are given up."""

STARTS = 6
"""Starts of a coil without a pose that are always tried. Fewer miss the right valley more often;
each more costs a descent."""
LAST_RESORT = 5
"""How many times more starts are tried when none of the first ones leads below the gate."""


@dataclass(frozen=True)
class SeedGrid:
    """Holds positions (G, 3) of the grid and, for each, what turns fluxes into an axis."""

    points: Array  # (G, 3), m, frame fg
    projectors: Array  # (G, 3, 2K), ``L^-1 B``, whitened
    triangles: Array  # (G, 3, 3), ``L^-1``
    sigma: Array  # (2K,), standard deviations that the grid was whitened with, T
    spacing_m: float  # Distance between neighbours in the board's plane at the volume's floor


@kernel
def _pick(points, linear, triangles, power, apart, chosen, cost, axes):  # type: ignore[no-untyped-def]
    """Cost of a unit axis at every grid point, and that axis; returns how many are ``chosen``.

    These are the cheapest points that are apart from each other in place or axis.
    """
    alive = np.ones(points.shape[0], np.bool_)
    for g in range(linear.shape[0]):
        c0, c1, c2 = linear[g, 0], linear[g, 1], linear[g, 2]
        t = triangles[g]
        n0 = t[0, 0] * c0 + t[1, 0] * c1 + t[2, 0] * c2
        n1 = t[1, 1] * c1 + t[2, 1] * c2
        n2 = t[2, 2] * c2
        length = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2) + 1e-300
        n0, n1, n2 = n0 / length, n1 / length, n2 / length
        axes[g, 0], axes[g, 1], axes[g, 2] = n0, n1, n2
        # variance of the axis' length: n^T (B B^T)^-1 n = |L^-1 n|^2
        v0 = t[0, 0] * n0
        v1 = t[1, 0] * n0 + t[1, 1] * n1
        v2 = t[2, 0] * n0 + t[2, 1] * n1 + t[2, 2] * n2
        variance = v0 * v0 + v1 * v1 + v2 * v2
        cost[g] = power - (c0 * c0 + c1 * c1 + c2 * c2) + (length - 1.0) ** 2 / variance
    for found in range(chosen.shape[0]):
        best = -1
        for g in range(points.shape[0]):
            if alive[g] and (best < 0 or cost[g] < cost[best]):
                best = g
        if best < 0:
            return found
        chosen[found] = best
        for g in range(points.shape[0]):
            square, dot = 0.0, 0.0
            for i in range(3):
                square += (points[g, i] - points[best, i]) ** 2
                dot += axes[g, i] * axes[best, i]
            if square < apart * apart and dot > 0.5:
                alive[g] = False
    return chosen.shape[0]


CLOSEST_M = 5e-3
"""Distance (m) from the field's dipoles within which no start pose is: nothing fits between."""


def grid_points(volume: TrackedVolume, spacing_m: float, source: Array | None = None) -> Array:
    """Return points of a grid that covers a volume, shape (G, 3), m.

    The field changes over a length that grows with the height, so does the spacing: ``spacing_m``
    holds at 0.1 m height and grows in proportion above it. Around a ``source`` (3,), m, in the
    volume it is that of half the way from there to the nearest side everywhere. Raises
    `TrackingError` when the spacing is not positive, or the grid would have more than 100,000
    points.
    """
    if not (math.isfinite(spacing_m) and spacing_m > 0):
        raise TrackingError(f'grid spacing must be positive, got {spacing_m}')
    low, high = np.array(volume.low), np.array(volume.high)
    way = 0.0 if source is None else float(min((high - source).min(), (source - low).min()))
    layers, z, total = [], float(low[2]), 0
    while True:
        step = spacing_m * max(way / 2.0 if way > 0.0 else abs(z), 0.05) / 0.1
        sides = [
            np.linspace(low[i], high[i], max(2, math.ceil((high[i] - low[i]) / step) + 1))
            for i in range(2)
        ]
        total += sides[0].size * sides[1].size
        if total > 100_000:
            raise TrackingError(f'a grid spacing of {spacing_m} m is too fine for the volume')
        x, y = np.meshgrid(*sides, indexing='ij')
        layers.append(np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], axis=1))
        if z >= high[2]:
            return np.ascontiguousarray(np.concatenate(layers))
        z = min(z + step, float(high[2]))


def build_grid(
    field: RealField, sigma: Array, volume: TrackedVolume, spacing_m: float = 0.025
) -> SeedGrid:
    """Precompute the scan of a volume; ``sigma`` (2K,) is each flux component's, T.

    Raises `TrackingError` when the spacing doesn't suit the volume, see `grid_points`.
    """
    points = grid_points(volume, spacing_m, field.positions.mean(axis=0))
    if volume.low[2] <= field.positions[:, 2].max():  # it reaches around the dipoles
        apart = np.linalg.norm(points[:, None] - field.positions, axis=2).min(axis=1)
        points = np.ascontiguousarray(points[apart > CLOSEST_M])
    moments = field.moments.view(np.complex128)
    fields = dipole_field(points, field.positions, field.directions, moments)
    white = np.ascontiguousarray(fields).view(np.float64) / sigma
    gram = white @ white.swapaxes(1, 2)
    ridge = 1e-12 * np.trace(gram, axis1=1, axis2=2) + 1e-300
    triangles = np.linalg.inv(np.linalg.cholesky(gram + ridge[:, None, None] * np.eye(3)))
    return SeedGrid(points, triangles @ white, triangles, np.array(sigma), spacing_m)


def scan(grid: SeedGrid, flux: Array, count: int) -> tuple[Integers, Array, Array]:
    """Return the cheapest distinct grid points for fluxes (2K,), T, ``count`` of them at most.

    They are indices, best first; with them come the best unit axis (G, 3) at every grid point, and
    the whitened squared misfit (G,) with it.
    """
    white = flux / grid.sigma
    total = len(grid.points)
    linear = (grid.projectors.reshape(3 * total, -1) @ white).reshape(total, 3)
    cost, axes, chosen = np.empty(total), np.empty((total, 3)), np.empty(count, np.int64)
    apart = 1.5 * grid.spacing_m
    found = _pick(
        grid.points, linear, grid.triangles, float(white @ white), apart, chosen, cost, axes
    )
    return chosen[:found], axes, cost


def _same(a: CoilSolution, b: CoilSolution) -> bool:
    return bool(
        np.linalg.norm(a.position - b.position) < SAME_PLACE_M
        and np.linalg.norm(a.axis - b.axis) < SAME_AXIS
    )


def _polish(
    field: RealField,
    grid: SeedGrid,
    flux: Array,
    whitening: Array,
    low: Array,
    high: Array,
    length_m: float,
    gate: float,
    starts: Integers,
    axes: Array,
) -> list[CoilSolution]:
    """Distinct solutions that these grid points lead to."""
    inverse_sigma = 1.0 / grid.sigma
    reached = []
    for index in starts:
        position, axis = grid.points[index].copy(), axes[index].copy()
        chi2, _ = descend_projected(
            position, axis, flux, inverse_sigma, field.columns, field.moments, low, high,
            PROJECTED_BUDGET,
        )  # fmt: skip
        reached.append((chi2, position, axis))
    reached.sort(key=lambda item: item[0])
    found: list[CoilSolution] = []
    for chi2, position, axis in reached:
        if chi2 > max(HOPELESS * gate, HOPELESS * reached[0][0]):
            break
        solution = solve_coil(field, flux, whitening, position, axis, low, high, length_m)
        if not any(_same(solution, other) for other in found):
            found.append(solution)
    return found


def solve_cold(
    field: RealField,
    grid: SeedGrid,
    flux: Array,
    whitening: Array,
    low: Array,
    high: Array,
    length_m: float = 0.0,
    gate: float = math.inf,
    thorough: bool = True,
) -> list[CoilSolution]:
    """Return every distinct pose that the best grid points lead to, least chi-square first.

    There is at least one. ``gate`` is the chi-square that an acceptable pose stays below; when
    none of the first starts leads there, a ``thorough`` search tries more. The other arguments are
    those of `solve_coil`.
    """
    found: list[CoilSolution] = []
    tried = 0
    for count in (STARTS, LAST_RESORT * STARTS):
        chosen, axes, _ = scan(grid, flux, count)
        more = _polish(
            field, grid, flux, whitening, low, high, length_m, gate, chosen[tried:], axes
        )
        found += [new for new in more if not any(_same(new, old) for old in found)]
        found.sort(key=lambda solution: solution.chi2)
        tried = len(chosen)
        if found[0].chi2 <= gate or not thorough:
            break
    return found
