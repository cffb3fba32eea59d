"""Finds a coil's pose without any guess: a scan of a precomputed grid, then polish of the best
few.

For a given position the fluxes are linear in the axis, ``y = B^T n`` with the emitters' fields as
columns of B. With ``B B^T = L L^T`` the unexplained power at a grid point is ``|y|^2 - |c|^2``,
``c = L^-1 B y``, and the axis is ``L^-T c``: one small product per point. That a true axis has
length one is a constraint that distinguishes positions; its cost is added to second order.

From each of the best points position and axis descend together. On the drawn board that found all
of 12,000 poses (any axis, 25 x 25 cm, z 8 to 25 cm), as fast as a descent of the position alone,
with the best axis at each, in front of it.
"""

import math
from dataclasses import dataclass

import numpy as np

from anser_ros.arrays import Array, Integers
from anser_ros.errors import TrackingError
from anser_ros.kernel_cache import kernel
from anser_ros.physics.dipole import dipole_field
from anser_ros.physics.volume import TrackedVolume
from anser_ros.tracking.solve import CoilSolution, RealField, solve_coil

SAME_PLACE_M, SAME_AXIS = 2e-3, 0.05
"""Two solutions closer than this (m; chord of the unit axes) are one. On the drawn board, with 80
poses from 30 starts each, those of one pose were within 0.1 mm and 0.0005, those of two poses 3 cm
and 0.5 apart. Larger, and a rival that makes a pose ambiguous is overlooked; smaller, and one
solution is found to rival itself."""

STARTS = 6
"""Starts of a coil without a pose that are always tried. Fewer miss the right valley more often;
each more costs a descent."""
LAST_RESORT = 5
"""How many times more starts are tried when none of the first ones leads below the gate."""
APART, NEARER = 1.5, 1.0
"""Spacings of the grid between the first starts, and the last ones. Nearer first starts are all in
one valley; 5 cm above a board wider last ones miss the narrow right one in 5 poses of 6,000."""


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


def scan(
    grid: SeedGrid, flux: Array, count: int, apart: float = APART
) -> tuple[Integers, Array, Array]:
    """Return the cheapest distinct grid points for fluxes (2K,), T, ``count`` of them at most.

    They are indices, best first; with them come the best unit axis (G, 3) at every grid point, and
    the whitened squared misfit (G,) with it.
    """
    white = flux / grid.sigma
    total = len(grid.points)
    linear = (grid.projectors.reshape(3 * total, -1) @ white).reshape(total, 3)
    cost, axes, chosen = np.empty(total), np.empty((total, 3)), np.empty(count, np.int64)
    found = _pick(
        grid.points, linear, grid.triangles, float(white @ white), apart * grid.spacing_m, chosen,
        cost, axes,
    )  # fmt: skip
    return chosen[:found], axes, cost


def _same(a: CoilSolution, b: CoilSolution) -> bool:
    return bool(
        np.linalg.norm(a.position - b.position) < SAME_PLACE_M
        and np.linalg.norm(a.axis - b.axis) < SAME_AXIS
    )


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
    reached: list[CoilSolution] = []
    for count, apart in ((STARTS, APART), (LAST_RESORT * STARTS, NEARER)):
        chosen, axes, _ = scan(grid, flux, count, apart)
        reached += [
            solve_coil(field, flux, whitening, grid.points[i], axes[i], low, high, length_m)
            for i in chosen.tolist()
        ]
        found: list[CoilSolution] = []
        for solution in sorted(reached, key=lambda one: one.chi2):
            if not any(_same(solution, other) for other in found):
                found.append(solution)
        if found[0].chi2 <= gate or not thorough:
            break
    return found
