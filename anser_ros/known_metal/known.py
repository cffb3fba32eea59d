"""Holds metal that was learnt, and writes and reads it as a document."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
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

    Parameters
    ----------
    lattice : Lattice
    covariance : ndarray, shape (4n, 4n)
        Of its parameters.
    setting : Setting
    poses : ndarray, shape (F, 6)
        Where its field is looked at.
    volume : TrackedVolume
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


def write_known_metal(path: Path, known: KnownMetal) -> None:
    """Write a document of metal that was learnt."""
    lattice = known.lattice
    document = {
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
    text = yaml.safe_dump(document, default_flow_style=None, sort_keys=False, width=1000)
    path.write_text(text, encoding='utf-8')


def read_known_metal(path: Path) -> KnownMetal:
    """Read a document of metal that was learnt.

    Raises
    ------
    ModelFileError
        When it is none, with what is wrong.
    """
    try:
        document: Any = yaml.load(path.read_text(encoding='utf-8'), Loader=_LOADER)
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ModelFileError(f'{path}: known metal cannot be read: {error}') from error
    if not isinstance(document, dict) or document.get('schema') != SCHEMA:
        raise ModelFileError(f'{path}: no known metal, its schema must be {SCHEMA!r}')
    try:
        points = _table(document, 'points', (-1, 3))
        n = len(points)
        bare = Lattice(
            points, _positive(document, 'unit'), np.zeros(n, complex), np.zeros(n, complex),
            _positive(document, 'frequency_hz'),
        )  # fmt: skip
        return KnownMetal(
            str(document['name']),
            bare.with_parameters(_table(document, 'parameters', (4 * n,))),
            np.ascontiguousarray(_table(document, 'directions', (-1, 4 * n)).T),
            _positive(document, 'misfit'),
            _positive(document, 'strongest_t'),
            _positive(document, 'nearest_m'),
            _table(document, 'low_m', (3,)),
            _table(document, 'high_m', (3,)),
            _table(document, 'turn_rad', (3,)),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise ModelFileError(f'{path}: known metal: {error}') from error


_LOADER = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)


def _positive(document: dict[str, Any], key: str) -> float:
    value = float(document[key])
    if not 0.0 < value < np.inf:
        raise ValueError(f'{key} must be positive, got {value}')
    return value


def _table(document: dict[str, Any], key: str, shape: tuple[int, ...]) -> Array:
    table = np.array(document[key], dtype=np.float64)
    if table.ndim != len(shape) or any(
        want not in (-1, got) for want, got in zip(shape, table.shape, strict=True)
    ):
        raise ValueError(f'{key} must have the shape {shape}, got {table.shape}')
    if not np.isfinite(table).all():
        raise ValueError(f'{key} holds values that are not finite')
    return table
