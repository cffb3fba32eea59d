"""Holds metal that was learnt, and makes a document of it and the reverse."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import ModelFileError
from anser_ros.known_metal.lattice import Coils, Lattice, Setting
from anser_ros.physics.sensor import along_each_axis
from anser_ros.physics.volume import TrackedVolume

Array = NDArray[np.float64]

SCHEMA = 'anser_known_metal/1'
DIRECTIONS = 60
"""Directions in which answers may be wrong: the 60th has a thousandth of the first one's power."""
ANSWER_ERROR = 0.05
"""Error of each point's answer beyond what the fit says of it, in units of a conducting ball: a
lattice is not the metal's true shape."""
SAMPLES = 3, 3
"""Samples across and up the volume where the effect of answers on the field is compared."""
LARGEST_M, FARTHEST_M = 2.0, 3.0
"""Largest body, and farthest place, that a file may state: more is a file in millimetres, and the
search for the metal would not end."""
EVERY = 8
"""Of the poses of the fit, for the same."""


@dataclass(frozen=True)
class KnownMetal:
    """Holds a rigid piece of metal as a recording has shown it.

    Attributes
    ----------
    name : str
    lattice : Lattice
    directions : ndarray, shape (4n, D)
        Errors of the lattice's parameters: sums of these with independent normal factors.
    misfit : float
        Part of what references read of it, in frames that took no part, that it does not explain.
    strongest_t : float
        Largest field that drove one of its points while it was learnt, T.
    nearest_m : float
        Least distance of a coil from one of its points then.
    low, high : ndarray, shape (3,)
        Corners of the box of its places then, m.
    turn : ndarray, shape (3,)
        Its rotation vector in the middle of the recording.
    """

    name: str
    lattice: Lattice
    directions: Array
    misfit: float
    strongest_t: float
    nearest_m: float
    low: Array
    high: Array
    turn: Array


def directions_of(
    lattice: Lattice, covariance: Array, setting: Setting, poses: Array, volume: TrackedVolume
) -> Array:
    """Return the `DIRECTIONS` in which answers may be wrong that the field in a volume feels most.

    ``covariance`` (4n, 4n): of its parameters. ``poses`` (F, 6): where its field is looked at.
    """
    coils = Coils(*along_each_axis(volume.samples(*SAMPLES)), None)
    rows = []
    for pose in poses[::EVERY]:
        by = setting.answer_columns(lattice, setting.placed(lattice, pose), coils)
        rows.append(by.reshape(-1, by.shape[-1]))
    effect = np.concatenate(rows)
    factor = np.linalg.cholesky(covariance + ANSWER_ERROR**2 * np.eye(len(covariance)))
    effect = np.concatenate([effect.real, effect.imag]) @ factor
    _, vectors = np.linalg.eigh(effect.T @ effect)
    return np.asarray(factor @ vectors[:, ::-1][:, :DIRECTIONS])


def to_document(known: KnownMetal) -> dict[str, Any]:
    """Return metal that was learnt as plain data."""
    lattice = known.lattice
    return {
        'schema': SCHEMA,
        'name': known.name,
        'units': {'point': 'm', 'unit': 'A m^2/T', 'driving': 'T'},
        'unit': lattice.unit,
        'frequency_hz': lattice.frequency_hz,
        'misfit': known.misfit,
        'strongest_t': known.strongest_t,
        'nearest_m': known.nearest_m,
        'low_m': known.low.tolist(),
        'high_m': known.high.tolist(),
        'turn_rad': known.turn.tolist(),
        'points': lattice.points.tolist(),
        'parameters': lattice.parameters.tolist(),
        'directions': known.directions.T.tolist(),
    }


def from_document(document: Any) -> KnownMetal:
    """Return metal that was learnt from plain data.

    Raises
    ------
    ModelFileError
        When it is none, with what is wrong.
    """
    if not isinstance(document, dict) or document.get('schema') != SCHEMA:
        raise ModelFileError(f'no known metal: its schema must be {SCHEMA!r}')
    name = document.get('name')
    if not isinstance(name, str) or not name.strip():
        raise ModelFileError(f'known metal: name must be a text, got {name!r}')
    points = _table(document, 'points', (-1, 3))
    n = len(points)
    bare = Lattice(
        points, _positive(document, 'unit'), np.zeros(n, complex), np.zeros(n, complex),
        _positive(document, 'frequency_hz'),
    )  # fmt: skip
    size = float(np.ptp(points, axis=0).max())
    low, high = _table(document, 'low_m', (3,)), _table(document, 'high_m', (3,))
    if not 0.0 < size < LARGEST_M:
        raise ModelFileError(f'known metal: its points extend over {size:g} m')
    if not (low <= high).all() or np.abs([low, high]).max() > FARTHEST_M:
        raise ModelFileError(
            f'known metal: low_m {low.tolist()} and high_m {high.tolist()} must be the corners of '
            f'a box within {FARTHEST_M:g} m'
        )
    misfit = _positive(document, 'misfit')
    if misfit >= 1.0:
        raise ModelFileError(f'known metal: misfit must be a share below 1, got {misfit:g}')
    return KnownMetal(
        name,
        bare.with_parameters(_table(document, 'parameters', (4 * n,))),
        np.ascontiguousarray(_table(document, 'directions', (-1, 4 * n)).T),
        misfit,
        _positive(document, 'strongest_t'),
        _positive(document, 'nearest_m'),
        low,
        high,
        _table(document, 'turn_rad', (3,)),
    )


def _positive(document: dict[str, Any], key: str) -> float:
    value = _table(document, key, ())
    if value <= 0.0:
        raise ModelFileError(f'known metal: {key} must be positive, got {value:g}')
    return float(value)


def _table(document: dict[str, Any], key: str, shape: tuple[int, ...]) -> Array:
    if key not in document:
        raise ModelFileError(f'known metal: {key} is missing')
    try:
        table = np.array(document[key], dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        what = 'a table of numbers' if shape else 'a number'
        raise ModelFileError(f'known metal: {key} is not {what}') from error
    if table.ndim != len(shape) or any(
        want not in (-1, got) for want, got in zip(shape, table.shape, strict=True)
    ):
        wanted = ' x '.join('any' if side < 0 else str(side) for side in shape) or 'one number'
        raise ModelFileError(f'known metal: {key} must be {wanted}, got the shape {table.shape}')
    if not np.isfinite(table).all():
        raise ModelFileError(f'known metal: {key} holds values that are not finite')
    return table
