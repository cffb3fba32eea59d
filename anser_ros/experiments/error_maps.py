"""Error maps for a tracker that gives positions only: real Anser output over a grid board.

The recordings (Slicer fiducials, mm; BSD-3, github kilianod5150/Matlab-Anser) hold what a real
system reported at 41 known places of a flat board; they are read where they lie and never copied.
"""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.error_map import learn_error_map
from anser_ros.errors import BagError

Array = NDArray[np.float64]

PITCH_M = 31.75e-3


@dataclass(frozen=True)
class BoardRun:
    """One run: errors after rigid alignment, without and with a map, in held-out blocks (m)."""

    name: str
    points: int
    before_m: float
    after_m: float
    shape: str


def board_folder() -> Path:
    """Where the recordings are: beside the repository, or in ``$ANSER_SHARED``."""
    beside = Path(__file__).resolve().parents[2].parent / 'shared'
    return Path(os.environ.get('ANSER_SHARED', beside)) / 'measured' / 'anser_board'


def board_places() -> Array:
    """True places (41, 3), m: 5 x 5 points row by row, then 4 x 4 between them."""
    rows = [PITCH_M * np.arange(-2.0, 2.1), PITCH_M * np.arange(-1.5, 1.6)]
    parts = []
    for line in rows:
        y, x = np.meshgrid(line, line, indexing='ij')
        parts.append(np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1))
    return np.concatenate(parts)


def read_fiducials(path: Path) -> Array:
    """Positions (P, 3), m, of a Slicer markups file; raises `BagError` when it is none."""
    lines = path.read_text(encoding='utf-8').splitlines()
    try:
        rows = [[float(v) for v in line.split(',')[1:4]] for line in lines if line[:1] != '#']
        places = np.array(rows).reshape(-1, 3)
    except ValueError as error:
        raise BagError(f'{path}: no table of fiducials: {error}') from error
    return 1e-3 * places


def aligned(points: Array, target: Array) -> Array:
    """The points moved rigidly onto the target (Kabsch, Acta Cryst. A32, 1976)."""
    middle, aim = points.mean(axis=0), target.mean(axis=0)
    u, _, vt = np.linalg.svd((points - middle).T @ (target - aim))
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    return np.asarray((points - middle) @ u @ flip @ vt + aim)


def board_runs(folder: Path) -> list[BoardRun]:
    """All runs of the folder; none when it isn't there."""
    runs = []
    places = board_places()
    for path in sorted(folder.glob('*.fcsv')):
        found = read_fiducials(path)
        if found.shape != places.shape:
            raise BagError(f'{path}: {len(places)} fiducials expected, got {len(found)}')
        tracked = aligned(found, places)
        error_map = learn_error_map(tracked, places)
        runs.append(
            BoardRun(
                path.stem,
                len(found),
                error_map.before_m,
                error_map.after_m,
                error_map.shape.describe(),
            )
        )
    return runs
