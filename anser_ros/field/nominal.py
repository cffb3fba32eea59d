"""Makes the nominal field model: the Biot-Savart field of a drawn board, by dipoles.

A flat coil has the field of a magnetised sheet over its area. A few vertical dipoles on that area
represent the sheet, as the nodes of a quadrature represent an integral; two horizontal dipoles in
the middle represent the feed-throughs and the distance between the layers. The model needs no
measurement, and is as accurate as the drawing: a real board's copper is displaced by fractions of
a millimetre and the gains of its coils differ. The model carries this uncertainty as modes.
"""

from dataclasses import dataclass

import numpy as np

from anser_ros.arrays import Array
from anser_ros.errors import FitError
from anser_ros.field.model import FieldModel
from anser_ros.physics.board import Board, loop_field
from anser_ros.physics.dipole import field_basis

LOWEST_M = 0.06
"""Least height above the copper, m, at which the few dipoles have to be right."""
FIT_REACH_M = 0.5
"""Greatest height, m, of the points that the dipoles are fitted at: beyond, the moment counts."""
FEWEST_NODES, MOST_NODES = 4, 9
"""Vertical dipoles along a side of the coil: the first and the last number that are tried."""
NODE_SPREADS = np.arange(0.6, 0.96, 0.02)
"""Sizes of the dipoles' lattice that are tried, as a fraction of the coil's, as a quadrature's."""
GOOD_MISFIT = 1.5e-4
"""Relative misfit (rms) at which no more dipoles are tried: far below a coil's error (`GAIN`)."""
LARGEST_MISFIT = 1e-2
"""Relative misfit beyond which the nominal model is refused: half of the gain's tolerance."""


GAIN, SHIFT_M, TILT_RAD = 0.02, 5e-4, 5e-3
"""Standard deviations of a manufactured coil's moment (relative), of its place along each axis (m)
and of its tilt about its own x and y (rad): assumptions, not measurements. Larger ones make
reported uncertainties larger and let references change the model more."""


@dataclass(frozen=True)
class _CoilDipoles:
    """The n dipoles that represent one coil in its own frame, with their relative misfit."""

    positions: Array
    directions: Array
    moments: Array
    misfit: float
    worst: float


def _spread_numbers(count: int, base: int) -> Array:
    """Return van der Corput's sequence of a base: evenly spread numbers in (0, 1)."""
    out, index, part = np.zeros(count), np.arange(1, count + 1), 1.0 / base
    while index.any():
        out += part * (index % base)
        index, part = index // base, part / base
    return out


def _points(shape: Array, count: int) -> Array:
    """Return points above a coil, denser near it, m, in the coil's frame."""
    top, half = shape[:, 2].max(), np.abs(shape[:, :2]).max()
    height = LOWEST_M * (FIT_REACH_M / LOWEST_M) ** _spread_numbers(count, 2)
    reach = 1.5 * half + height
    x = reach * (2.0 * _spread_numbers(count, 3) - 1.0)
    y = reach * (2.0 * _spread_numbers(count, 5) - 1.0)
    return np.stack([x, y, top + height], axis=1)


def _design(points: Array, positions: Array, directions: Array, weight: Array) -> Array:
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


def _coil_dipoles(shape: Array, current_a: float, good: float) -> _CoilDipoles:
    """Return the fewest nodes, at their best spread, that reproduce a coil's field well."""
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
        if best is not None and best[0] < good / np.sqrt(3.0):
            break
    assert best is not None
    positions, directions = _nodes(shape, best[1], best[2])
    moments = _solve(_design(train, positions, directions, weight), right)
    model = np.einsum('pni,n->pi', field_basis(held, positions, directions), moments)
    relative = np.linalg.norm(model - truth, axis=1) / np.linalg.norm(truth, axis=1)
    misfit = float(np.sqrt(np.mean(relative**2)))
    return _CoilDipoles(positions, directions, moments, misfit, float(relative.max()))


def _changes(shape: Array, current_a: float, dipoles: _CoilDipoles) -> Array:
    """Return moments (6, n) of the field's change by each tolerance, in the coil's frame."""
    points = _points(shape, 600)
    nominal = loop_field(shape, points, current_a)
    weight = 1.0 / np.linalg.norm(nominal, axis=1)
    matrix = _design(points, dipoles.positions, dipoles.directions, weight)
    changes = [GAIN * dipoles.moments]
    moved = [shape + SHIFT_M * axis for axis in np.eye(3)]
    moved += [shape + TILT_RAD * np.cross(axis, shape) for axis in np.eye(3)[:2]]
    for path in moved:
        change = (loop_field(path, points, current_a) - nominal) * weight[:, None]
        changes.append(_solve(matrix, change.ravel()))
    return np.array(changes)


def nominal_model(board: Board, good: float = GOOD_MISFIT) -> FieldModel:
    """Express the field of a drawn board by dipoles; its tolerances become the model's ``modes``.

    ``good`` is the relative misfit at which no more dipoles are tried.

    The provenance holds ``heldout_relative_rms`` and ``heldout_relative_max``, the misfit relative
    to a coil's field at points above `LOWEST_M` that took no part in the fit. Raises `FitError`
    when the dipoles miss the field of a coil by more than `LARGEST_MISFIT`.
    """
    coil = _coil_dipoles(board.shape, board.current_a, good)
    if not coil.misfit < LARGEST_MISFIT:
        raise FitError(f'dipoles miss the nominal field of a coil by {100 * coil.misfit:.3g} %')
    changes = _changes(board.shape, board.current_a, coil)
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
