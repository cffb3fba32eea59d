"""Learns error maps for a tracker of positions only: real Anser output over a grid board."""

import os
from dataclasses import dataclass
from pathlib import Path

from anser_ros.apps.lab.measured import anser_board
from anser_ros.calibration.error_map import learn_error_map


@dataclass(frozen=True)
class BoardRun:
    """Holds one run's errors in held-out blocks, registered to the others, by map or without."""

    name: str
    points: int
    # root mean square (m) along the board of each block, predicted from the others. The latter may
    # be the larger: a map that helped among the others has then not helped in the block
    before_m: float
    after_m: float
    across_m: float  # the same across the board, which no map touches
    confirmed: bool  # whether the blocks show a gain clearly
    shape: str  # the map that all points together choose, in words


def board_folder() -> Path:
    """Return the folder of the recordings, in ``$ANSER_SHARED`` or beside the repository."""
    beside = Path(__file__).resolve().parents[2].parent / 'shared'
    return Path(os.environ.get('ANSER_SHARED', beside)) / 'measured' / anser_board.NAME


def board_runs(folder: Path) -> list[BoardRun]:
    """Return the errors of all runs of a folder, or none when the folder does not exist.

    Raises
    ------
    BagError, FitError
        As `anser_board.load`.
    """
    if not folder.is_dir():
        return []
    return [
        BoardRun(
            name,
            found.n_points,
            found.before_m,
            found.after_m,
            found.before.out_of_plane or 0.0,
            found.is_confirmed,
            found.shape.describe(),
        )
        for name, found in (
            (name, learn_error_map(points, anser_board.places(), registers=True))
            for name, points in anser_board.load(folder).items()
        )
    ]
