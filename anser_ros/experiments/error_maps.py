"""Error maps for a tracker that gives positions only: real Anser output over a grid board.

The recordings (Slicer fiducials, mm; BSD-3, github kilianod5150/Matlab-Anser) hold what a real
system reported at 41 known places of a flat board; they are read where they lie and never copied.
"""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from anser_ros.calibration.blocks import fold_of_frames
from anser_ros.calibration.error_map import learn_error_map
from anser_ros.errors import BagError

Array = NDArray[np.float64]

PITCH_M = 31.75e-3
"""Distance of neighbouring places in a row of the board, m (1.25 inches)."""


@dataclass(frozen=True)
class BoardRun:
    """One run: its error after rigid alignment in held-out blocks, without and with a map.

    Attributes
    ----------
    name : str
    points : int
    before_m, after_m : float
        Root mean square (m) of each block, predicted from the others. The latter may be the
        larger: a map that helped among the others has then not helped in the block.
    shape : str
        The map that all points together choose, in words.
    """

    name: str
    points: int
    before_m: float
    after_m: float
    shape: str


def board_folder() -> Path:
    """Return the folder of the recordings, in ``$ANSER_SHARED`` or beside the repository."""
    beside = Path(__file__).resolve().parents[2].parent / 'shared'
    return Path(os.environ.get('ANSER_SHARED', beside)) / 'measured' / 'anser_board'


def board_places() -> Array:
    """Return the true places, shape (41, 3), m: 5 x 5 row by row, then 4 x 4 between them."""
    rows = [PITCH_M * np.arange(-2.0, 2.1), PITCH_M * np.arange(-1.5, 1.6)]
    parts = []
    for line in rows:
        y, x = np.meshgrid(line, line, indexing='ij')
        parts.append(np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1))
    return np.concatenate(parts)


def read_fiducials(path: Path) -> Array:
    """Return the positions (P, 3), m, of a Slicer markups file.

    Raises
    ------
    BagError
        When the file has no table of fiducials.
    """
    lines = path.read_text(encoding='utf-8').splitlines()
    try:
        rows = [[float(v) for v in line.split(',')[1:4]] for line in lines if line[:1] != '#']
        places = np.array(rows).reshape(-1, 3)
    except ValueError as error:
        raise BagError(f'{path}: no table of fiducials: {error}') from error
    return 1e-3 * places


def aligned(points: Array, known: NDArray[np.bool_], target: Array) -> Array:
    """Return all points (P, 3), moved rigidly so that the known ones come onto their targets."""
    middle, aim = points[known].mean(axis=0), target[known].mean(axis=0)
    turn = Rotation.align_vectors(target[known] - aim, points[known] - middle)[0]
    return np.asarray(turn.apply(points - middle) + aim)


def judged(name: str, found: Array, places: Array) -> BoardRun:
    """Return a run's errors in blocks that took part neither in alignment nor in the map.

    Each block of space in its turn is predicted from the others alone: they give the rigid
    alignment, the choice of a map, the decision whether it is used, and its fit.

    Parameters
    ----------
    name : str
    found, places : ndarray, shape (P, 3)
        Reported and true positions, m, in two different frames.
    """
    folds = fold_of_frames([places])[0]
    squares = np.zeros(2)
    for fold in np.unique(folds):
        known = folds != fold
        tracked = aligned(found, known, places)
        error_map = learn_error_map(tracked[known], places[known])
        for row, positions in enumerate((tracked, error_map.apply(tracked))):
            squares[row] += ((positions - places)[~known] ** 2).sum()
    everything = np.ones(len(places), dtype=bool)
    whole = learn_error_map(aligned(found, everything, places), places)
    before, after = np.sqrt(squares / len(places))
    return BoardRun(name, len(found), float(before), float(after), whole.shape.describe())


def board_runs(folder: Path) -> list[BoardRun]:
    """Return the errors of all runs of a folder, or none when the folder does not exist.

    Raises
    ------
    BagError
        When a file has another number of fiducials than the board has places.
    """
    runs = []
    places = board_places()
    for path in sorted(folder.glob('*.fcsv')):
        found = read_fiducials(path)
        if found.shape != places.shape:
            raise BagError(f'{path}: {len(places)} fiducials expected, got {len(found)}')
        runs.append(judged(path.stem, found, places))
    return runs
