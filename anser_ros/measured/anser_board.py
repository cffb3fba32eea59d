"""Maps what a real Anser tracker reported at the places of a flat board, where it can be mapped.

Positions only, no fluxes (github kilianod5150/Matlab-Anser, BSD-3; read where they lie). The
places are those of a board with 41 holes; the tracker's points are registered to them, and an
error map is learnt as `anser error_map --register` does.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.error_map import ErrorMap, learn_error_map
from anser_ros.errors import FitError
from anser_ros.measured import ReportRow
from anser_ros.wire.fiducials import read_fiducials

Array = NDArray[np.float64]

NAME = 'anser_board'
PITCH_M = 31.75e-3
"""Distance of neighbouring places in a row of the board, m (1.25 inches)."""


def places() -> Array:
    """Return the places of the board, shape (41, 3), m: 5 x 5 row by row, then 4 x 4
    between them.
    """
    outer, inner = np.arange(-2.0, 3.0), np.arange(4) - 1.5
    grid = [(x, y, 0.0) for line in (outer, inner) for y in line for x in line]
    return np.asarray(PITCH_M * np.array(grid))


def load(folder: Path) -> dict[str, Array]:
    """Return the reported points (m) of every run, by the names of the files.

    Raises
    ------
    FitError
        When no run is there, or one has another number of points than the board has places.
    BagError
        When a file is no list of fiducials.
    """
    runs = {path.stem: read_fiducials(path) for path in sorted(folder.glob('*.fcsv'))}
    if not runs:
        raise FitError(f'no runs (*.fcsv) in {folder}')
    count = len(places())
    for name, points in runs.items():
        if len(points) != count:
            raise FitError(f'{name}.fcsv: {count} fiducials expected, got {len(points)}')
    return runs


def analyse(folder: Path) -> dict[str, ErrorMap]:
    """Return the map of every run, with its error in blocks that took no part in anything."""
    there = places()
    return {
        name: learn_error_map(points, there, registers=True)
        for name, points in load(folder).items()
    }


def rows(analysis: dict[str, ErrorMap]) -> list[ReportRow]:
    """Return in-plane errors before and after; unconfirmed maps are not used."""
    out = []
    for name, found in analysis.items():
        before, after = 1e3 * found.before_m, 1e3 * found.after_m
        words = 'a gain' if found.is_confirmed else 'no gain is shown'
        seen = (
            f'{found.shape.describe()}: {words} ({found.clearness:+.1f} standard errors); '
            'registration, choice, decision and fit without the scored block'
        )
        figure = f'{name}: in-plane error, rms'
        out.append(ReportRow(NAME, figure, before, after, 'mm', None, None, seen))
    return out


def tables(analysis: dict[str, ErrorMap]) -> str:
    """Return what was tried for each run, and what lies across the board, which no map touches."""
    lines = []
    for name, found in analysis.items():
        across = 1e3 * (found.before.out_of_plane or 0.0)
        lines.append(f'{NAME}, {name}: {across:.2f} mm rms across the board, not corrected')
        best = sorted(found.tried, key=lambda item: item[1])[:3]
        lines += [f'  {shape.describe():<28} {1e3 * error:.2f} mm' for shape, error in best]
    return '\n'.join(lines)
