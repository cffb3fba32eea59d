"""Emitter boards: their geometry as data, turned into closed current paths.

How many coils there are, of which kind, and where is data. A *kind* is a rule that draws one coil
around its own centre. Drawing another board means adding a rule to `KINDS`.

``winding`` in the geometry says which way a positive current runs, seen from +z: ``ccw`` (moment
along +z) or ``cw``. Printed spirals wind ``cw`` unless told otherwise, as the Anser board's do:
its measured in-phase moments are negative; plain loops wind ``ccw``.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import SetupError
from anser_ros.physics.tracks import loop_moment, paths_field

Array = NDArray[np.float64]

MOST_TRACKS = 20_000
_DIRECTIONS = ((0.0, 1.0), (-1.0, 0.0), (0.0, -1.0), (1.0, 0.0))
"""Way of each track of a turn; the first one runs along +y at the right-hand side."""


@dataclass(frozen=True)
class Board:
    """K emitter coils of one shape.

    Attributes
    ----------
    names : tuple of str, length K
    frequencies_hz : tuple of float, length K
    shape : ndarray, shape (M, 3)
        Corners of one coil's closed path around its own centre, m; the last is joined to the
        first.
    current_a : float
        Nominal current times the turns that the path stands for, A.
    centres : ndarray, shape (K, 3)
        m, frame fg.
    rotations : ndarray, shape (K, 3, 3)
        Each coil's own frame in fg.
    """

    names: tuple[str, ...]
    frequencies_hz: tuple[float, ...]
    shape: Array
    current_a: float
    centres: Array
    rotations: Array

    @property
    def paths(self) -> tuple[Array, ...]:
        """Every coil's corners, m, frame fg."""
        pairs = zip(self.rotations, self.centres, strict=True)
        return tuple(self.shape @ turn.T + centre for turn, centre in pairs)

    def field(self, points: NDArray[np.generic]) -> Array:
        """Field (T) of every coil at its nominal current, shape (P, K, 3)."""
        return paths_field(self.paths, points, np.full(len(self.names), self.current_a))

    def moments(self) -> Array:
        """Magnetic moment of every coil, shape (K, 3), A m^2."""
        return np.asarray(self.rotations @ loop_moment(self.shape, self.current_a))


def _number(
    geometry: Mapping[str, Any], key: str, default: float | None = None, low: float = 0.0
) -> float:
    value = geometry.get(key, default)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise SetupError(f'emitter: {key} must be a number, got {value!r}')
    if not math.isfinite(value) or value < low or (low == 0.0 and value == 0 and default is None):
        raise SetupError(f'emitter: {key} must be finite and above {low:g}, got {value!r}')
    return float(value)


def _whole(geometry: Mapping[str, Any], key: str, default: int) -> int:
    value = _number(geometry, key, default, low=1.0)
    if value != int(value):
        raise SetupError(f'emitter: {key} must be a whole number, got {value!r}')
    return int(value)


def spiral_path(
    side_x_m: float, side_y_m: float, pitch_m: float, turns: float, layers: int, thickness_m: float
) -> Array:
    """Corners of a rectangular spiral that winds inwards and outwards on layer after layer.

    Parameters
    ----------
    side_x_m, side_y_m : float
        Outer sides, m, between track centres.
    pitch_m : float
        Distance of neighbouring turns, m.
    turns : float
        Turns of all layers together; each layer gets an equal number of whole quarters.
    layers : int
        Evenly spread from z = 0 down to z = -thickness.
    thickness_m : float
        m.

    Returns
    -------
    ndarray, shape (M, 3)
        m, around the coil's centre.

    Raises
    ------
    SetupError
        When the turns don't fit inside the sides, or there are too many.
    """
    quarters = max(1, round(4 * turns / layers))
    if quarters * layers > MOST_TRACKS:
        raise SetupError(f'emitter: {turns:g} turns are more than {MOST_TRACKS} tracks')
    inset = [pitch_m * (j // 4) for j in range(quarters)]
    if 2 * inset[-1] >= min(side_x_m, side_y_m):
        raise SetupError(f'emitter: {turns:g} turns of pitch {pitch_m:g} m do not fit the side')
    insets = [
        value for layer in range(layers) for value in (inset if layer % 2 == 0 else inset[::-1])
    ]
    drop = thickness_m / (layers - 1) if layers > 1 else 0.0
    corners: list[tuple[float, float, float]] = []
    for j, value in enumerate(insets):
        # Track j runs along its own line; it begins where the line of the track before it crosses.
        before = insets[j - 1] if j else insets[0]
        x, y = _crossing(j, before, value, side_x_m, side_y_m)
        layer = j // quarters
        if j and j % quarters == 0:
            corners.append((x, y, -drop * (layer - 1)))
        corners.append((x, y, -drop * layer))
    last = len(insets)
    x, y = _crossing(last, insets[-1], insets[-1], side_x_m, side_y_m)
    corners.append((x, y, -drop * (layers - 1)))
    return np.array(corners)


def _crossing(
    track: int, before: float, own: float, side_x: float, side_y: float
) -> tuple[float, float]:
    """Where the lines of a track and of the one before it cross; insets in m."""
    along_y = _DIRECTIONS[track % 4][0] == 0.0
    right = _DIRECTIONS[track % 4][1] - _DIRECTIONS[(track - 1) % 4][1] > 0
    if along_y:
        x = 0.5 * side_x - own
        y = 0.5 * side_y - before
        return (x, -y) if right else (-x, y)
    x = 0.5 * side_x - before
    y = 0.5 * side_y - own
    return (x, y) if _DIRECTIONS[track % 4][0] < 0 else (-x, -y)


def _wound(path: Array, geometry: Mapping[str, Any], default: str) -> Array:
    """The path in the winding's direction; it is drawn counter-clockwise."""
    winding = geometry.get('winding', default)
    if winding not in ('cw', 'ccw'):
        raise SetupError(f"emitter: winding must be 'cw' or 'ccw', got {winding!r}")
    return path if winding == 'ccw' else path[::-1].copy()


def _square_spiral(geometry: Mapping[str, Any]) -> tuple[Array, float]:
    side = _number(geometry, 'side_m')
    return _rectangular_spiral({**geometry, 'side_x_m': side, 'side_y_m': side})


def _rectangular_spiral(geometry: Mapping[str, Any]) -> tuple[Array, float]:
    path = spiral_path(
        _number(geometry, 'side_x_m'),
        _number(geometry, 'side_y_m'),
        _number(geometry, 'pitch_m'),
        _number(geometry, 'turns'),
        _whole(geometry, 'layers', 1),
        _number(geometry, 'thickness_m', 0.0),
    )
    return _wound(path, geometry, 'cw'), 1.0


def _rectangular_loop(geometry: Mapping[str, Any]) -> tuple[Array, float]:
    x, y = 0.5 * _number(geometry, 'side_x_m'), 0.5 * _number(geometry, 'side_y_m')
    corners = np.array([[x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0], [-x, -y, 0.0]])
    return _wound(corners, geometry, 'ccw'), _number(geometry, 'turns', 1.0)


def _circular_loop(geometry: Mapping[str, Any]) -> tuple[Array, float]:
    radius, sides = _number(geometry, 'radius_m'), _whole(geometry, 'sides', 96)
    if not 3 <= sides <= MOST_TRACKS:
        raise SetupError(f'emitter: sides must be from 3 to {MOST_TRACKS}, got {sides}')
    angle = 2 * math.pi * np.arange(sides) / sides
    # A polygon of the circle's own area has the circle's moment.
    reach = radius * math.sqrt(2 * math.pi / (sides * math.sin(2 * math.pi / sides)))
    corners = np.stack([reach * np.cos(angle), reach * np.sin(angle), 0 * angle], axis=1)
    return _wound(corners, geometry, 'ccw'), _number(geometry, 'turns', 1.0)


KINDS: Mapping[str, Callable[[Mapping[str, Any]], tuple[Array, float]]] = {
    'square_spiral_pcb': _square_spiral,
    'rectangular_spiral_pcb': _rectangular_spiral,
    'rectangular_loop': _rectangular_loop,
    'circular_loop': _circular_loop,
}


def build_board(
    kind: str,
    geometry: Mapping[str, Any],
    names: Sequence[str],
    centres_m: NDArray[np.generic],
    rotations_deg: NDArray[np.generic],
    frequencies_hz: Sequence[float],
) -> Board:
    """Draw all coils of an emitter.

    Parameters
    ----------
    kind : str
        One of `KINDS`.
    geometry : mapping
        What the kind asks for (``turns``, ``side_m``, ``pitch_m``, ...; SI units), and
        ``current_a``, 1 A when missing. Further keys are passed over.
    names : sequence of str, length K
    centres_m : ndarray, shape (K, 3)
        Frame fg.
    rotations_deg : ndarray, shape (K,)
        Turn of each coil about z.
    frequencies_hz : sequence of float, length K

    Returns
    -------
    Board

    Raises
    ------
    SetupError
        When the kind is unknown, a key is missing or out of range, or the lengths differ.
    """
    if kind not in KINDS:
        raise SetupError(f'emitter: kind {kind!r} is none of {", ".join(sorted(KINDS))}')
    centres = np.asarray(centres_m, dtype=np.float64)
    angles = np.radians(np.asarray(rotations_deg, dtype=np.float64))
    count = len(names)
    if centres.shape != (count, 3) or angles.shape != (count,) or len(frequencies_hz) != count:
        raise SetupError(
            f'emitter: {count} names, centres {centres.shape}, rotations {angles.shape} and '
            f'{len(frequencies_hz)} frequencies do not match'
        )
    shape, turns = KINDS[kind](geometry)
    rotations = np.tile(np.eye(3), (count, 1, 1))
    rotations[:, 0, 0] = rotations[:, 1, 1] = np.cos(angles)
    rotations[:, 1, 0] = np.sin(angles)
    rotations[:, 0, 1] = -rotations[:, 1, 0]
    return Board(
        tuple(names),
        tuple(float(f) for f in frequencies_hz),
        shape,
        _number(geometry, 'current_a', 1.0) * turns,
        centres,
        rotations,
    )
