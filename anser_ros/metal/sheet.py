"""Computes eddy currents of a thin square sheet, on a mesh of square loops.

Loop i of a mesh of edge h obeys ``sum_j (R_ij + j w M_ij) I_j = -j w Phi_i``: M from Neumann's
formula for parallel filaments at the mean distance of the strips that they stand for (Grover,
Inductance Calculations, 1946, ch. 3), R from the sheet resistance, one square an edge.
M scales with h and R not at all, so one generalised eigenproblem serves all sizes and resistances.
"""

from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from anser_ros.field.dipoles import Dipoles
from anser_ros.metal.scattering import UNIT, Shapes
from anser_ros.physics.constants import MU_0

Array = NDArray[np.float64]

FINEST = 7
"""Half waves along both edges together, at most, of the shapes that a sheet's answer may have."""
SHAPE_POINTS = 12
"""Points along an edge at which the field through a sheet is taken, more than three in the
shortest of the waves."""
WIDER = 1.06
"""Edge of the square that carries the waves, over the sheet's: they vanish at its edges, where the
currents of the sheet are largest."""
SHEET_SHARES = (0.003, 0.01, 0.03, 0.1, 0.3)
"""Sizes that are tried of what the couplings of a meshed sheet lack, as shares of a perfect
conductor's: from what the mesh leaves to holes, rims and a second sheet."""


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
    """Return shapes of the field through a square sheet, its edge (m) a little wider than the
    sheet.
    """
    shapes, _ = _unit_shapes()
    size = WIDER * edge
    return replace(shapes, offsets=size * shapes.offsets, functionals=size * shapes.functionals)


def sheet_spread(edge: float, share: float) -> Array:
    """Return each coupling's prior size as a share of a perfect conductor's, shape
    (`Shapes.size`,).

    A perfectly conducting sheet answers a normal field of wave number k with the stream function
    ``2 / (mu0 k)`` times it.
    """
    shapes, waves = _unit_shapes()
    each = np.sqrt(2 * WIDER * edge / waves)
    return np.asarray(share / UNIT * each[shapes.first] * each[shapes.second])


def sheet_sizes(edge: float) -> tuple[Array, ...]:
    """Return prior sizes of the couplings of a sheet to try, each of shape (`Shapes.size`,)."""
    return tuple(sheet_spread(edge, share) for share in SHEET_SHARES)
