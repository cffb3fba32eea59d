"""Three electromagnets and a plate of Hall sensors: what the dipole model lacks, height by height.

The data (Boehler et al., IEEE T-RO 2022, doi 10.1109/TRO.2022.3197107, Apache-2.0) are read where
they lie. Every height of the plate is predicted from the other heights; see `navion_held_out` for
what that means. The effects are found by `navion_fit`, metal by `navion_sources`.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import FitError
from anser_ros.measured import Row
from anser_ros.measured.navion_held_out import (
    Fold,
    chess_even,
    metal_text,
    others,
    prediction_error,
    rms,
    run_fold,
    with_own_pose,
)
from anser_ros.measured.navion_plate import PlateData
from anser_ros.measured.navion_states import (
    fit_slew,
    join_states,
    learn_memory,
    predict_memory,
    split_states,
)
from anser_ros.measured.navion_tool import ToolErrors, tool_errors

Array = NDArray[np.float64]

NAME = 'navion'

TARGET_MT = 0.27
INNER_TARGET_MT = 0.135

STRICT = 'effects and model: the other heights only; scored on the height left out'
OWN_POSE = 'as above, but pose and bend of the height left out from half its sensors; other half'


@dataclass(frozen=True)
class NavionData:
    """The steady readings and what belongs to them.

    Attributes
    ----------
    plane : tuple of int
        The data set's own numbers of the heights.
    coils : PlateData
        The coil terms of the eight states: the field of one coil at its full current, T.
    terms_t : ndarray, shape (P, 8, S, 3)
        All terms of the eight states (constant, coils, pairs, triple), T.
    sign : ndarray, shape (8, 3)
        Signs of the three currents in the eight states.
    zero_t : ndarray, shape (P, S, 3)
        The state without current as the data set stores it, T.
    """

    plane: tuple[int, ...]
    coils: PlateData
    terms_t: Array
    sign: Array
    zero_t: Array


@dataclass(frozen=True)
class Analysis:
    """Everything that was found, fold by fold."""

    data: NavionData
    folds: tuple[Fold, ...]


def load(folder: Path) -> NavionData:
    """Read ``navion_steady.csv``; positions m, currents A and fields mT as its header says.

    Raises
    ------
    FitError
        When the file is missing, or lacks a state of a sensor.
    """
    path = folder / 'navion_steady.csv'
    if not path.is_file():
        raise FitError(f'no such file: {path}')
    with path.open(newline='') as stream:
        rows = list(csv.DictReader(stream))
    number = np.array([[float(value) for value in row.values()] for row in rows])
    column = {name: k for k, name in enumerate(rows[0])}

    def take(*names: str) -> Array:
        return number[:, [column[name] for name in names]]

    plane, state = take('plane')[:, 0], take('state')[:, 0]
    planes = np.unique(plane)
    order = np.lexsort((take('sensor')[:, 0], state, plane))
    n_sensors = len(np.unique(take('sensor')[:, 0]))
    shape = (len(planes), len(np.unique(state)), n_sensors)
    if len(rows) != math.prod(shape):
        raise FitError(f'{path.name}: {len(rows)} rows, expected {math.prod(shape)}')
    current = take('I0_A', 'I1_A', 'I2_A')[order].reshape(*shape, 3)[0, :, 0]
    field = take('Bx_mT', 'By_mT', 'Bz_mT')[order].reshape(*shape, 3) * 1e-3
    place = take('x_m', 'y_m', 'z_m')[order].reshape(*shape, 3)[:, 0]
    driven = np.abs(current).min(axis=1) > 0.0
    sign = np.sign(current[driven])
    terms = np.array([split_states(reading, sign) for reading in field[:, driven]])
    grid = place[0] * np.array([1.0, 1.0, 0.0])
    return NavionData(
        plane=tuple(int(p) for p in planes),
        coils=PlateData(place[:, 0, 2], grid, terms[:, 1:4]),
        terms_t=terms,
        sign=sign,
        zero_t=field[:, ~driven][:, 0],
    )


def analyse(folder: Path, tell: Callable[[str], None] = lambda _: None) -> Analysis:
    """Leave each height out in turn; `tell` hears of each fold's choice."""
    data = load(folder)
    folds = [run_fold(data.coils, held, tell) for held in range(len(data.plane))]
    return Analysis(data, tuple(folds))


def run(shared: Path, rng: np.random.Generator) -> list[Row]:
    """Rows of the table; nothing here is random, `rng` is not used."""
    del rng
    folder = shared / 'measured' / NAME if (shared / 'measured').is_dir() else shared / NAME
    return rows(analyse(folder), folder)


def rows(analysis: Analysis, folder: Path) -> list[Row]:
    """Before and after, on heights that took no part."""
    return [
        *_field_rows(analysis),
        *_state_rows(analysis),
        *_tool_rows(analysis),
        _zero_row(analysis, folder),
    ]


def inner(data: NavionData) -> list[int]:
    """Heights that have others above and below: predicted by interpolation."""
    height = data.coils.height_m
    return [p for p, h in enumerate(height) if height.min() < h < height.max()]


def _row(
    figure: str, before: float, after: float, unit: str, target: float | None, chosen_on: str
) -> Row:
    met = None if target is None else bool(after <= target)
    return Row(NAME, figure, before, after, unit, target, met, chosen_on)


def _over(
    data: NavionData, figure: str, errors: Array, target: tuple[float, float] | None, chosen: str
) -> list[Row]:
    """Two rows, all heights and the inner ones, from errors (2, P, ...), T: before and after."""
    wanted = target or (None, None)
    out = []
    for text, planes, goal in (
        ('all heights', list(range(len(data.plane))), wanted[0]),
        ('inner heights', inner(data), wanted[1]),
    ):
        before, after = (1e3 * rms(part[planes]) for part in errors)
        out.append(_row(f'{figure}, {text}', before, after, 'mT', goal, chosen))
    return out


def _field_rows(analysis: Analysis) -> list[Row]:
    data, coils = analysis.data, analysis.data.coils
    strict, own = [], []
    for fold in analysis.folds:
        pair = (fold.plain, fold.fit)
        strict.append([prediction_error(coils, fold.held, fit) for fit in pair])
        own.append([with_own_pose(coils, fold.held, fit)[0] for fit in pair])
    figure = 'field of one coil at 35 A, component RMSE'
    goal = (TARGET_MT, INNER_TARGET_MT)
    return [
        *_over(data, figure, np.array(strict).swapaxes(0, 1), goal, STRICT),
        *_over(data, figure, np.array(own).swapaxes(0, 1), None, OWN_POSE),
    ]


def _state_rows(analysis: Analysis) -> list[Row]:
    """All three coils on: offsets and what the iron remembers count too."""
    data = analysis.data
    errors = np.zeros((2, *data.terms_t.shape))
    for fold in analysis.folds:
        held = fold.held
        measured = data.terms_t[held]
        for k, fit in enumerate((fold.plain, fold.fit)):
            predicted = np.zeros_like(measured)
            predicted[1:4] = prediction_error(data.coils, held, fit) + data.coils.field_t[held]
            if k == 1:
                known = [p for p in range(len(data.plane)) if p != held]
                memory = learn_memory(others(data.coils, held), data.terms_t[known], fit)
                predicted[0] = memory.offset_t
                predicted[4:] = predict_memory(data.coils.select([held]), fit, memory)[0]
            errors[k, held] = join_states(predicted - measured, data.sign)
    return _over(data, 'field of the eight states, component RMSE', errors, None, STRICT)


def _tool_rows(analysis: Analysis) -> list[Row]:
    data, coils = analysis.data, analysis.data.coils
    strict, own = [], []
    for fold in analysis.folds:
        height = float(coils.height_m[fold.held])
        reading = coils.field_t[fold.held]
        place = (coils.grid_m, height)
        pair = (fold.plain, fold.fit)
        strict.append([tool_errors(reading, fit.sources, fit.errors, *place) for fit in pair])
        states = with_own_pose(coils, fold.held, fold.fit)[1]
        by_half = [
            tool_errors(reading, fold.fit.sources, fold.fit.errors, *place, state)
            for state in states
        ]
        own.append([strict[-1][0], _chess_merge(coils, by_half)])
    out = []
    for text, planes in (
        ('all heights', list(range(len(data.plane)))),
        ('inner heights', inner(data)),
    ):
        for errors, chosen in ((strict, STRICT), (own, OWN_POSE)):
            before, after = (_pooled([errors[p][k] for p in planes]) for k in (0, 1))
            figure = f'each sensor tracked as a tool, {{}} RMSE, {text}'
            out.append(_row(figure.format('position'), before[0], after[0], 'mm', None, chosen))
            out.append(
                _row(figure.format('orientation'), before[1], after[1], 'deg', None, chosen)
            )
    return out


def _chess_merge(coils: PlateData, by_half: list[ToolErrors]) -> ToolErrors:
    """Each sensor against the plate's state that was learnt without it."""
    even = chess_even(coils.grid_m)
    return ToolErrors(
        np.where(even, by_half[1].position_m, by_half[0].position_m),
        np.where(even, by_half[1].angle_rad, by_half[0].angle_rad),
    )


def _pooled(parts: list[ToolErrors]) -> tuple[float, float]:
    """RMSE of position (mm) and orientation (deg) over several heights."""
    together = ToolErrors(
        np.concatenate([part.position_m for part in parts]),
        np.concatenate([part.angle_rad for part in parts]),
    )
    position, angle = together.rmse()
    return 1e3 * position, math.degrees(angle)


def _zero_row(analysis: Analysis, folder: Path) -> Row:
    """The state without current: stored while the supply was still ramping down."""
    data = analysis.data
    series_path = folder / 'navion_timeseries.npz'
    if not series_path.is_file():
        raise FitError(f'no such file: {series_path}')
    before, after = [], []
    with np.load(series_path) as series:
        for k, plane in enumerate(data.plane):
            time, reading = series[f't{plane}'], series[f'B{plane}'].astype(float) * 1e-3
            order = np.argsort(series['sensor'])
            command, current = series[f'tc{plane}'], series[f'I{plane}']
            slew = fit_slew(time, reading, command, current)
            change = float(np.abs(current[-1] - current[-2]).max())
            settled = time > command[-1] + slew.settled_s(change) + 0.1
            known = [p for p in range(len(data.plane)) if p != k]
            offset = data.terms_t[known, 0].mean(axis=0)
            before.append(data.zero_t[k] - offset)
            after.append(reading[settled][:, order].mean(axis=0) - offset)
    return _row(
        "state without current minus the sensors' offsets, RMS",
        1e3 * rms(np.array(before)),
        1e3 * rms(np.array(after)),
        'mT',
        None,
        'offsets: other heights; ramp of the supply: other states of the same height',
    )


def tables(analysis: Analysis) -> str:
    """Candidates and what each was worth, as text.

    The first part lists, for every round, what a candidate adds in log evidence on the heights
    that the fold knows (this chooses) and the component RMSE at the height left out (this only
    reports). The second lists the final model without one effect at a time.
    """
    lines = [
        'candidate                 effects before   log evidence per fold, held-out RMSE (mT)'
    ]
    keys = {(t.round, t.candidate): None for fold in analysis.folds for t in fold.trials}
    for size, name in sorted(keys):
        found = [
            next((t for t in fold.trials if (t.round, t.candidate) == (size, name)), None)
            for fold in analysis.folds
        ]
        cells = [
            f'{t.gain:+9.0f} {1e3 * t.held_out_t:.3f}' if t else f'{"-":>9} {"-":>5}'
            for t in found
        ]
        lines.append(f'{name:<25} {size:>14}   ' + '  '.join(cells))
    lines.append('')
    lines.append('final model without       held-out RMSE (mT) per fold')
    for name in sorted({name for fold in analysis.folds for name in fold.dropped}):
        values = [fold.dropped.get(name, math.nan) * 1e3 for fold in analysis.folds]
        lines.append(f'{name:<25} ' + '  '.join(f'{value:6.3f}' for value in values))
    lines.append('')
    for fold in analysis.folds:
        height = 1e3 * float(analysis.data.coils.height_m[fold.held])
        error = 1e3 * rms(prediction_error(analysis.data.coils, fold.held, fold.fit))
        effects = ', '.join(sorted(fold.fit.effects))
        lines.append(f'height {height:+.1f} mm left out: {error:.3f} mT; {effects}')
        lines.append(f'  metal at {metal_text(fold.fit) or "no place"}')
    return '\n'.join(lines)
