"""Eddy currents in a thin conducting sheet, solved on a mesh of loop currents.

The sheet is a square grid. Every cell carries a loop current; two cells share the resistance and
the inductance of the edge between them. Edges are filaments with the geometric mean distance of a
strip as wide as a cell (self inductance) or thin filaments (mutual, Neumann's integral of two
parallel pieces in closed form). At each frequency (R + j w L) i = -j w flux.
"""

from dataclasses import dataclass

import numpy as np
from filaments import weighted_field

STRIP_GMD = np.exp(-1.5)
"""Geometric mean distance of a strip from itself, by its width (Grover, section 3)."""


@dataclass(frozen=True)
class Sheet:
    """A square sheet, its middle at ``centre`` (m), turned by ``turn`` (3, 3).

    ``sheet_ohm`` is resistivity over thickness.
    """

    centre: np.ndarray
    turn: np.ndarray
    edge_m: float
    sheet_ohm: float
    cells: int = 22


@dataclass(frozen=True)
class Mesh:
    """Edges from ``start`` to ``end`` (E, 3); ``loops`` (E, L) holds +-1 where a cell uses one."""

    start: np.ndarray
    end: np.ndarray
    loops: np.ndarray
    inductance: np.ndarray
    resistance: np.ndarray
    middles: np.ndarray
    normal: np.ndarray
    area: float


def _antiderivative(shift, apart):
    """Second antiderivative of 1/sqrt(s^2 + d^2), d = 0 included."""
    straight = np.abs(shift) * np.log(np.where(shift == 0, 1.0, np.abs(shift))) - np.abs(shift)
    d = np.where(apart == 0, 1.0, apart)
    aside = shift * np.arcsinh(shift / d) - np.hypot(shift, apart)
    return np.where(apart == 0, straight, aside)


def mutual(shift, apart, length):
    """Mutual inductance (H) of parallel pieces of one length, shifted and apart (m)."""
    total = _antiderivative(shift + length, apart) - 2 * _antiderivative(shift, apart)
    return 1e-7 * (total + _antiderivative(shift - length, apart))


def mesh(sheet):
    """Lay the grid and work out its resistances and inductances."""
    n, h = sheet.cells, sheet.edge_m / sheet.cells
    node = np.arange(n + 1)
    along_x = np.array([(i, j) for j in node for i in range(n)])
    along_y = np.array([(i, j) for i in node for j in range(n)])
    offset = -0.5 * sheet.edge_m
    flat = np.zeros((len(along_x), 1))
    start = np.concatenate([np.hstack([h * e + offset, flat]) for e in (along_x, along_y)])
    step = np.repeat([[h, 0, 0], [0, h, 0]], len(along_x), axis=0)
    loops = np.zeros((2 * len(along_x), n * n))
    for cell in range(n * n):
        i, j = cell % n, cell // n
        loops[[j * n + i, len(along_x) + (i + 1) * n + j], cell] = 1.0
        loops[[(j + 1) * n + i, len(along_x) + i * n + j], cell] = -1.0
    shared = np.abs(loops).sum(axis=1)
    resistance = sheet.sheet_ohm * np.where(shared == 2, 1.0, 2.0)
    inductance = np.zeros((2 * len(along_x),) * 2)
    for rows, edges in (
        (slice(None, len(along_x)), along_x),
        (slice(len(along_x), None), along_y),
    ):
        forward, aside = (0, 1) if edges is along_x else (1, 0)
        shift = h * np.abs(edges[:, None, forward] - edges[None, :, forward])
        apart = h * np.abs(edges[:, None, aside] - edges[None, :, aside])
        np.fill_diagonal(apart, STRIP_GMD * h)
        inductance[rows, rows] = mutual(shift, apart, h)
    cells = np.array([(c % n + 0.5, c // n + 0.5) for c in range(n * n)]) * h + offset
    middles = np.hstack([cells, np.zeros((n * n, 1))])
    return Mesh(
        start=start @ sheet.turn.T + sheet.centre,
        end=(start + step) @ sheet.turn.T + sheet.centre,
        loops=loops,
        inductance=loops.T @ inductance @ loops,
        resistance=loops.T @ (resistance[:, None] * loops),
        middles=middles @ sheet.turn.T + sheet.centre,
        normal=sheet.turn[:, 2],
        area=h * h,
    )


def flux_nodes(grid, sheet):
    """Points (L, 4, 3) whose mean normal field times the area is a cell's flux."""
    h = sheet.edge_m / sheet.cells / np.sqrt(12)
    corners = np.array([[-1, -1, 0], [1, -1, 0], [-1, 1, 0], [1, 1, 0]]) * h
    return grid.middles[:, None] + corners @ sheet.turn.T


def edge_currents(grid, normal_field, omega):
    """Currents (E, K) of all edges by the mean normal field (L, K) of every cell, T."""
    loops = [
        np.linalg.solve(
            grid.resistance + 1j * w * grid.inductance, -1j * w * grid.area * normal_field[:, k]
        )
        for k, w in enumerate(omega)
    ]
    return grid.loops @ np.array(loops).T


def sheet_field(points, grid, currents):
    """Field (P, K, 3) of the edges' currents."""
    return weighted_field(points, grid.start, grid.end, currents)
