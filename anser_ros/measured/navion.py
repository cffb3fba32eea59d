"""Finds what the dipole model of three electromagnets lacks at a plate of Hall sensors, by height.

The data (Boehler et al., IEEE T-RO 2022, doi 10.1109/TRO.2022.3197107, Apache-2.0) are read where
they lie. Every height of the plate is predicted from the other heights; see `navion_held_out` for
what that means. The effects are found by `navion_fit`, metal by `navion_sources`.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import FitError
from anser_ros.measured import ReportRow
from anser_ros.measured.navion_data import NavionData, inner
from anser_ros.measured.navion_held_out import chess_even, prediction_error, rms, with_own_pose
from anser_ros.measured.navion_plate import PlateData, predict_plane
from anser_ros.measured.navion_report import NavionAnalysis, predict_states
from anser_ros.measured.navion_states import fit_slew, join_states
from anser_ros.measured.navion_tool import ToolErrors, tool_errors

Array = NDArray[np.float64]

NAME = 'navion'

TARGET_MT = 0.27
"""Error of the field that the analysis should reach, mT."""
INNER_TARGET_MT = 0.135
"""Error of the field that it should reach at the inner heights, mT."""

STRICT = 'effects and model: the other heights only; scored on the height left out'
OWN_POSE = 'as above, but pose and bend of the height left out from half its sensors; other half'


def rows(analysis: NavionAnalysis, folder: Path) -> list[ReportRow]:
    """Return the errors before and after, on heights that took no part."""
    return [
        *_field_rows(analysis),
        *_state_rows(analysis),
        *_tool_rows(analysis),
        _zero_row(analysis, folder),
    ]


def _row(
    figure: str, before: float, after: float, unit: str, target: float | None, chosen_on: str
) -> ReportRow:
    met = None if target is None else bool(after <= target)
    return ReportRow(NAME, figure, before, after, unit, target, met, chosen_on)


def _over(
    data: NavionData, figure: str, errors: Array, target: tuple[float, float] | None, chosen: str
) -> list[ReportRow]:
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


def _field_rows(analysis: NavionAnalysis) -> list[ReportRow]:
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


def _state_rows(analysis: NavionAnalysis) -> list[ReportRow]:
    """All three coils on: offsets and what the iron remembers count too."""
    data = analysis.data
    errors = np.zeros((2, *data.terms_t.shape))
    for fold in analysis.folds:
        held, height = fold.held, float(data.coils.height_m[fold.held])
        measured = join_states(data.terms_t[held], data.sign)
        plain = np.zeros_like(data.terms_t[held])
        sources, sensors = fold.plain.sources, fold.plain.errors
        plain[1:4] = predict_plane(data.coils.grid_m, height, sources, sensors, None)
        errors[0, held] = join_states(plain, data.sign) - measured
        known = [p for p in range(len(data.plane)) if p != held]
        errors[1, held] = predict_states(data, fold.fit, known, height) - measured
    return _over(data, 'field of the eight states, component RMSE', errors, None, STRICT)


def _tool_rows(analysis: NavionAnalysis) -> list[ReportRow]:
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


def _zero_row(analysis: NavionAnalysis, folder: Path) -> ReportRow:
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
