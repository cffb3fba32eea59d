"""Writes the study of the article's experiments as tables and figures."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import pyplot as plt

from anser_ros.apps.lab.experiments import recordings
from anser_ros.apps.lab.experiments.recordings import HEAD_DISTANCES_CM, MATERIALS, checkerboard
from anser_ros.apps.lab.experiments.study import SensorErrors, Study
from anser_ros.arrays import Array, ComplexArray, Integers
from anser_ros.cli.page import legend_beside, save
from anser_ros.field.model import FieldModel
from anser_ros.sessions.session import Session

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
            is_ordered=True,
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


def _cdfs(
    path: Path,
    curves: Mapping[str, Mapping[str, SensorErrors]],
    title: str,
    *,
    is_ordered: bool = False,
) -> Path:
    """Draw the distribution of the position error with a panel for each sensor; curves that are
    ordered have the colours of a scale.
    """
    scale = plt.get_cmap('viridis')(np.linspace(0.0, 0.9, len(curves)))
    figure, panels = plt.subplots(1, 2, figsize=(9, 3.8), sharey=True, layout='constrained')
    for panel, (sensor, words) in zip(panels, SENSOR_WORDS.items(), strict=True):
        medians: list[float] = []
        largest = 0.0
        for rank, (name, errors) in enumerate(curves.items()):
            distance = np.sort(1e3 * errors[sensor].distance)
            distance = distance[np.isfinite(distance)]
            if distance.size == 0:
                continue
            share = np.arange(1, distance.size + 1) / distance.size
            middle = float(np.median(distance))
            hides = any(abs(middle - other) < SAME * other for other in medians)
            style = {'ls': (0, (4, 4)), 'lw': 2.5} if hides else {}
            color = scale[rank] if is_ordered else f'C{rank}'
            panel.step(distance, share, where='post', label=name, color=color, **style)
            medians.append(middle)
            largest = max(largest, distance[-1])
        if medians and largest > 20.0 * min(medians):
            panel.set_xscale('log')
        panel.set(xlabel='position error, mm', title=words)
        panel.grid(alpha=0.3)
    panels[0].set_ylabel('share of the points')
    legend_beside(figure, below=1.0)
    return _save(figure, path, title)


def _training_points(study: Study, folder: Path) -> Path:
    training, test = checkerboard(study.recordings.shield(MATERIALS[0]))
    figure, panel = plt.subplots(figsize=(4.6, 4.8), layout='constrained')
    for session, mark, name in ((training, 's', 'training'), (test, '.', 'test')):
        where = 1e3 * session.tools[0].position
        panel.plot(where[:, 0], where[:, 1], mark, ms=4, label=f'{name} ({len(where)})')
    panel.set(xlabel='x, mm', ylabel='y, mm', aspect='equal')
    legend_beside(figure, below=1.0)
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


def _readings_near(session: Session, component: int, emitter: int) -> tuple[Array, ComplexArray]:
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


def _lattice_lines(places: Array) -> Sequence[Integers]:
    """Return the rows and columns of a square lattice as indices in order."""
    cell, lines = recordings.lattice_cells(places), []
    for along, across in ((0, 1), (1, 0)):
        for value in range(int(np.nanmax(cell)) + 1):
            rows = np.flatnonzero(cell[:, across] == value)
            lines.append(rows[np.argsort(places[rows, along])])
    return lines


Document = Mapping[str, Any]
"""What `Results.document` returns and paper.json holds."""
PRINTED = 'article, printed (its own hardware)'
WORDS = {
    'drawing': 'Biot-Savart of the drawing, one gain an emitter',
    'article': "article's method (12 x 12 fixed z-dipoles, least squares, in phase)",
    'article, layer over the centres': "article's method, layer no larger than the coils' centres",
    'ours': 'ours',
}
CLEAN, CLEAN_WORDS = ('unshielded', 'uncompensated'), 'our model of the clean board'
"""Cases in which our model is that of the board without metal, and its words there."""
CAPTIONS = {
    'Fig. 2': 'Training and test points of Table III.',
    'Fig. 5': 'Empirical distribution of the position error of Table II.',
    'Fig. 6': 'Field of one emitter without and with shields: fit (lines), quadrature (dashed), '
    'readings near the line (dots; tool B has no X sensor).',
    'Fig. 7': 'Position error without compensation for several distances of the X-ray head.',
    'Fig. 8': 'Lattices of true and tracked points at the smallest distance.',
    'Fig. 9': 'Position error with shield and head, model trained without the head.',
    'Fig. 10': 'Position error of Table V.',
}


def write_report(results: Document, figures: Mapping[str, str], path: Path) -> None:
    """Write the report of the results; the figures are linked by their file names."""
    parts = [
        _header(results), _table_2(results), _table_3(results), _table_4(results),
        _table_5(results), _models(results), _board(results), _figures(figures),
    ]  # fmt: skip
    path.write_text('\n\n'.join(part for part in parts if part) + '\n', encoding='utf-8')


def _header(results: Document) -> str:
    return (
        "# The article's experiments, redone\n\n"
        f'**The data of these experiments is simulated** ({results["origin"]}); the rows '
        f'"{PRINTED}" were measured by the authors on their hardware. Errors are against the '
        'optical pose, which itself jitters by 0.07 mm an axis (0.12 mm in space): no method can '
        'be below that. No optical pose is used to track. Each experiment gives three lines: what '
        'the article '
        "prints, the article's own method on this data, and ours. The bound is Cramer and Rao's: "
        'the smallest error that the flux noise allows, without the jitter of the reference.\n\n'
        'Made by `anser paper`.'
    )


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = (head, ['---'] * len(head), *rows)
    return '\n'.join(f'| {" | ".join(cells)} |' for cells in lines)


def _sensor_rows(name: str, digits: int, *figures: recordings.Column) -> list[list[str]]:
    """Return a row for each sensor, with a cell for each statistic of all figures."""
    return [
        [name, sensor, *(
            ' / '.join(f'{one[sensor][statistic]:.{digits}f}' for one in figures)
            for statistic in recordings.STATISTICS
        )]
        for sensor in recordings.SENSORS
    ]  # fmt: skip


def _column(errors: Document, figure: str) -> recordings.Column:
    return {sensor: found[figure] for sensor, found in errors.items()}


def _tracked(results: Document, experiment: str, printed: recordings.Column) -> str:
    """Return the table of an experiment's position errors below what the article printed."""
    rows = _sensor_rows(PRINTED, 2, printed)
    for method, errors in results['tracking'][experiment].items():
        is_clean = method == 'ours' and experiment.split()[1] in CLEAN
        words = CLEAN_WORDS if is_clean else WORDS[method]
        rows += _sensor_rows(words, 3, _column(errors, 'position_mm'))
    return _table(['model', 'sensor', *recordings.STATISTICS], rows)


def _bound_line(results: Document, experiment: str) -> str:
    bounds = results['bounds_m'][experiment]
    values = ', '.join(f'{sensor} {1e3 * value:.3f} mm' for sensor, value in bounds.items())
    return f'Cramer-Rao bound of the position (root mean square): {values}.'


def _table_2(results: Document) -> str:
    rows = []
    for model, mm in recordings.TABLE_2_MM.items():
        rows += _sensor_rows(f'{PRINTED}: {model}', 2, mm, recordings.TABLE_2_DEG[model])
    for method, errors in results['tracking']['table_2'].items():
        both = (_column(errors, figure) for figure in ('position_mm', 'orientation_deg'))
        rows += _sensor_rows(WORDS[method], 3, *both)
    head = ['model', 'sensor', *(f'{s}, mm / deg' for s in recordings.STATISTICS)]
    return (
        '## Table II: a new model of the board (simulated)\n\nTrained with tool A, tested with '
        f'tool B.\n\n{_table(head, rows)}\n\n{_bound_line(results, "table_2")}'
    )


def _table_3(results: Document) -> str:
    parts = ['## Table III: fields over a shield (simulated)']
    parts.append(
        'Half of the points train, the other half of the checkerboard tests. Errors of the field '
        'in phase at the measured poses, MAE and RMSE in mA/m, N- in percent of the range.'
    )
    names = ('MAE', 'N-MAE', 'RMSE', 'N-RMSE')
    for material in MATERIALS:
        rows = []
        printed = recordings.TABLE_3_FIELD[material]
        found = results['fields'][material].items()
        for words, sets in ((PRINTED, printed), *((WORDS[m], s) for m, s in found)):
            for which, figures in sets.items():
                rows.append([words, which, *(f'{figures[n]:.4f}' for n in names)])
        parts.append(f'### {material}\n\n' + _table(['model', 'set', *names], rows))
        tracked = _tracked(results, f'table_3 {material}', recordings.TABLE_3_MM[material])
        parts.append(f'Tracking on the test points, mm:\n\n{tracked}')
        parts.append(_bound_line(results, f'table_3 {material}'))
    return '\n\n'.join(parts)


def _table_4(results: Document) -> str:
    parts = [
        '## Table IV: shields against the X-ray head (simulated)',
        'Models trained with the plate and without the head, tested with both; the head is 2 cm '
        'below. Position errors in mm.',
    ]
    for case, printed in recordings.TABLE_4_MM.items():
        parts.append(f'### {case}\n\n{_tracked(results, f"table_4 {case}", printed)}')
    rows = []
    for distance in HEAD_DISTANCES_CM:
        methods = results['tracking'][f'fig_7 {distance} cm']
        errors = [methods[m][s] for m in ('drawing', 'ours') for s in recordings.SENSORS]
        rows.append([f'{distance} cm', *(f'{e["position_mm"]["RMSE"]:.3f}' for e in errors)])
    head = ['head below', 'drawing, Y', 'drawing, Z', 'our clean model, Y', 'our clean model, Z']
    parts.append('### Unshielded and uncompensated (Fig. 7), RMSE in mm\n\n' + _table(head, rows))
    return '\n\n'.join(parts)


def _table_5(results: Document) -> str:
    parts = [
        '## Table V: distortion compensated (simulated)',
        'The board lies on the X-ray collimator. Models trained on the bottom and top planes of '
        'tool A, tested with tool B between them, then corrected with what the bottom plane of '
        'tool B says (only where that helps on held-out blocks of that plane). Position errors '
        'in mm.',
    ]
    for case, printed in recordings.TABLE_5_MM.items():
        parts.append(f'### {case}\n\n{_tracked(results, f"table_5 {case}", printed)}')
    for method, words in results['corrections'].items():
        lines = '; '.join(f'{sensor}: {text}' for sensor, text in words.items())
        parts.append(f'Correction, {WORDS[method]}: {lines}.')
    parts.append(_bound_line(results, 'table_5 compensated'))
    return '\n\n'.join(parts)


def _models(results: Document) -> str:
    table = _table(['trained on', 'model'], list(results['models'].items()))
    return f'## Our models, as held-out error chose them\n\n{table}'


def _board(results: Document) -> str:
    if not results['measured_board']:
        return ''
    rows = []
    for run in results['measured_board']:
        errors = [f'{1e3 * run[key]:.2f}' for key in ('before_m', 'after_m', 'across_m')]
        gain = 'yes' if run['confirmed'] else 'no'
        rows.append([run['name'], f'{run["points"]}', *errors, gain, run['shape']])
    head = ['run', 'points', 'before, mm rms', 'after, mm rms', 'across, mm rms', 'gain', 'map']
    return (
        '## Error maps on measured positions\n\n'
        'The only measured data of this report: what a real Anser system (github '
        'kilianod5150/Matlab-Anser, BSD-3) reported at 41 known places of a flat board. Before '
        'and after are errors along the board, of blocks of space that took no part: neither in '
        'the rigid alignment, nor in the choice of the map, nor in the decision whether to use '
        'it, nor in its fit. What lies across the board is not corrected: a map that flattens the '
        'points would gain there, and tell nothing of other heights. A gain is told where the '
        'blocks show it by two standard errors; a map that helped among the other blocks can make '
        'a block worse, and does. The last column is the map that all points together choose.'
        '\n\n' + _table(head, rows)
    )


def _figures(figures: Mapping[str, str]) -> str:
    parts = ['## Figures (simulated data)']
    for name, file in figures.items():
        parts.append(f'**{name}.** {CAPTIONS[name]} Simulated.\n\n![{name}]({file})')
    return '\n\n'.join(parts)
