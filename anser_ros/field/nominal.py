"""The nominal field model: a drawn board's Biot-Savart field, expressed by dipoles.

A flat coil's field is that of a magnetised sheet over its area. A few vertical dipoles on that
area stand for the sheet, as quadrature nodes do for an integral, and two flat ones in the middle
for the feed-throughs and for the distance of the layers. It needs no measurement, and it is as
good as the drawing: a real board's copper lies fractions of a millimetre elsewhere and its gains
differ, so the model carries that uncertainty as modes.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import FitError
from anser_ros.field.model import FieldModel
from anser_ros.physics.board import Board
from anser_ros.physics.dipole import field_basis
from anser_ros.physics.tracks import loop_field

Array = NDArray[np.float64]

LOWEST_M = 0.06
FIT_REACH_M = 0.5
"""The dipoles hold from `LOWEST_M` above the copper on, m, and are fitted as far as this."""
FEWEST_NODES, MOST_NODES = 4, 9
NODE_SPREADS = np.arange(0.6, 0.96, 0.02)
GOOD_MISFIT = 1.5e-4
LARGEST_MISFIT = 1e-2


@dataclass(frozen=True)
class Tolerances:
    """Standard deviations of what a manufactured board differs in from its drawing.

    Attributes
    ----------
    gain : float
        Relative moment of each coil (turns, shape, current scale).
    shift_m : float
        Position of each coil along x, y and z, m.
    tilt_rad : float
        Tilt of each coil about its own x and y, rad.
    """

    gain: float = 0.02
    shift_m: float = 5e-4
    tilt_rad: float = 5e-3


@dataclass(frozen=True)
class _CoilDipoles:
    """Dipoles (n, 3) that stand for one coil in its own frame, and how well they do."""

    positions: Array
    directions: Array
    moments: Array
    misfit: float
    worst: float


def _spread_numbers(count: int, base: int) -> Array:
    """Van der Corput's sequence: evenly spread numbers in (0, 1)."""
    out, index, part = np.zeros(count), np.arange(1, count + 1), 1.0 / base
    while index.any():
        out += part * (index % base)
        index, part = index // base, part / base
    return out


def _points(shape: Array, count: int) -> Array:
    """Points above a coil, denser near it, m, in its own frame."""
    top, half = shape[:, 2].max(), np.abs(shape[:, :2]).max()
    height = LOWEST_M * (FIT_REACH_M / LOWEST_M) ** _spread_numbers(count, 2)
    reach = 1.5 * half + height
    x = reach * (2.0 * _spread_numbers(count, 3) - 1.0)
    y = reach * (2.0 * _spread_numbers(count, 5) - 1.0)
    return np.stack([x, y, top + height], axis=1)


def _design(
    points: Array, positions: Array, directions: Array, weight: Array
) -> NDArray[np.float64]:
    basis = field_basis(points, positions, directions) * weight[:, None, None]
    return np.asarray(basis.swapaxes(1, 2).reshape(-1, len(positions)))


def _solve(matrix: Array, right: Array) -> Array:
    scale = np.linalg.norm(matrix, axis=0)
    solution = np.linalg.lstsq(matrix / scale, right, rcond=1e-9)[0]
    return np.asarray((solution.T / scale).T)


def _nodes(shape: Array, count: int, spread: float) -> tuple[Array, Array]:
    middle = 0.5 * (shape.min(axis=0) + shape.max(axis=0))
    half = 0.5 * (shape.max(axis=0) - shape.min(axis=0))
    x, y = np.meshgrid(*(spread * half[i] * np.linspace(-1, 1, count) for i in range(2)))
    sheet = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1) + middle
    positions = np.concatenate([sheet, np.tile(middle, (2, 1))])
    directions = np.zeros_like(positions)
    directions[:-2, 2] = directions[-2, 0] = directions[-1, 1] = 1.0
    return positions, directions


def _coil_dipoles(shape: Array, current_a: float) -> _CoilDipoles:
    """Fewest nodes, at their best spread, that reproduce a coil's field well."""
    points = _points(shape, 1200)
    train, held = points[:600], points[600:]
    field, truth = loop_field(shape, train, current_a), loop_field(shape, held, current_a)
    weight = 1.0 / np.linalg.norm(field, axis=1)
    right = (field * weight[:, None]).ravel()
    best: tuple[float, int, float] | None = None
    for count in range(FEWEST_NODES, MOST_NODES + 1):
        for spread in NODE_SPREADS.tolist():
            matrix = _design(train, *_nodes(shape, count, spread), weight)
            misfit = float(np.std(matrix @ _solve(matrix, right) - right))
            if best is None or misfit < best[0]:
                best = (misfit, count, spread)
        if best is not None and best[0] < GOOD_MISFIT / np.sqrt(3.0):
            break
    assert best is not None
    positions, directions = _nodes(shape, best[1], best[2])
    moments = _solve(_design(train, positions, directions, weight), right)
    model = np.einsum('pni,n->pi', field_basis(held, positions, directions), moments)
    relative = np.linalg.norm(model - truth, axis=1) / np.linalg.norm(truth, axis=1)
    misfit = float(np.sqrt(np.mean(relative**2)))
    return _CoilDipoles(positions, directions, moments, misfit, float(relative.max()))


def _changes(shape: Array, current_a: float, dipoles: _CoilDipoles, allowed: Tolerances) -> Array:
    """Moments (6, n) of the field's change by each tolerance, in the coil's own frame."""
    points = _points(shape, 600)
    nominal = loop_field(shape, points, current_a)
    weight = 1.0 / np.linalg.norm(nominal, axis=1)
    matrix = _design(points, dipoles.positions, dipoles.directions, weight)
    changes = [allowed.gain * dipoles.moments]
    moved = [shape + allowed.shift_m * axis for axis in np.eye(3)]
    moved += [shape + allowed.tilt_rad * np.cross(axis, shape) for axis in np.eye(3)[:2]]
    for path in moved:
        change = (loop_field(path, points, current_a) - nominal) * weight[:, None]
        changes.append(_solve(matrix, change.ravel()))
    return np.array(changes)


def nominal_model(board: Board, tolerances: Tolerances | None = None) -> FieldModel:
    """Express a drawn board's field by dipoles.

    Parameters
    ----------
    board : Board
    tolerances : Tolerances, optional
        How far a real board may be from the drawing; they become the model's ``modes``.

    Returns
    -------
    FieldModel
        Its provenance holds ``heldout_relative_rms`` and ``heldout_relative_max``: the misfit over
        a coil's own field at points that took no part, from 6 cm above the copper on.

    Raises
    ------
    FitError
        When the dipoles can't reproduce a coil's field to a hundredth.
    """
    coil = _coil_dipoles(board.shape, board.current_a)
    if not coil.misfit < LARGEST_MISFIT:
        raise FitError(f'dipoles miss the nominal field of a coil by {100 * coil.misfit:.3g} %')
    changes = _changes(board.shape, board.current_a, coil, tolerances or Tolerances())
    emitters, each = len(board.names), len(coil.positions)
    moments = np.zeros((emitters * each, emitters), dtype=np.complex128)
    modes = np.zeros((emitters * len(changes), emitters * each, emitters), dtype=np.complex128)
    positions, directions = [], []
    for k, (turn, centre) in enumerate(zip(board.rotations, board.centres, strict=True)):
        rows = slice(k * each, (k + 1) * each)
        positions.append(coil.positions @ turn.T + centre)
        directions.append(coil.directions @ turn.T)
        moments[rows, k] = coil.moments
        modes[k * len(changes) : (k + 1) * len(changes), rows, k] = changes
    return FieldModel(
        positions=np.concatenate(positions),
        directions=np.concatenate(directions),
        moments=moments,
        emitters=board.names,
        frequencies_hz=board.frequencies_hz,
        modes=modes,
        provenance={
            'source': 'nominal',
            'n_dipoles': emitters * each,
            'heldout_relative_rms': coil.misfit,
            'heldout_relative_max': coil.worst,
            'lowest_height_m': LOWEST_M,
        },
    )
