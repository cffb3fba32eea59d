"""Eddy currents of a thin square sheet, on a mesh of square loops.

Loop i of a mesh of edge h obeys ``sum_j (R_ij + j w M_ij) I_j = -j w Phi_i``: M from Neumann's
formula for parallel filaments at the mean distance of the strips that they stand for (Grover,
Inductance Calculations, 1946, ch. 3), R from the sheet resistance, one square an edge.
M scales with h and R not at all, so one generalised eigenproblem serves all sizes and resistances.
"""

from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

from anser_ros.effects.dipoles import Dipoles
from anser_ros.physics.constants import MU_0

Array = NDArray[np.float64]


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
    """Inductance (H at an edge of 1 m) and resistance (at 1 ohm a square) of a count^2 mesh."""
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
    """Loops of a sheet parallel to the board, as dipoles along z.

    Parameters
    ----------
    centre : ndarray, shape (3,)
        m.
    edges : ndarray, shape (2,)
        Along x and y, m; the mesh is scaled with their geometric mean.
    sheet_ohm : float
        Resistance of a square.
    count : int
        Loops along an edge.
    illumination : Dipoles
    omega : ndarray, shape (K,)
        rad/s.
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
