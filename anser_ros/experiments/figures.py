"""Draws the article's Figs. 2 and 5 to 10 from the results of the experiments."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from numpy.typing import NDArray

from anser_ros.experiments.recordings import HEAD_DISTANCES_CM, MATERIALS, checkerboard
from anser_ros.experiments.study import Study
from anser_ros.experiments.tracking_errors import SensorErrors
from anser_ros.field.model import FieldModel
from anser_ros.pictures import legend_below, save
from anser_ros.sessions.session import Session

Array = NDArray[np.float64]

SIMULATED = 'simulated data'
SENSOR_WORDS = {'Y': 'Y sensor (horizontal)', 'Z': 'Z sensor (vertical)'}
PROFILE_EMITTER = 3
"""Index of the emitter of Fig. 6, the article's coil number 4."""
PROFILE_BAND_M = 0.006
"""Distance from the line y = 0, m, up to which readings are drawn beside a profile; it is about
half the distance of neighbouring points."""
SAME = 0.05
"""Relative difference of medians below which a curve may hide an earlier one, and is dashed."""


def draw_all(study: Study, folder: Path) -> dict[str, str]:
    """Draw every figure into a folder and return the file names by figure."""
    folder.mkdir(parents=True, exist_ok=True)
    tracking = study.results.tracking
    made = {
        'Fig. 2': _training_points(study, folder),
        'Fig. 5': _cdfs(
            folder / 'fig_5.png',
            {'drawing': tracking['table_2']['drawing'], 'ours': tracking['table_2']['ours']},
            'Error on the mid-plane',
        ),
        'Fig. 6': _profiles(study, folder),
        'Fig. 7': _cdfs(
            folder / 'fig_7.png',
            {f'{d} cm': tracking[f'fig_7 {d} cm']['drawing'] for d in HEAD_DISTANCES_CM},
            'X-ray head at several distances, uncompensated',
        ),
        'Fig. 8': _lattices(tracking[f'fig_7 {HEAD_DISTANCES_CM[-1]} cm']['drawing'], folder),
        'Fig. 9': _cdfs(
            folder / 'fig_9.png',
            {m: tracking[f'table_4 {m}']['ours'] for m in MATERIALS},
            'X-ray head below a shield, model trained without the head',
        ),
        'Fig. 10': _cdfs(
            folder / 'fig_10.png',
            {
                'uncompensated': tracking['table_5 uncompensated']['drawing'],
                'compensated': tracking['table_5 compensated']['ours'],
                'compensated and corrected': tracking['table_5 compensated and corrected']['ours'],
            },
            'Board on top of the X-ray collimator',
        ),
    }
    return {name: path.name for name, path in made.items()}


def _save(figure: Any, path: Path, title: str) -> Path:
    figure.suptitle(f'{title} ({SIMULATED})', fontsize=10)
    if figure.get_layout_engine() is None:
        figure.tight_layout()
    save(figure, path)
    return path


def _cdfs(path: Path, curves: Mapping[str, Mapping[str, SensorErrors]], title: str) -> Path:
    """Draw the empirical distribution of the position error with a panel for each sensor."""
    figure, panels = plt.subplots(1, 2, figsize=(9, 3.8), sharey=True, layout='constrained')
    for panel, (sensor, words) in zip(panels, SENSOR_WORDS.items(), strict=True):
        medians: list[float] = []
        largest = 0.0
        for name, errors in curves.items():
            distance = np.sort(1e3 * errors[sensor].distance)
            distance = distance[np.isfinite(distance)]
            if distance.size == 0:
                continue
            share = np.arange(1, distance.size + 1) / distance.size
            middle = float(np.median(distance))
            hides = any(abs(middle - other) < SAME * other for other in medians)
            style = {'ls': (0, (4, 4)), 'lw': 2.5} if hides else {}
            panel.step(distance, share, where='post', label=name, **style)
            medians.append(middle)
            largest = max(largest, distance[-1])
        if medians and largest > 20.0 * min(medians):
            panel.set_xscale('log')
        panel.set(xlabel='position error, mm', title=words)
        panel.grid(alpha=0.3)
    panels[0].set_ylabel('share of the points')
    legend_below(figure, panels[0])
    return _save(figure, path, title)


def _training_points(study: Study, folder: Path) -> Path:
    training, test = checkerboard(study.recordings.shield(MATERIALS[0]))
    figure, panel = plt.subplots(figsize=(4.6, 4.8), layout='constrained')
    for session, mark, name in ((training, 's', 'training'), (test, '.', 'test')):
        where = 1e3 * session.tools[0].position
        panel.plot(where[:, 0], where[:, 1], mark, ms=4, label=f'{name} ({len(where)})')
    panel.set(xlabel='x, mm', ylabel='y, mm', aspect='equal')
    legend_below(figure, panel)
    return _save(figure, folder / 'fig_2.png', 'Training and test points over a plate')


def _profiles(study: Study, folder: Path) -> Path:
    """Draw the field of one emitter along x at y = 0, with the readings near that line."""
    figure, panels = plt.subplots(1, 2, figsize=(10, 4))
    cases: list[tuple[str, Session, FieldModel]] = [
        ('no shield', study.factory, study.factory_calibration.model)
    ]
    for material in MATERIALS:
        session = study.recordings.shield(material)
        cases.append((material, session, study.shield_models[material][1]))
    emitter = min(PROFILE_EMITTER, len(study.factory.setup.emitter_names) - 1)
    x = np.linspace(-0.15, 0.15, 121)
    points = np.stack([x, np.zeros_like(x), np.full_like(x, 0.15)], axis=1)
    for panel, component, letter in ((panels[0], 0, 'X'), (panels[1], 2, 'Z')):
        axes = np.tile(np.eye(3)[component], (len(x), 1))
        for color, (name, session, model) in zip(('C0', 'C1', 'C2'), cases, strict=True):
            flux = 1e9 * model.flux(points, axes)[:, emitter]
            panel.plot(1e3 * x, flux.real, color=color, label=f'{name}, fit')
            if name != 'no shield':
                panel.plot(1e3 * x, flux.imag, '--', color=color, label=f'{name}, quadrature')
            place, value = _readings_near(session, component, emitter)
            panel.plot(1e3 * place, 1e9 * value.real, '.', color=color, ms=4)
        panel.set(xlabel='x, mm', ylabel=f'{letter} component, nT')
        panel.grid(alpha=0.3)
        panel.legend(fontsize=7)
    title = f'Emitter {emitter + 1} at y = 0, z = 150 mm; dots: readings near that line'
    return _save(figure, folder / 'fig_6.png', title)


def _readings_near(
    session: Session, component: int, emitter: int
) -> tuple[Array, NDArray[np.complex128]]:
    """Return x (m) and flux (T) of the readings near the line by sensors along a component."""
    tool = session.tools[0]
    points, axes = tool.placed()
    near = (np.abs(points[..., 1]) < PROFILE_BAND_M) & (np.abs(points[..., 2] - 0.15) < 0.004)
    near &= (axes[..., component] > 0.99) & tool.usable
    return points[near][:, 0], tool.flux[near][:, emitter]


def _lattices(errors: Mapping[str, SensorErrors], folder: Path) -> Path:
    """Draw the true (red) and the tracked (black) lattice, coloured by the error."""
    figure, panels = plt.subplots(1, 2, figsize=(10, 4.4))
    for panel, (sensor, words) in zip(panels, SENSOR_WORDS.items(), strict=True):
        found = errors[sensor]
        for places, color in ((found.true, 'red'), (found.tracked, 'black')):
            for line in _lattice_lines(found.true):
                where = 1e3 * places[line]
                panel.plot(where[:, 0], where[:, 1], '-', color=color, lw=0.7)
        dots = panel.scatter(
            1e3 * found.true[:, 0], 1e3 * found.true[:, 1], c=1e3 * found.distance, s=16,
            cmap='viridis', zorder=3,
        )  # fmt: skip
        figure.colorbar(dots, ax=panel, label='position error, mm')
        panel.set(xlabel='x, mm', ylabel='y, mm', aspect='equal', title=words)
    title = f'X-ray head {HEAD_DISTANCES_CM[-1]} cm below, uncompensated; red true, black tracked'
    return _save(figure, folder / 'fig_8.png', title)


def _lattice_lines(places: Array) -> Sequence[NDArray[np.int64]]:
    """Return the rows and columns of a square lattice as indices in order."""
    side = max(round(np.sqrt(len(places))) - 1, 1)
    low, high = np.nanmin(places, axis=0)[:2], np.nanmax(places, axis=0)[:2]
    cell = np.rint((places[:, :2] - low) / np.maximum(high - low, 1e-9) * side)
    lines = []
    for along, across in ((0, 1), (1, 0)):
        for value in range(side + 1):
            rows = np.flatnonzero(cell[:, across] == value)
            lines.append(rows[np.argsort(places[rows, along])])
    return lines
