"""Reports the Navion folds, the prediction of whole states, and every candidate as text."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from anser_ros.measured.navion_data import NavionData, load
from anser_ros.measured.navion_fit import PlateFit
from anser_ros.measured.navion_held_out import (
    Fold,
    metal_places,
    prediction_error,
    rms,
    run_fold,
)
from anser_ros.measured.navion_plate import PlateData, predict_plane
from anser_ros.measured.navion_sources import polarizability
from anser_ros.measured.navion_states import (
    join_states,
    learn_memory,
    predict_memory,
    split_states,
)

Array = NDArray[np.float64]

_ONE_OBJECT = 1.0 / 3.0
"""Asymmetry of the polarisability above which a dipole stands for more than one small object."""


@dataclass(frozen=True)
class NavionAnalysis:
    """Holds everything that was found, fold by fold."""

    data: NavionData
    folds: tuple[Fold, ...]


def analyse(folder: Path, tell: Callable[[str], None] = lambda _: None) -> NavionAnalysis:
    """Leave each height out in turn; `tell` hears of each fold's choice."""
    data = load(folder)
    folds = [run_fold(data.coils, held, tell) for held in range(len(data.plane))]
    return NavionAnalysis(data, tuple(folds))


def predict_states(data: NavionData, fit: PlateFit, known: list[int], height_m: float) -> Array:
    """Predict the eight states (8, S, 3), T, at a height.

    Parameters
    ----------
    data : NavionData
    fit : PlateFit
        Fitted to the heights `known`.
    known : list of int
        Heights whose offsets and hysteresis are used.
    height_m : float
        Nominal height of the plate; its own pose and bend are unknown there.
    """
    memory = learn_memory(data.coils.select(known), data.terms_t[known], fit)
    place = PlateData(np.array([height_m]), data.coils.grid_m, data.coils.field_t[:1])
    terms = np.zeros_like(data.terms_t[0])
    terms[0] = memory.offset_t
    terms[1:4] = predict_plane(data.coils.grid_m, height_m, fit.sources, fit.errors, None)
    terms[4:] = predict_memory(place, fit, memory)[0]
    return join_states(terms, data.sign)


def memory_table(analysis: NavionAnalysis) -> str:
    """Return the held-out RMSE (mT) of terms no linear magnet has, raw and explained."""
    data = analysis.data
    lines = ['term                      raw    explained (held-out RMSE, mT)']
    residual = np.zeros_like(data.terms_t)
    for fold in analysis.folds:
        known = [p for p in range(len(data.plane)) if p != fold.held]
        height = float(data.coils.height_m[fold.held])
        states = predict_states(data, fold.fit, known, height)
        residual[fold.held] = split_states(states, data.sign) - data.terms_t[fold.held]
    for name, pick in (
        ('pickup (constant)', [0]),
        ('core_hysteresis (pairs)', [4, 5, 6]),
        ('core_hysteresis (triple)', [7]),
    ):
        raw, rest = 1e3 * rms(data.terms_t[:, pick]), 1e3 * rms(residual[:, pick])
        lines.append(f'{name:<25} {raw:.3f}  {rest:.3f}')
    return '\n'.join(lines)


def tables(analysis: NavionAnalysis) -> str:
    """Return candidates and what each was worth, as text.

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
        errors = [1e3 * fold.dropped.get(name, math.nan) for fold in analysis.folds]
        lines.append(f'{name:<25} ' + '  '.join(f'{error:6.3f}' for error in errors))
    lines.append('')
    for fold in analysis.folds:
        height = 1e3 * float(analysis.data.coils.height_m[fold.held])
        error = 1e3 * rms(prediction_error(analysis.data.coils, fold.held, fold.fit))
        effects = ', '.join(sorted(fold.fit.effects))
        lines.append(f'height {height:+.1f} mm left out: {error:.3f} mT; {effects}')
        for k, place in enumerate(metal_places(fold.fit)):
            alpha, odd = polarizability(fold.fit.sources, k)
            kind = 'one object' if odd < _ONE_OBJECT else 'part of something extended'
            where = ', '.join(f'{1e3 * x:.0f}' for x in place)
            extent = ', '.join(f'{1e6 * x:.0f}' for x in np.linalg.eigvalsh((alpha + alpha.T) / 2))
            lines.append(
                f'  static_metal at ({where}) mm: {extent} cm^3, asymmetry {odd:.2f} ({kind})'
            )
    lines += ['', memory_table(analysis)]
    return '\n'.join(lines)
