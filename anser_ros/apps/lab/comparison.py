"""Compares two evaluations of the same frames.

Frames close in time share the causes of their errors, so whole stretches of time are resampled
(the moving-block idea of Künsch, Annals of Statistics 17, 1989), all coils of a stretch together.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from anser_ros.arrays import Array, Integers
from anser_ros.errors import ParameterError
from anser_ros.pose_states import OK
from anser_ros.sessions import tracked_session as files
from anser_ros.wire.tables import Table, read_table
from anser_ros.wire.text_files import read_text

Key = tuple[int, str]

BLOCK_NS = 1_000_000_000
"""Length of a stretch that is resampled as one, ns: errors of a second ago are hardly related."""
DRAWS = 2000
"""Resamples: the ends of a 95 % interval then vary by a few percent of its width."""
INTERVAL_SHARE = 0.95
"""Share of the resamples that lie in the interval, as is usual in the field's publications."""
FEWEST_BLOCKS = 5
"""Stretches below which an interval means nothing: its ends would be those of single ones."""


@dataclass(frozen=True)
class Compared:
    """Compares errors, m or rad, or shares of frames with a pose, 0 to 1, of one coil or body.

    ``low`` and ``high`` are the interval of the difference, second less first, NaN where stretches
    are too few. ``n`` frames are those of both; those that only one of the two has are counted.
    """

    low: float
    high: float
    n: int
    only_a: int
    only_b: int
    a: float  # root mean square error, or share
    b: float
    are_shares: bool

    @property
    def verdict(self) -> str:
        """Return which is better, ``a`` or ``b``; ``neither`` where both may be."""
        return {0: 'neither', 1 if self.are_shares else -1: 'b'}.get(self.sign, 'a')

    @property
    def sign(self) -> int:
        """Return the sign of the difference where the whole interval has one, else 0."""
        return int(self.low > 0) - int(self.high < 0)


def check_same_recording(first: Path, second: Path) -> None:
    """Raise `ParameterError` when two evaluations state that they are of different recordings."""
    one, two = _recording(first), _recording(second)
    if one and two and one != two:
        raise ParameterError(
            f'{first} and {second} are evaluations of two different recordings ({one}, {two}), '
            f'whose frames cannot be paired'
        )


def _recording(folder: Path) -> str:
    """What an evaluation says that it is of; empty where it does not, as older ones."""
    path = folder / 'evaluation.json'
    if not path.is_file():
        return ''
    try:
        return str(json.loads(read_text(path)).get('recording', ''))
    except (ValueError, AttributeError) as error:
        raise ParameterError(f'{path}: not a document of anser evaluate') from error


def read_errors(folder: Path) -> dict[str, dict[Key, float]]:
    """Return errors of position (m) and orientation (rad) by stamp and name; `ParameterError`."""
    keys, table = _read(folder, files.ERRORS_FILE, files.ERROR_COLUMNS)
    return {
        kind.partition('_')[0]: dict(zip(keys, table.array(kind).tolist(), strict=True))
        for kind in files.ERROR_COLUMNS[2:]
    }


def read_states(folder: Path) -> dict[Key, float]:
    """Return whether there is a pose, 1 or 0, by stamp and name; raises `ParameterError`."""
    found: dict[Key, float] = {}
    for name, columns in (
        (files.POSES_FILE, files.POSE_COLUMNS),
        (files.BODIES_FILE, files.BODY_COLUMNS),
    ):
        keys, table = _read(folder, name, columns)
        found |= zip(keys, map(float, table.words('status') == OK), strict=True)
    return found


def _read(folder: Path, name: str, columns: tuple[str, ...]) -> tuple[list[Key], Table]:
    """A table, and the stamp and the name in its second column of each row."""
    path = folder / name
    if not path.is_file():
        raise ParameterError(f'{folder}: no {name}; is it a folder of anser evaluate?')
    table = read_table(path, as_text=True)
    if table.names != columns:
        raise ParameterError(f'{path}: columns must be {", ".join(columns)}')
    stamps = table.array('stamp_ns').tolist()
    return list(zip(stamps, table.words(columns[1]), strict=True)), table


def compare(
    first: Mapping[Key, float],
    second: Mapping[Key, float],
    rng: np.random.Generator,
    *,
    are_shares: bool = False,
) -> dict[str, Compared]:
    """Compare errors of one kind by stamp and name, or whether there is a pose (`read_states`).

    Raises `ParameterError` when no frame of whole sessions is in both.
    """
    if are_shares and not first.keys() & second.keys():
        raise ParameterError('the two have no frame in common: are they of the same session?')
    shown, found = np.asarray if are_shares else np.sqrt, {}
    for name in dict.fromkeys(name for _, name in (*first, *second)):
        one, two = ({t: v for (t, n), v in side.items() if n == name} for side in (first, second))
        both = sorted(one.keys() & two.keys())
        pairs = np.array([[side[stamp] for stamp in both] for side in (one, two)])
        pairs = pairs if are_shares else pairs**2
        low, high = _interval(np.array(both, dtype=np.int64), pairs, rng, shown)
        a, b = shown(pairs.mean(axis=1)).tolist() if both else (np.nan, np.nan)
        alone = len(one) - len(both), len(two) - len(both)
        found[name] = Compared(low, high, len(both), *alone, a, b, are_shares)
    return found


def _interval(
    stamps: Integers, values: Array, rng: np.random.Generator, shown: Callable[[Array], Array]
) -> tuple[float, float]:
    """The interval of the difference of two means, as they are shown, by resampled stretches."""
    if not stamps.size:
        return np.nan, np.nan
    _, block = np.unique((stamps - stamps[0]) // BLOCK_NS, return_inverse=True)
    count = int(block.max()) + 1
    if count < FEWEST_BLOCKS:
        return np.nan, np.nan
    sums = np.array([np.bincount(block, weights=row) for row in values])
    sizes = np.bincount(block)
    drawn = rng.integers(0, count, size=(DRAWS, count))
    means = sums[:, drawn].sum(axis=2) / sizes[drawn].sum(axis=1)
    difference = np.diff(shown(means), axis=0)[0]
    tail = 50.0 * (1.0 - INTERVAL_SHARE)
    low, high = np.percentile(difference, (tail, 100.0 - tail))
    return float(low), float(high)
