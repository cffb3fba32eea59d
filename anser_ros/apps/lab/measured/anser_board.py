"""Imports what a real Anser tracker reported at the places of a flat board, and has its recipe.

Positions only, no fluxes (github kilianod5150/Matlab-Anser, BSD-3; read where they lie). The
places are those of a board with 41 holes, in a frame of their own: `anser error_map --register`.
"""

import shutil
from pathlib import Path

import numpy as np

from anser_ros.apps.lab.measured.recipe import Recipe, ReportRow, figure, ran
from anser_ros.arrays import Array
from anser_ros.errors import FitError
from anser_ros.wire.tables import read_points

NAME = 'anser_board'
PITCH_M = 31.75e-3
"""Distance of neighbouring places in a row of the board, m (1.25 inches)."""


def places() -> Array:
    """Return the places of the board, (41, 3), m: 5 x 5 row by row, then 4 x 4 between them."""
    outer, inner = np.arange(-2.0, 3.0), np.arange(4) - 1.5
    grid = [(x, y, 0.0) for line in (outer, inner) for y in line for x in line]
    return np.asarray(PITCH_M * np.array(grid))


def load(folder: Path) -> dict[str, Array]:
    """Return the reported points (m) of every run, by the names of the files.

    Raises `FitError` when no run is there, or one has another number of points than the board has
    places, and `ParameterError` when a file is no list of fiducials.
    """
    runs = {path.stem: read_points(path) for path in sorted(folder.glob('*.fcsv'))}
    if not runs:
        raise FitError(f'no runs (*.fcsv) in {folder}')
    count = len(places())
    for name, points in runs.items():
        if len(points) != count:
            raise FitError(f'{name}.fcsv: {count} fiducials expected, got {len(points)}')
    return runs


def write_sessions(folder: Path, into: Path) -> list[Path]:
    """Write the places of the board as a table, and copy the runs; return the files."""
    runs = load(folder)
    into.mkdir(parents=True, exist_ok=True)
    board = into / 'board.csv'
    lines = [','.join(f'{value:.9g}' for value in place) for place in places()]
    board.write_text('\n'.join(['x_m,y_m,z_m', *lines]) + '\n', encoding='utf-8')
    return [board, *(
        shutil.copyfile(folder / f'{name}.fcsv', into / f'{name}.fcsv') for name in runs
    )]  # fmt: skip


def commands(files: list[Path], out: Path) -> list[list[str]]:
    """Return the commands that learn a map of each run, and judge it where it was not learnt."""
    board, *runs = files
    return [
        ['error_map', str(run), '--true', str(board), '--register', '--out', str(out / run.stem)]
        for run in runs
    ]


def rows(folder: Path, files: list[Path], out: Path) -> list[ReportRow]:
    """Return errors along the board before and after; maps that are not confirmed are not used."""
    found = []
    for run in files[1:]:
        document = ran(out / run.stem, 'error_map.json')
        before, after = (
            1e3 * figure(document, key, 'in_plane_rmse_m') for key in ('before', 'after')
        )
        across = 1e3 * figure(document, 'before', 'out_of_plane_rmse_m')
        words = 'a gain' if document['confirmed'] else 'no gain is shown'
        seen = (
            f'{document["map"]}: {words}; registration, choice, decision and fit without the '
            f'scored block; {across:.2f} mm across the board, not corrected'
        )
        what = f'{run.stem}: in-plane error, rms'
        clear = figure(document, 'clearness')
        what_clear = f'{run.stem}: gain in standard errors'
        found += [
            ReportRow(NAME, what, before, after, 'mm', seen),
            ReportRow(NAME, what_clear, float('nan'), clear, '', 'of the blocks'),
        ]
    return found


RECIPE = Recipe(NAME, write_sessions, commands, rows)
