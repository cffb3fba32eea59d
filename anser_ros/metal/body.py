"""Models a piece of metal seen from outside: what it makes of multipoles, or of pieces on a
lattice.

Near a body's centre a field is a sum of gradients of solid harmonics; those are the shapes that
count (`anser_ros.metal.scattering`). The leading block of T (orders 1, 1) is the polarisability,
and a block of orders l, l' grows as R^(l + l' + 1) with the body's radius R. Where the body is its
own mirror image about the centre, blocks of odd l + l' vanish, which tells where its centre is.
A body as large as its distance is no sum of few multipoles: it is a lattice of small pieces.
"""

from collections.abc import Callable, Mapping
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from anser_ros.metal.scattering import UNIT, Shapes

Array = NDArray[np.float64]

RADIUS = 0.025
"""Of the sphere on which amplitudes are taken, m: it sets their unit, and nothing else."""
HIGHEST = 4
"""Largest order l of a multipole. Its field falls with distance r as 1 / r^(l + 2), so higher ones
matter only to sensors that almost touch the metal."""
LARGEST_ORDER_SUM = 6
"""Largest sum of two orders that are coupled: what they make falls as the radius over the distance
to the power of the sum and one."""
ODD = 0.2
"""Couplings that a body lacks which is its own mirror image, as a share of others; so much of its
radius its centre may lie beside the symmetric body's."""
RADII = (0.008, 0.012, 0.018, 0.027, 0.04, 0.06, 0.09)
"""Radii (m) of compact bodies that are tried, each half again the one before: from what can hardly
be seen beside a tracked volume to what is larger than its distance."""
PIECES = (0.01, 0.05, 0.2, 1.0)
"""Sizes of an extended body's pieces that are tried, in 1e-4 m^3: perfectly conducting balls with
radii of 5 to 25 mm."""
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


def _orders() -> NDArray[np.int64]:
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
    """Return how well the centre of a body of unknown shape is known at best, m.

    Parameters
    ----------
    polarisability : ndarray, shape (3, 3)
        Of the whole body, m^3. Its radius is taken for that of a perfectly conducting ball which
        is as strong, 2 pi r^3.
    """
    strength = float(np.linalg.norm(polarisability)) / np.sqrt(3)
    return float(ODD * (strength / (2 * np.pi)) ** (1 / 3))


@cache
def ball_modes() -> Array:
    """Return couplings (`Shapes.size`, 7) of a simple body: a unit polarisability, its five
    traceless tensors, and the quadrupoles of a ball.
    """
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
    """Return an extended body: pieces that each answer to the field along x, y and z where they
    are.
    """
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
