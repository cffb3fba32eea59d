"""What a small error of the tracker's model does to the positions that it reports.

A 5-DoF tracker solves for the pose whose predicted fluxes come closest to the measured ones. An
error of the fluxes moves its answer by the pseudo-inverse of the fluxes' derivatives by the pose;
an error of the model is such an error of the fluxes with the other sign. So each effect is a few
columns of displacements over the points of a board, its size unknown.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.physics.board import Board

Array = NDArray[np.float64]

STEP_M = 1e-3
"""Step of the numerical derivative of the flux by the position, m; the field hardly curves over
it."""
POSITION_SCALE_M, ANGLE_SCALE_RAD = 1e-3, 1e-2
"""Scales of position (m) and tilt (rad) by which columns are divided before the pseudo-inverse."""
PLATE_DEPTHS_M = (0.02, 0.05, 0.1)
"""Depths below the board, m, of the metal plates whose effect is tried."""
QUADRATURE = 0.08
"""Modulus of an unexpected quadrature flux over a coil's largest flux."""


@dataclass(frozen=True)
class Points:
    """Where the reported board lies: its points' nominal places in the tracker's frame.

    Attributes
    ----------
    place_m : ndarray, shape (P, 3)
        The ideal board laid onto the reported points, m.
    grid : ndarray, shape (P, 2)
        Place on the board, edges at -1 and 1.
    """

    place_m: Array
    grid: Array


@dataclass(frozen=True)
class BoardResponse:
    """Answers of the tracker to flux errors, sensor upright.

    Attributes
    ----------
    gain : ndarray, shape (P, 3, K)
        m per T of each coil's flux.
    flux : ndarray, shape (P, K)
        T.
    slope : ndarray, shape (P, K, 3)
        Derivative of the flux by the sensor's position, T/m.
    """

    gain: Array
    flux: Array
    slope: Array

    def to(self, flux_error: Array) -> Array:
        """Displacements (P, 3), m, by flux errors (P, K), T."""
        return np.asarray(np.einsum('pik,pk->pi', self.gain, flux_error))


def response(board: Board, place_m: Array) -> BoardResponse:
    """Linearise a least-squares tracker around an upright sensor at each place."""
    field = board.field(place_m)
    ends = [
        board.field(place_m + step) - board.field(place_m - step) for step in STEP_M * np.eye(3)
    ]
    slope = np.stack(ends, axis=-1)[:, :, 2] / (2.0 * STEP_M)
    scale = np.array([POSITION_SCALE_M] * 3 + [ANGLE_SCALE_RAD] * 2)
    jacobian = np.concatenate([slope, field[:, :, :2]], axis=2) * scale
    inverse = np.linalg.pinv(jacobian) * scale[:, None]
    return BoardResponse(inverse[:, :3], field[:, :, 2], slope)


Columns = Callable[[Board, Points, BoardResponse], list[Array]]


def _each_coil(flux_error: Array, answer: BoardResponse) -> list[Array]:
    """One column a coil from flux errors (P, K)."""
    return [answer.gain[:, :, k] * flux_error[:, k, None] for k in range(flux_error.shape[1])]


def _gain(board: Board, points: Points, answer: BoardResponse) -> list[Array]:
    return _each_coil(0.01 * answer.flux, answer)


def _pickup(board: Board, points: Points, answer: BoardResponse) -> list[Array]:
    return _each_coil(np.full_like(answer.flux, 0.01 * np.abs(answer.flux).mean()), answer)


def _moved(board: Board, points: Points, answer: BoardResponse) -> list[Array]:
    return [
        column
        for axis in range(3)
        for column in _each_coil(1e-3 * answer.slope[:, :, axis], answer)
    ]


def _tilted(board: Board, points: Points, answer: BoardResponse) -> list[Array]:
    out = []
    for axis in np.eye(3)[:2]:
        turned = replace(board, rotations=_small_turn(1e-2 * axis) @ board.rotations)
        out += _each_coil(turned.field(points.place_m)[:, :, 2] - answer.flux, answer)
    return out


def _small_turn(vector: Array) -> Array:
    x, y, z = vector
    return np.asarray(np.eye(3) + np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]))


def _quadrature(board: Board, points: Points, answer: BoardResponse) -> list[Array]:
    modulus = np.hypot(answer.flux, QUADRATURE * np.abs(answer.flux).max())
    return _each_coil(np.sign(answer.flux) * modulus - answer.flux, answer)


def _saturation(board: Board, points: Points, answer: BoardResponse) -> list[Array]:
    return [answer.to(0.05 * answer.flux**3 / np.abs(answer.flux).max() ** 2)]


def _crosstalk(board: Board, points: Points, answer: BoardResponse) -> list[Array]:
    count = answer.flux.shape[1]
    return [
        answer.gain[:, :, k] * (0.01 * answer.flux[:, j])[:, None]
        for k in range(count)
        for j in range(count)
        if j != k
    ]


def _plate(board: Board, points: Points, answer: BoardResponse) -> list[Array]:
    out = []
    for depth in PLATE_DEPTHS_M:
        below = board.centres - np.array([0.0, 0.0, 2.0 * depth])
        image = replace(board, centres=below).field(points.place_m)[:, :, 2]
        out.append(answer.to(0.05 * image))
    return out


def _spacing(board: Board, points: Points, answer: BoardResponse) -> list[Array]:
    larger = replace(board, centres=1.01 * board.centres)
    return [answer.to(larger.field(points.place_m)[:, :, 2] - answer.flux)]


def _coil_size(board: Board, points: Points, answer: BoardResponse) -> list[Array]:
    larger = replace(board, shape=1.02 * board.shape)
    return [answer.to(larger.field(points.place_m)[:, :, 2] - answer.flux)]


def _sensor_size(board: Board, points: Points, answer: BoardResponse) -> list[Array]:
    """Mean over a sensor of 10 mm minus the field at its middle: length^2 / 24 times d2/dz2."""
    up = np.array([0.0, 0.0, 5e-3])
    ends = board.field(points.place_m + up) + board.field(points.place_m - up)
    bend = (ends[:, :, 2] - 2.0 * answer.flux) / 5e-3**2
    return [answer.to(0.01**2 / 24.0 * bend)]


def _powers(lowest: int, highest: int) -> Columns:
    def columns(board: Board, points: Points, answer: BoardResponse) -> list[Array]:
        x, y = points.grid.T
        terms = [x**i * y ** (n - i) for n in range(lowest, highest + 1) for i in range(n + 1)]
        return [1e-3 * np.outer(term, axis) for term in terms for axis in np.eye(3)]

    return columns


def _scale(board: Board, points: Points, answer: BoardResponse) -> list[Array]:
    return [0.01 * (points.place_m - points.place_m.mean(axis=0))]


def _drift(board: Board, points: Points, answer: BoardResponse) -> list[Array]:
    order = np.linspace(-1.0, 1.0, len(points.grid))
    return [1e-3 * np.outer(order, axis) for axis in np.eye(3)]


def _hysteresis(board: Board, points: Points, answer: BoardResponse) -> list[Array]:
    """A solver that stops early stays on the way from the point before."""
    before = np.vstack([points.place_m[:1], points.place_m[:-1]])
    return [0.02 * (before - points.place_m)]


EFFECTS: Mapping[str, Columns] = {
    'coil_gain': _gain,
    'pickup': _pickup,
    'coil_moved': _moved,
    'coil_tilted': _tilted,
    'quadrature_in_modulus': _quadrature,
    'saturation': _saturation,
    'coil_crosstalk': _crosstalk,
    'conductive_plate': _plate,
    'coil_spacing': _spacing,
    'coil_size': _coil_size,
    'sensor_size': _sensor_size,
    'drift': _drift,
    'solver_hysteresis': _hysteresis,
    'scale': _scale,
    'affine': _powers(1, 1),
    'quadratic_map': _powers(1, 2),
    'cubic_map': _powers(1, 3),
}
"""Columns of displacements (m) at a plausible size; the last four are maps, not causes."""


def rigid_columns(points: Points) -> list[Array]:
    """The board's own place: three shifts and three turns."""
    arm = points.place_m - points.place_m.mean(axis=0)
    shifts = [np.tile(axis, (len(arm), 1)) for axis in np.eye(3)]
    return [*(1e-2 * shift for shift in shifts), *(0.1 * np.cross(a, arm) for a in np.eye(3))]


def stack(columns: Sequence[Array]) -> Array:
    """Columns (n times (P, 3)) as a matrix (P, 3, n)."""
    return np.stack(columns, axis=-1)
