"""Draws an emitter board as closed current paths, and computes their field by Biot and Savart.

The number of coils, their kind and their places are data. A *kind* is a function that draws one
coil around its own centre; a new kind of board needs one more function in `KINDS`. The key
``winding`` of the geometry states which way a positive current runs, seen from +z: ``ccw``
(counter-clockwise, moment along +z) or ``cw``. Printed spirals are ``cw`` by default because the
Anser board's are (its measured in-phase moments are negative); plain loops are ``ccw``.

A segment from A to B with the current I flowing from A to B makes, at the offsets ``a = P - A``
and ``b = P - B``, ``B = mu0 I/(4 pi) (a x b) (|a| + |b|) / (|a| |b| (|a| |b| + a . b))``, which is
the integral of ``dl x r / r^3`` in closed form (Hanson and Hirshman, Phys. Plasmas 9, 2002). No
digits cancel at points near the line that extends the segment. Only closed paths have a field that
is curl-free outside the copper, and only such a field can be fitted by dipoles.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from anser_ros.arrays import AnyArray, Array
from anser_ros.errors import SetupError
from anser_ros.kernel_cache import kernel
from anser_ros.physics.constants import DIPOLE_CONSTANT
from anser_ros.physics.dipole import rows_of


@kernel
def _add_segments(starts, ends, points, factor, out):  # type: ignore[no-untyped-def]
    for p in range(points.shape[0]):
        bx, by, bz = 0.0, 0.0, 0.0
        for s in range(starts.shape[0]):
            ax, cx = points[p, 0] - starts[s, 0], points[p, 0] - ends[s, 0]
            ay, cy = points[p, 1] - starts[s, 1], points[p, 1] - ends[s, 1]
            az, cz = points[p, 2] - starts[s, 2], points[p, 2] - ends[s, 2]
            a = np.sqrt(ax * ax + ay * ay + az * az)
            c = np.sqrt(cx * cx + cy * cy + cz * cz)
            product = a * c
            weight = (a + c) / (product * (product + ax * cx + ay * cy + az * cz))
            bx += weight * (ay * cz - az * cy)
            by += weight * (az * cx - ax * cz)
            bz += weight * (ax * cy - ay * cx)
        out[p, 0] += factor * bx
        out[p, 1] += factor * by
        out[p, 2] += factor * bz


def segment_field(
    starts: AnyArray, ends: AnyArray, points: AnyArray, current_a: float = 1.0
) -> Array:
    """Return the field (P, 3), T, of straight segments that all carry the same current.

    It flows from ``starts`` to ``ends`` (M, 3), m; none of the ``points`` (P, 3), m, may lie on a
    segment. Raises `ValueError` when the shapes do not fit together.
    """
    first, last = rows_of(starts, 3, 'starts'), rows_of(ends, 3, 'ends')
    at = rows_of(points, 3, 'points')
    if first.shape != last.shape:
        raise ValueError(f'starts and ends must match, got {first.shape} and {last.shape}')
    lengths = np.linalg.norm(last - first, axis=1)
    first, last = first[lengths > 0], last[lengths > 0]
    out = np.zeros_like(at)
    _add_segments(first, last, at, DIPOLE_CONSTANT * float(current_a), out)
    return out


def loop_field(corners: AnyArray, points: AnyArray, current_a: float = 1.0) -> Array:
    """Return the field (P, 3), T, of a closed path of straight segments.

    The current flows from each of the ``corners`` (M, 3), m, to the next, and from the last to the
    first; none of the ``points`` (P, 3), m, may lie on the path. Raises `ValueError` when an array
    is not of shape (n, 3).
    """
    path = rows_of(corners, 3, 'corners')
    return segment_field(path, np.roll(path, -1, axis=0), points, current_a)


MOST_TRACKS = 20_000
"""Largest number of straight tracks of one coil, which bounds the time of a mistyped setup."""
_CORNERS = ((1.0, -1.0), (1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0))
"""Signs of x and y where a turn's four tracks begin; the first runs along +y on the right side."""


@dataclass(frozen=True)
class Board:
    """Describes a board of K emitter coils that all have the same shape."""

    names: tuple[str, ...]  # length K, names of the coils
    frequencies_hz: tuple[float, ...]  # length K, drive frequencies, Hz
    # (M, 3), corners of one coil's closed path around its own centre, m; the last corner is joined
    # to the first
    shape: Array
    current_a: float  # Nominal current times the number of turns that the path stands for, A
    centres: Array  # (K, 3), coil centres, m, frame fg
    rotations: Array  # (K, 3, 3), rotation matrices from each coil's own frame to fg

    @property
    def paths(self) -> tuple[Array, ...]:
        """Return corners of every coil's path, each of shape (M, 3), m, frame fg."""
        pairs = zip(self.rotations, self.centres, strict=True)
        return tuple(self.shape @ turn.T + centre for turn, centre in pairs)

    def field(self, points: AnyArray) -> Array:
        """Return each coil's field (P, K, 3), T, at its nominal current; points (P, 3) in m."""
        return np.stack([loop_field(path, points, self.current_a) for path in self.paths], axis=1)


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
    """Return the corners (M, 3), m, of a rectangular spiral around the coil's centre.

    The first layer winds inwards, the second outwards, and so on; each has the same number of
    quarter turns. ``side_x_m``, ``side_y_m`` are the outer sides between the centres of the
    tracks, ``pitch_m`` lies between neighbouring turns; the layers are evenly spaced from z = 0
    down to -``thickness_m``. Raises `SetupError` when the turns do not fit inside the sides, or
    there are more than `MOST_TRACKS` tracks.
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
    last = len(insets)
    for j in range(last + 1):
        # Track j begins where its line crosses that of the track before it.
        before, value = insets[max(j - 1, 0)], insets[min(j, last - 1)]
        x, y = _crossing(j, before, value, side_x_m, side_y_m)
        layer = min(j // quarters, layers - 1)
        if 0 < j < last and j % quarters == 0:
            corners.append((x, y, -drop * (layer - 1)))
        corners.append((x, y, -drop * layer))
    return np.array(corners)


def _crossing(
    track: int, before: float, inset: float, side_x: float, side_y: float
) -> tuple[float, float]:
    """Where a track begins, m, by its distance and the one before's (m) from the outer sides."""
    aside, along = (inset, before) if track % 2 == 0 else (before, inset)
    x, y = _CORNERS[track % 4]
    return x * (0.5 * side_x - aside), y * (0.5 * side_y - along)


def _wound(path: Array, geometry: Mapping[str, Any], default: str) -> Array:
    """Return a path that was drawn counter-clockwise in the direction of the winding."""
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
    # With 96 sides a polygon of equal area is off the circle by less than 1/1000 of the radius.
    radius, sides = _number(geometry, 'radius_m'), _whole(geometry, 'sides', 96)
    if not 3 <= sides <= MOST_TRACKS:
        raise SetupError(f'emitter: sides must be from 3 to {MOST_TRACKS}, got {sides}')
    angle = 2 * math.pi * np.arange(sides) / sides
    # A polygon with the area of the circle has its magnetic moment too.
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
    centres_m: AnyArray,
    rotations_deg: AnyArray,
    frequencies_hz: Sequence[float],
) -> Board:
    """Draw all K coils of an emitter board as closed current paths.

    ``kind`` is one of `KINDS`; ``geometry`` holds the dimensions that it needs (``turns``,
    ``side_m``, ``pitch_m``, ...; SI units) and ``current_a``, 1 A by default; other keys are
    ignored. ``centres_m`` (K, 3) are in the frame fg, ``rotations_deg`` (K,) about z. Raises
    `SetupError` when the kind is unknown, a key is missing or out of range, or the lengths differ.
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
