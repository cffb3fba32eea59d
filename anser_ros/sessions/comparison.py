"""Two evaluations of the same frames compared: the difference of their errors, with an interval.

Frames of one moment share what made their errors, so whole stretches of time are resampled (the
moving-block idea of Künsch, Annals of Statistics 17, 1989), all coils of a stretch together.
"""

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import ParameterError
from anser_ros.sessions.pose_table import ERROR_COLUMNS, ERRORS_FILE

Array = NDArray[np.float64]
Key = tuple[int, str]

BLOCK_NS = 1_000_000_000
"""Length of a stretch that is resampled as one, ns: errors of a second ago are hardly related."""
DRAWS = 2000
"""Resamples: the ends of a 95 % interval then vary by a few percent of its width."""
SHARE = 0.95
"""Share of the resamples that lie in the interval."""
FEWEST_BLOCKS = 5
"""Stretches below which an interval means nothing."""


@dataclass(frozen=True)
class Compared:
    """The errors of one coil or body, or of all coils, in the frames that both have.

    Attributes
    ----------
    n : int
        Pairs of errors.
    only_a, only_b : int
        Frames that only one of them has a pose for.
    rmse_a, rmse_b : float
        Root mean square of the errors, m or rad.
    low, high : float
        Interval of the difference ``rmse_b - rmse_a``; NaN where the stretches are too few.
    """

    n: int
    only_a: int
    only_b: int
    rmse_a: float
    rmse_b: float
    low: float
    high: float

    @property
    def verdict(self) -> str:
        """Which is better: ``a``, ``b``, or neither, where the interval has room for none."""
        if np.isfinite(self.low) and self.low > 0:
            return 'a'
        return 'b' if np.isfinite(self.high) and self.high < 0 else 'neither'


def read_errors(folder: Path) -> dict[str, dict[Key, float]]:
    """Errors of position (m) and orientation (rad) by stamp and name, of an evaluation's folder.

    Raises
    ------
    ParameterError
        When the folder has none, or the table is not one of ours.
    """
    path = folder / ERRORS_FILE
    if not path.is_file():
        raise ParameterError(f'{folder}: no {ERRORS_FILE}; is it a folder of anser evaluate?')
    found: dict[str, dict[Key, float]] = {'position': {}, 'orientation': {}}
    try:
        with path.open(encoding='utf-8', newline='') as stream:
            reader = csv.DictReader(stream)
            if tuple(reader.fieldnames or ()) != ERROR_COLUMNS:
                raise ValueError(f'columns must be {", ".join(ERROR_COLUMNS)}')
            for row in reader:
                key = int(row['stamp_ns']), row['name']
                for kind, unit in (('position', 'm'), ('orientation', 'rad')):
                    found[kind][key] = float(row[f'{kind}_error_{unit}'])
    except (ValueError, TypeError) as error:
        raise ParameterError(f'{path}: {error}') from error
    return found


def compare_errors(
    first: dict[Key, float], second: dict[Key, float], rng: np.random.Generator
) -> dict[str, Compared]:
    """Compare two evaluations by name; errors of one kind by stamp and name.

    Raises
    ------
    ParameterError
        When no frame is in both.
    """
    if not first.keys() & second.keys():
        raise ParameterError('the two have no frame in common: are they of the same session?')
    names = list(dict.fromkeys(name for _, name in (*first, *second)))
    return {name: _compare(first, second, name, rng) for name in names}


def _compare(
    first: dict[Key, float], second: dict[Key, float], name: str, rng: np.random.Generator
) -> Compared:
    one = {stamp for stamp, other in first if other == name}
    two = {stamp for stamp, other in second if other == name}
    both = np.array(sorted(one & two), dtype=np.int64)
    squares = np.array(
        [[errors[stamp, name] ** 2 for stamp in both.tolist()] for errors in (first, second)]
    ).reshape(2, -1)
    low, high = _interval(both, squares, rng)
    root = np.sqrt(squares.mean(axis=1)) if both.size else np.full(2, np.nan)
    return Compared(
        both.size, len(one - two), len(two - one), float(root[0]), float(root[1]), low, high
    )


def _interval(
    stamps: NDArray[np.int64], squares: Array, rng: np.random.Generator
) -> tuple[float, float]:
    """The interval of the difference of the roots, by resampled stretches of time."""
    if not stamps.size:
        return np.nan, np.nan
    _, block = np.unique((stamps - stamps[0]) // BLOCK_NS, return_inverse=True)
    count = int(block.max()) + 1
    if count < FEWEST_BLOCKS:
        return np.nan, np.nan
    sums = np.array([np.bincount(block, weights=row) for row in squares])
    sizes = np.bincount(block)
    drawn = rng.integers(0, count, size=(DRAWS, count))
    means = sums[:, drawn].sum(axis=2) / sizes[drawn].sum(axis=1)
    difference = np.diff(np.sqrt(means), axis=0)[0]
    tail = 50.0 * (1.0 - SHARE)
    low, high = np.percentile(difference, (tail, 100.0 - tail))
    return float(low), float(high)
