"""The errors of a real Anser tracker over a square board, and their candidate causes.

Positions only, no fluxes (github kilianod5150/Matlab-Anser, BSD-3; read where they lie). So each
candidate cause is turned into the displacements that it would make, and fitted to the reported
points; blocks of points that took no part score it.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from anser_ros.errors import FitError
from anser_ros.measured import ReportRow
from anser_ros.measured.anser_response import (
    EFFECTS,
    Points,
    response,
    rigid_columns,
    stack,
)
from anser_ros.measured.candidates import CandidateSearch, grow, search_text
from anser_ros.physics.board import Board
from anser_ros.sessions.starting_model import board_of
from anser_ros.wire.config_folder import read_config
from anser_ros.wire.setup import parse_setup

Array = NDArray[np.float64]

NAME = 'anser_board'

PITCH_M = 31.75e-3
"""Distance of neighbouring places in a row of the board, m (1.25 inches)."""
N_BLOCKS = 7
"""Blocks of places that are held out in turn: the middle and six sectors around it."""
N_POINTS = 41
"""Places of the board, 5 x 5 and 4 x 4 between them."""
FIELD_ERRORS = ('coil_gain', 'pickup', 'coil_moved', 'coil_tilted')
CLEAR = 3.0
"""Standard errors over the blocks: seven blocks and two dozen candidates ask for more than two."""
MAP_PREFIX = 'map_of_'
ROBUST = 3.0
"""Residuals beyond this many median spreads are called single faults of a point."""


@dataclass(frozen=True)
class RunAnalysis:
    """One run of the tracker.

    Attributes
    ----------
    name : str
    residual_m : ndarray, shape (P, 3)
        Reported minus ideal points after rigid alignment.
    search : CandidateSearch
        Effects chosen on blocks left out, on this run.
    nested_m : ndarray, shape (P, 3)
        Residual of each block after effects chosen and fitted without it.
    chosen_in : tuple of tuple of str
        What was chosen in each of those nested fits.
    rigid_m, fitted_m : ndarray, shape (P, 3)
        Residual of each block after alignment, and after the chosen effects, without it.
    neighbour : float
        Correlation of the residuals of neighbouring points (half a pitch diagonal).
    field_neighbour : float
        What it would be if errors of single coils (place, tilt, gain, pickup) made them.
    """

    name: str
    residual_m: Array
    search: CandidateSearch
    nested_m: Array
    chosen_in: tuple[tuple[str, ...], ...]
    rigid_m: Array
    fitted_m: Array
    neighbour: float
    field_neighbour: float

    @property
    def field_share(self) -> float:
        """Share of the residual's power that an error of the field can have."""
        return float(np.clip(self.neighbour / self.field_neighbour, 0.0, 1.0))


@dataclass(frozen=True)
class BoardAnalysis:
    """The analyses of all runs together.

    Attributes
    ----------
    runs : tuple of RunAnalysis
    alike : ndarray, shape (R, R)
        Correlation of the residuals.
    across : dict
        Effect to the logarithm of new over old power of each run, shape (R,), when the effect's
        parameters come from all other runs: a lasting fault of the tracker would hold there.
    """

    runs: tuple[RunAnalysis, ...]
    alike: Array
    across: dict[str, Array]


def grid() -> Array:
    """Points of the board in units of the pitch, (41, 2): 5 x 5, then 4 x 4 between them."""
    outer, inner = np.arange(-2.0, 3.0), np.arange(4) - 1.5
    return np.array(
        [(x, y) for y in outer for x in outer] + [(x, y) for y in inner for x in inner]
    )


def read_points(path: Path) -> Array:
    """Positions (m) of a list of fiducials.

    Raises
    ------
    FitError
        When the file is no list of the board's 41 points.
    """
    lines = path.read_text(encoding='utf-8').splitlines()
    rows = [line.split(',') for line in lines if line.strip() and not line.startswith('#')]
    try:
        points = np.array([[float(value) for value in row[1:4]] for row in rows])
    except ValueError as error:
        raise FitError(f'{path.name}: {error}') from error
    if points.shape != (N_POINTS, 3):
        raise FitError(f'{path.name}: expected {N_POINTS} points, got {len(points)}')
    return 1e-3 * points


def align(ideal: Array, reported: Array) -> Array:
    """The ideal points laid rigidly onto the reported ones, m."""
    a, b = ideal - ideal.mean(axis=0), reported - reported.mean(axis=0)
    turn = Rotation.align_vectors(b, a)[0]
    return np.asarray(turn.apply(a) + reported.mean(axis=0))


def block_of(points: Array) -> NDArray[np.int64]:
    """Block of each point: the middle, and six sectors around it."""
    angle = np.arctan2(points[:, 1], points[:, 0]) + np.pi
    sector = 1 + np.floor(angle / (2.0 * np.pi) * (N_BLOCKS - 1)).astype(np.int64) % (N_BLOCKS - 1)
    return np.where(np.hypot(points[:, 0], points[:, 1]) < 0.9, 0, sector)


def rms_m(residual: Array) -> float:
    """Root of the mean squared distance, m."""
    return float(np.sqrt(np.mean(np.sum(residual**2, axis=1))))


class BoardFit:
    """Least squares of one run's displacements on columns of effects.

    Parameters
    ----------
    residual_m : ndarray, shape (P, 3)
    rigid : ndarray, shape (P, 3, 6)
    columns : mapping
        Effect to columns (P, 3, n) at a plausible size.
    """

    def __init__(self, residual_m: Array, rigid: Array, columns: dict[str, Array]) -> None:
        self._residual, self._rigid, self._columns = residual_m, rigid, columns
        self._noise = rms_m(residual_m) / np.sqrt(3.0)

    def left(self, names: tuple[str, ...], train: NDArray[np.bool_]) -> Array:
        """Residuals (P, 3) of all points, effects fitted to those of `train`."""
        matrix = np.concatenate([self._rigid, *(self._columns[name] for name in names)], axis=2)
        inside = matrix[train].reshape(-1, matrix.shape[2]) / self._noise
        prior = np.where(np.arange(matrix.shape[2]) < self._rigid.shape[2], 1e-6, 1.0)
        normal = inside.T @ inside + np.diag(prior)
        right = inside.T @ (self._residual[train].ravel() / self._noise)
        return np.asarray(self._residual - matrix @ np.linalg.solve(normal, right))

    def search(self, block: NDArray[np.int64], train: NDArray[np.bool_]) -> CandidateSearch:
        """Choose effects on the blocks inside `train`."""
        blocks = np.unique(block[train])

        def score(names: tuple[str, ...]) -> Array:
            power = []
            for b in blocks:
                out = train & (block == b)
                power.append(np.mean(self.left(names, train & (block != b))[out] ** 2))
            return np.array(power)

        sizes = {name: value.shape[2] for name, value in self._columns.items()}
        return grow(tuple(self._columns), score, sizes, CLEAR)


def study(name: str, reported: Array, board: Board, other: dict[str, Array]) -> RunAnalysis:
    """Choose effects for one run, and cross-validate the choice itself."""
    points = grid()
    ideal = np.column_stack([PITCH_M * points, np.zeros(len(points))])
    place = align(ideal, reported)
    where = Points(place, points / 2.0)
    answer = response(board, place)
    columns = {key: stack(make(board, where, answer)) for key, make in EFFECTS.items()}
    columns |= {f'{MAP_PREFIX}{key}': value[:, :, None] for key, value in other.items()}
    fit = BoardFit(reported - place, stack(rigid_columns(where)), columns)
    block = block_of(points)
    everything = np.ones(len(points), dtype=bool)
    found = fit.search(block, everything)
    nested, chosen = np.zeros_like(place), []
    rigid, fitted = np.zeros_like(place), np.zeros_like(place)
    for b in np.unique(block):
        rigid[block == b] = fit.left((), block != b)[block == b]
        fitted[block == b] = fit.left(found.chosen, block != b)[block == b]
        inner = fit.search(block, block != b)
        nested[block == b] = fit.left(inner.chosen, block != b)[block == b]
        chosen.append(inner.chosen)
    basis = stack(rigid_columns(where))
    smooth = np.concatenate([columns[key] for key in FIELD_ERRORS], axis=2)
    smooth = _without_rigid(basis, smooth).reshape(len(points), 3, -1)
    return RunAnalysis(
        name,
        reported - place,
        found,
        nested,
        tuple(chosen),
        rigid,
        fitted,
        _neighbour((reported - place)[:, :, None], points),
        _neighbour(smooth, points),
    )


def _neighbour(residual: Array, points: Array) -> float:
    """Correlation of neighbours' displacements (P, 3, n), n alike."""
    gap = np.linalg.norm(points[:, None] - points[None], axis=2)
    first, second = np.nonzero((gap > 0.0) & (gap < 0.75))
    own = np.mean(np.sum(residual**2, axis=(1, 2)))
    return float(np.mean(np.sum(residual[first] * residual[second], axis=(1, 2))) / own)


def load(folder: Path) -> dict[str, Array]:
    """Reported points (m) of every run.

    Raises
    ------
    FitError
        When there is none.
    """
    paths = sorted(folder.glob('*.fcsv'))
    if not paths:
        raise FitError(f'no runs (*.fcsv) in {folder}')
    return {path.stem: read_points(path) for path in paths}


def analyse(folder: Path) -> BoardAnalysis:
    """Every run: choice, nested cross-validation, likeness to the others."""
    reported = load(folder)
    board = board_of(parse_setup(read_config('demo_setup.yaml')))
    points = grid()
    ideal = np.column_stack([PITCH_M * points, np.zeros(len(points))])
    residual = {name: value - align(ideal, value) for name, value in reported.items()}
    runs = [
        study(name, value, board, {k: v for k, v in residual.items() if k != name})
        for name, value in reported.items()
    ]
    alike = np.corrcoef([value.ravel() for value in residual.values()])
    return BoardAnalysis(tuple(runs), alike, across_runs(reported, board))


def across_runs(reported: dict[str, Array], board: Board) -> dict[str, Array]:
    """Each effect fitted to all other runs at once, scored on the run left out."""
    points = grid()
    ideal = np.column_stack([PITCH_M * points, np.zeros(len(points))])
    rigid, residual, columns = [], [], []
    for value in reported.values():
        place = align(ideal, value)
        where = Points(place, points / 2.0)
        answer = response(board, place)
        rigid.append(stack(rigid_columns(where)))
        residual.append(value - place)
        columns.append({key: stack(make(board, where, answer)) for key, make in EFFECTS.items()})
    out = {}
    for name in EFFECTS:
        free = [
            _without_rigid(r, np.concatenate([c[name], v[:, :, None]], axis=2))
            for r, c, v in zip(rigid, columns, residual, strict=True)
        ]
        out[name] = np.array([_from_others(free, k) for k in range(len(free))])
    return out


def _without_rigid(rigid: Array, columns: Array) -> Array:
    basis = np.linalg.qr(rigid.reshape(-1, rigid.shape[2]))[0]
    flat = columns.reshape(-1, columns.shape[2])
    return np.asarray(flat - basis @ (basis.T @ flat))


def _from_others(free: list[Array], left_out: int) -> float:
    """Log power ratio of one run; each run counts by its own power."""
    normal, right = np.eye(free[0].shape[1] - 1), np.zeros(free[0].shape[1] - 1)
    for k, part in enumerate(free):
        if k != left_out:
            power = float(np.mean(part[:, -1] ** 2))
            normal = normal + part[:, :-1].T @ part[:, :-1] / power
            right = right + part[:, :-1].T @ part[:, -1] / power
    part = free[left_out]
    left = part[:, -1] - part[:, :-1] @ np.linalg.solve(normal, right)
    return float(np.log(np.mean(left**2) / np.mean(part[:, -1] ** 2)))


def rows(analysis: BoardAnalysis) -> list[ReportRow]:
    """Before and after on blocks left out; before is the rigid alignment to the other blocks."""
    out = []
    for part in analysis.runs:
        before, fitted = 1e3 * rms_m(part.rigid_m), 1e3 * rms_m(part.fitted_m)
        aligned = 1e3 * rms_m(part.residual_m)
        figure = f'{part.name} ({aligned:.2f} mm aligned to all points): held-out points, rms'
        names = ', '.join(part.search.chosen) or 'nothing pays'
        seen = f'{names}: choice saw all blocks, parameters not the scored one'
        out.append(ReportRow(NAME, figure, before, fitted, 'mm', None, None, seen))
        nested = 1e3 * rms_m(part.nested_m)
        blind = 'choice and parameters both without the scored block'
        out.append(ReportRow(NAME, figure, before, nested, 'mm', None, None, blind))
        share = 100.0 * part.field_share
        out.append(
            ReportRow(
                NAME,
                f'{part.name}: share of the error that an error of the field can have',
                np.nan,
                share,
                '%',
                None,
                None,
                'nothing fitted: correlation of points 22 mm apart over that of coil errors',
            )
        )
    return out


def tables(analysis: BoardAnalysis) -> str:
    """Candidates of every run, and what is common to the runs."""
    lines = []
    for part in analysis.runs:
        lines.append(search_text(f'{NAME}, {part.name}', part.search, 'mm a component', 1e3))
        text = ['+'.join(chosen) or 'nothing' for chosen in part.chosen_in]
        lines.append(f'  chosen without each block: {"; ".join(text)}')
        size = np.linalg.norm(part.residual_m, axis=1)
        far = int(np.sum(size > ROBUST * np.median(size)))
        spread = 1e3 * np.sqrt(np.mean(part.residual_m**2, axis=0))
        lines.append(
            f'  residual x {spread[0]:.2f}, y {spread[1]:.2f}, z {spread[2]:.2f} mm; correlation '
            f'of neighbours {part.neighbour:+.2f} (a field error: {part.field_neighbour:+.2f}); '
            f'{far} points beyond {ROBUST:g} medians'
        )
    lines.append(f'{NAME}: ln power of each run, effect fitted to all other runs')
    for name, change in sorted(analysis.across.items(), key=lambda item: item[1].mean()):
        values = ' '.join(f'{value:+.2f}' for value in change)
        lines.append(f'  {name:<24} mean {change.mean():+.3f}   {values}')
    lines.append(f'{NAME}: correlation of the residuals of two runs')
    width = max(len(part.name) for part in analysis.runs)
    for part, row in zip(analysis.runs, analysis.alike, strict=True):
        lines.append(f'  {part.name:<{width}} ' + ' '.join(f'{value:+.2f}' for value in row))
    return '\n'.join(lines)
