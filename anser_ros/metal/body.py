"""Models pieces of metal: spheres, bodies seen from outside, thin sheets.

Time convention exp(+j w t): a conductor's induced moment opposes the field, and lags by at most a
quarter period.

Near a body's centre a field is a sum of gradients of solid harmonics; those are the shapes that
count (`anser_ros.metal.scattering`). The leading block of T (orders 1, 1) is the polarisability,
and a block of orders l, l' grows as R^(l + l' + 1) with the body's radius R. Where the body is its
own mirror image about the centre, blocks of odd l + l' vanish, which shows where its centre is. A
body as large as its distance is no sum of few multipoles: it is a lattice of small pieces.

A sheet is a mesh of square loops. Loop i of a mesh of edge h obeys ``sum_j (R_ij + j w M_ij) I_j =
-j w Phi_i``: M from Neumann's formula for parallel filaments at the mean distance of the strips
that they stand for (Grover, Inductance Calculations, 1946, ch. 3), R from the sheet resistance,
one square an edge. M scales with h and R not at all, so one generalised eigenproblem serves all
sizes and resistances.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from anser_ros.arrays import Array, ComplexArray, Integers
from anser_ros.field.model import Dipoles
from anser_ros.metal.scattering import UNIT, Shapes
from anser_ros.physics.constants import MU_0

SMALL = 1e-2
"""|x| below which the series of q in x^2 is used: the closed form loses digits there."""


def sphere_polarisability(
    radius_m: float, conductivity_s_per_m: float, relative_permeability: float, omega: Array
) -> ComplexArray:
    """Return the magnetic moment of a sphere per tesla of a uniform field exp(+j w t).

    The vector potential inside is that of the modified spherical Bessel function ``i1(x r / a)``
    with ``x = a sqrt(j w mu sigma)``; matched at the surface it gives the moment
    ``2 pi a^3 / mu_0 (2 mu_r - q) / (mu_r + q)`` with ``q = x^2 / (x coth x - 1) - 1``
    (J. R. Wait, Geophysics 16, 1951, p. 666). The limits are -2 pi a^3 / mu_0 for a perfect
    conductor and ``4 pi a^3 / mu_0 (mu_r - 1) / (mu_r + 2)`` for a permeable insulator, whose
    conductivity is 0. ``omega`` (K,) is in rad/s, the moments (K,) per flux density in A m^2 / T.
    Raises `ValueError` when the radius or permeability is not positive, or another value is
    negative.
    """
    if not (radius_m > 0 and relative_permeability > 0):
        raise ValueError('radius and relative permeability must be positive')
    if not (conductivity_s_per_m >= 0 and np.all(np.asarray(omega) >= 0)):
        raise ValueError('conductivity and frequencies must not be negative')
    mu = relative_permeability
    x = radius_m * np.sqrt(1j * np.asarray(omega) * conductivity_s_per_m * mu * MU_0)
    small = np.abs(x) < SMALL
    large = np.where(small, 1.0, x)
    q = np.where(small, 2.0 + x**2 / 5.0, large**2 / (large / np.tanh(large) - 1.0) - 1.0)
    return np.asarray(2 * np.pi * radius_m**3 / MU_0 * (2 * mu - q) / (mu + q))


RADIUS = 0.025
"""Of the sphere on which amplitudes are taken, m: it sets their unit, and nothing else."""
HIGHEST = 4
"""Largest order l of a multipole: its field falls as 1 / r^(l + 2)."""
LARGEST_ORDER_SUM = 6
"""Largest sum of two orders that are coupled."""
ODD = 0.2
"""Couplings that a body lacks which is its own mirror image, as a share of others; so much of its
radius its centre may lie beside the symmetric body's."""
RADII = (0.008, 0.012, 0.018, 0.027, 0.04, 0.06, 0.09)
"""Radii (m) of compact bodies that are tried, each half again as large as the one before."""
PIECES = (0.01, 0.05, 0.2, 1.0)
"""Sizes of a body's pieces that are tried, 1e-4 m^3: perfectly conducting balls of 5 to 25 mm."""
FREQUENCY_SLOPE = 0.5
"""Prior size of d(ln T) / d(ln f); a sphere's parts have slopes between -1/2 and 1."""


def _sphere_points() -> tuple[Array, Array]:
    """Lebedev's rule with 26 points: unit vectors and weights, exact to degree 7."""
    corners, weights = [], []
    for v in np.ndindex(3, 3, 3):
        point = np.array(v, dtype=np.float64) - 1
        kind = int(np.abs(point).sum())
        if kind:
            corners.append(point / np.linalg.norm(point))
            weights.append({1: 1 / 21, 2: 4 / 105, 3: 9 / 280}[kind])
    return np.array(corners), np.array(weights)


SPHERE_POINTS, SPHERE_WEIGHTS = _sphere_points()


def _zonal_gradients(order: int) -> Array:
    """Gradients of r^l P_l about each of the points' directions, at the points: (n, n, 3)."""
    t = SPHERE_POINTS @ SPHERE_POINTS.T
    p = np.polynomial.legendre.Legendre.basis(order)
    value, slope = p(t), p.deriv()(t)
    along = (order * value - t * slope)[..., None] * SPHERE_POINTS[None, :, :]
    return np.asarray(along + slope[..., None] * SPHERE_POINTS[:, None, :])


def _orders() -> Integers:
    """Order of each shape."""
    return np.repeat(np.arange(1, HIGHEST + 1), 2 * np.arange(1, HIGHEST + 1) + 1)


@cache
def multipoles() -> Shapes:
    """Return all orders up to `HIGHEST`; the first three shapes are the mean field on x, y, z."""
    functionals: list[Array] = [SPHERE_WEIGHTS[:, None] * np.eye(3)[i] for i in range(3)]
    root = np.sqrt(SPHERE_WEIGHTS)[None, :, None]
    for order in range(2, HIGHEST + 1):
        rows = (_zonal_gradients(order) * root).reshape(len(SPHERE_POINTS), -1)
        _, _, shapes = np.linalg.svd(rows, full_matrices=False)
        count = 2 * order + 1
        functionals += list(shapes[:count].reshape(count, -1, 3) * root)
    orders = _orders()
    first, second = np.triu_indices(orders.size)
    keep = orders[first] + orders[second] <= LARGEST_ORDER_SUM
    first, second = first[keep], second[keep]
    dipoles = np.flatnonzero((first < 3) & (second < 3))
    return Shapes(RADIUS * SPHERE_POINTS, np.array(functionals), first, second, dipoles)


def body_spread(radius: float, odd: float) -> Array:
    """Return the prior size of each coupling in a body of a radius (m), shape (`Shapes.size`,).

    Couplings that a symmetric body lacks have the share ``odd`` of it.
    """
    shapes, orders = multipoles(), _orders()
    total = orders[shapes.first] + orders[shapes.second]
    size = 2 * np.pi * radius**3 / UNIT * (radius / RADIUS) ** (total - 2)
    size *= np.where(total % 2, odd, 1.0)
    return np.concatenate([size, FREQUENCY_SLOPE * size[shapes.sloped]])


@cache
def body_sizes(kind: str) -> tuple[Array, ...]:
    """Return prior sizes, shape (`Shapes.size`,) each, of couplings to try of a kind of body."""
    if kind == COMPACT:
        return tuple(body_spread(radius, ODD) for radius in RADII)
    return tuple(np.full(BODIES[kind]().size, size) for size in PIECES)


def centre_sigma(polarisability: NDArray[np.complexfloating]) -> float:
    """Return how well the centre of a body of a polarisability (3, 3), m^3, is known at best, m.

    Its radius is taken for that of a perfectly conducting ball which is as strong, 2 pi r^3.
    """
    strength = float(np.linalg.norm(polarisability)) / np.sqrt(3)
    return float(ODD * (strength / (2 * np.pi)) ** (1 / 3))


@cache
def ball_modes() -> Array:
    """Return a simple body's couplings (`Shapes.size`, 7): six tensors, a ball's quadrupoles."""
    shapes = multipoles()
    where = {(i, j): n for n, (i, j) in enumerate(zip(shapes.first, shapes.second, strict=True))}
    modes = np.zeros((shapes.size, 7))
    diagonal = [where[i, i] for i in range(3)]
    modes[diagonal, 0] = 1.0
    modes[diagonal, 1] = [1.0, -1.0, 0.0]
    modes[diagonal, 2] = [1.0, 1.0, -2.0]
    for n, pair in enumerate(((0, 1), (0, 2), (1, 2))):
        modes[where[pair], 3 + n] = np.sqrt(2)
    modes[[where[i, i] for i in range(3, 8)], 6] = 1.0
    return modes


@cache
def lattice(spacing: float) -> Shapes:
    """Return an extended body: pieces that answer to the field's x, y and z where they are."""
    lateral, upright = (np.arange(6) - 2.5) * spacing, (np.arange(2) - 0.5) * spacing
    offsets = np.array([(a, b, c) for a in lateral for b in lateral for c in upright])
    functionals = np.eye(3 * len(offsets)).reshape(-1, len(offsets), 3)
    every = np.arange(len(functionals))
    return Shapes(offsets, functionals, every, every, np.zeros(0, dtype=np.int64))


COMPACT = 'compact'
# Distances (m) of an extended body's pieces, by its kind: six by six by two of them make bodies
# of 0.1 to 0.3 m, as large as their distance from the sensors.
SPACINGS = {'extended 20 mm': 0.02, 'extended 35 mm': 0.035, 'extended 55 mm': 0.055}
BODIES: Mapping[str, Callable[[], Shapes]] = {
    COMPACT: multipoles,
    **{name: partial(lattice, spacing) for name, spacing in SPACINGS.items()},
}
"""Shapes that a body may be made of, by their name in a record."""


FINEST = 7
"""Half waves along both edges together, at most, of the shapes that a sheet's answer may have."""
SHAPE_POINTS = 12
"""Points along an edge at which the field through a sheet is taken."""
WIDER = 1.06
"""Edge of the waves' square over the sheet's: waves vanish at its edges, currents do not."""
SHEET_SHARES = (0.003, 0.01, 0.03, 0.1, 0.3)
"""Sizes tried of what a meshed sheet lacks, as shares of a perfect conductor's couplings."""


def _strip_distance(aside: Array) -> Array:
    """Geometric mean distance of two coplanar strips of width 1, their centres ``aside`` apart.

    ``ln g = ((k+1)^2 ln(k+1) + (k-1)^2 ln|k-1|) / 2 - k^2 ln k - 3/2`` (Grover, ch. 3).
    """
    k = np.abs(aside)

    def part(x: Array) -> Array:
        return np.asarray(x**2 * np.log(np.where(x == 0, 1.0, np.abs(x))))

    return np.asarray(np.exp((part(k + 1) + part(k - 1)) / 2 - part(k) - 1.5))


def _parallel(ahead: Array, aside: Array) -> Array:
    """Mutual inductance over mu0/(4 pi) of two unit strips, offset ahead and aside."""
    distance = _strip_distance(aside)

    def part(u: Array) -> Array:
        return np.asarray(u * np.arcsinh(u / distance) - np.sqrt(u**2 + distance**2))

    return np.asarray(part(ahead + 1) + part(ahead - 1) - 2 * part(ahead))


@cache
def unit_mesh(count: int) -> tuple[Array, Array]:
    """Return inductance (H at a 1 m edge) and resistance (at 1 ohm a square) of a count^2 mesh."""
    i, j = np.meshgrid(np.arange(count * 1.0), np.arange(count * 1.0), indexing='ij')
    table = np.zeros((count, count))
    for a, b in ((i, j), (j, i)):
        table += 2 * _parallel(a, b) - _parallel(a, b + 1) - _parallel(a, b - 1)
    row, column = np.divmod(np.arange(count * count), count)
    di, dj = np.abs(row[:, None] - row), np.abs(column[:, None] - column)
    inductance = MU_0 / (4 * np.pi) * table[di, dj]
    resistance = 4.0 * (di + dj == 0) - 1.0 * (di + dj == 1)
    return inductance, resistance


@cache
def _modes(count: int) -> tuple[Array, Array]:
    """Time constants and shapes: ``M x = value R x`` with ``x^T R x = 1``."""
    values, vectors = eigh(*unit_mesh(count))
    return np.asarray(values), np.asarray(vectors)


def sheet_sources(
    centre: Array, edges: Array, sheet_ohm: float, count: int, illumination: Dipoles, omega: Array
) -> Dipoles:
    """Return loops of a sheet parallel to the board, as dipoles along z.

    The ``centre`` (3,) and the ``edges`` (2,) along x and y are in m; the mesh of ``count`` loops
    along an edge is scaled with their geometric mean. ``sheet_ohm`` is the resistance of a square,
    ``omega`` (K,) in rad/s.
    """
    values, vectors = _modes(count)
    steps = (np.arange(count) + 0.5) / count - 0.5
    x, y = np.meshgrid(steps * edges[0], steps * edges[1], indexing='ij')
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1) + centre
    area = float(edges[0] * edges[1]) / count**2
    up = np.tile([0.0, 0.0, 1.0], (points.shape[0], 1))
    flux = illumination.flux(points, up, None) * area
    response = values[:, None] * np.sqrt(area) + sheet_ohm / (1j * omega)
    current = -(vectors @ ((vectors.T @ flux) / response))
    return Dipoles(points, up, current * area)


@cache
def _unit_shapes() -> tuple[Shapes, Array]:
    """Sines over a square of edge 1 that vanish at its edges, and their wave numbers."""
    steps = (np.arange(SHAPE_POINTS) + 0.5) / SHAPE_POINTS - 0.5
    x, y = (axis.ravel() for axis in np.meshgrid(steps, steps, indexing='ij'))
    numbers = [(m, n) for m in range(1, FINEST) for n in range(1, FINEST) if m + n <= FINEST]
    functionals = np.zeros((len(numbers), x.size, 3))
    for i, (m, n) in enumerate(numbers):
        wave = np.sin(m * np.pi * (x + 0.5)) * np.sin(n * np.pi * (y + 0.5))
        functionals[i, :, 2] = 2.0 * wave / x.size
    first, second = np.triu_indices(len(numbers))
    offsets = np.stack([x, y, np.zeros(x.size)], axis=1)
    none = np.zeros(0, dtype=np.int64)
    return Shapes(offsets, functionals, first, second, none), np.pi * np.hypot(
        *np.array(numbers).T
    )


def sheet_shapes(edge: float) -> Shapes:
    """Return shapes of the field through a square a little wider than a sheet of an edge, m."""
    shapes, _ = _unit_shapes()
    size = WIDER * edge
    return replace(shapes, offsets=size * shapes.offsets, functionals=size * shapes.functionals)


def sheet_sizes(edge: float) -> tuple[Array, ...]:
    """Return prior sizes of the couplings of a sheet to try, each of shape (`Shapes.size`,).

    They are shares of a perfect conductor's, which answers a normal field of wave number k with
    the stream function ``2 / (mu0 k)`` times it.
    """
    shapes, waves = _unit_shapes()
    each = np.sqrt(2 * WIDER * edge / waves)
    one, other = each[shapes.first], each[shapes.second]
    return tuple(np.asarray(share / UNIT * one * other) for share in SHEET_SHARES)
