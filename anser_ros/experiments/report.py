"""Reports the experiments in Markdown: printed values, the article's method, and ours."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from anser_ros.experiments import article
from anser_ros.experiments.recordings import HEAD_DISTANCES_CM, MATERIALS

Document = Mapping[str, Any]
"""What `Results.document` returns and paper.json holds."""
PRINTED = 'article, printed (its own hardware)'
WORDS = {
    'drawing': 'Biot-Savart of the drawing, one gain an emitter',
    'article': "article's method (12 x 12 fixed z-dipoles, least squares, in phase)",
    'article, layer over the centres': "article's method, layer no larger than the coils' centres",
    'ours': 'ours',
}
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


def _row(cells: Sequence[str]) -> str:
    return '| ' + ' | '.join(cells) + ' |'


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [_row(head), _row(['---'] * len(head)), *(_row(row) for row in rows)]
    return '\n'.join(lines)


def _statistics_rows(
    name: str, millimetres: Mapping[str, Mapping[str, float]], digits: int
) -> list[list[str]]:
    rows = []
    for sensor in article.SENSORS:
        values = [f'{millimetres[sensor][s]:.{digits}f}' for s in article.STATISTICS]
        rows.append([name, sensor, *values])
    return rows


def _both(name: str, errors: Document) -> list[list[str]]:
    rows = []
    for sensor in article.SENSORS:
        mm, deg = errors[sensor]['position_mm'], errors[sensor]['orientation_deg']
        rows.append([name, sensor, *(f'{mm[s]:.3f} / {deg[s]:.3f}' for s in article.STATISTICS)])
    return rows


def _bound_line(results: Document, experiment: str) -> str:
    bounds = results['bounds_m'][experiment]
    values = ', '.join(f'{sensor} {1e3 * value:.3f} mm' for sensor, value in bounds.items())
    return f'Cramer-Rao bound of the position (root mean square): {values}.'


def _table_2(results: Document) -> str:
    rows = []
    for model in ('Biot-Savart', 'data-driven'):
        mm, deg = article.TABLE_2_MM[model], article.TABLE_2_DEG[model]
        for sensor in article.SENSORS:
            values = [f'{mm[sensor][s]:.2f} / {deg[sensor][s]:.2f}' for s in article.STATISTICS]
            rows.append([f'{PRINTED}: {model}', sensor, *values])
    for method, errors in results['tracking']['table_2'].items():
        rows += _both(f'{WORDS[method]}', errors)
    head = ['model', 'sensor', *(f'{s}, mm / deg' for s in article.STATISTICS)]
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
        printed = article.TABLE_3_FIELD[material]
        for which in ('training', 'test'):
            rows.append([PRINTED, which, *(f'{printed[which][n]:.4f}' for n in names)])
        for method, sets in results['fields'][material].items():
            for which, found in sets.items():
                rows.append([WORDS[method], which, *(f'{found[n]:.4f}' for n in names)])
        parts.append(f'### {material}\n\n' + _table(['model', 'set', *names], rows))
        rows = _statistics_rows(PRINTED, article.TABLE_3_MM[material], 2)
        for method, errors in results['tracking'][f'table_3 {material}'].items():
            rows += _position_rows(WORDS[method], errors)
        parts.append(
            'Tracking on the test points, mm:\n\n'
            + _table(['model', 'sensor', *article.STATISTICS], rows)
        )
        parts.append(_bound_line(results, f'table_3 {material}'))
    return '\n\n'.join(parts)


def _position_rows(name: str, errors: Document) -> list[list[str]]:
    return _statistics_rows(name, {s: e['position_mm'] for s, e in errors.items()}, 3)


def _table_4(results: Document) -> str:
    parts = [
        '## Table IV: shields against the X-ray head (simulated)',
        'Models trained with the plate and without the head, tested with both; the head is 2 cm '
        'below. Position errors in mm.',
    ]
    for case in ('unshielded', *MATERIALS):
        rows = _statistics_rows(PRINTED, article.TABLE_4_MM[case], 2)
        for method, errors in results['tracking'][f'table_4 {case}'].items():
            name = 'our model of the clean board' if case == 'unshielded' else WORDS['ours']
            rows += _position_rows(name if method == 'ours' else WORDS[method], errors)
        parts.append(f'### {case}\n\n' + _table(['model', 'sensor', *article.STATISTICS], rows))
    rows = []
    for distance in HEAD_DISTANCES_CM:
        methods = results['tracking'][f'fig_7 {distance} cm']
        rows.append(
            [
                f'{distance} cm',
                *(
                    f'{methods[method][sensor]["position_mm"]["RMSE"]:.3f}'
                    for method in ('drawing', 'ours')
                    for sensor in article.SENSORS
                ),
            ]
        )
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
    for case, printed in article.TABLE_5_MM.items():
        rows = _statistics_rows(PRINTED, printed, 2)
        for method, errors in results['tracking'][f'table_5 {case}'].items():
            name = WORDS[method]
            if case == 'uncompensated' and method == 'ours':
                name = 'our model of the clean board'
            rows += _position_rows(name, errors)
        parts.append(f'### {case}\n\n' + _table(['model', 'sensor', *article.STATISTICS], rows))
    for method, words in results['corrections'].items():
        lines = '; '.join(f'{sensor}: {text}' for sensor, text in words.items())
        parts.append(f'Correction, {WORDS[method]}: {lines}.')
    parts.append(_bound_line(results, 'table_5 compensated'))
    return '\n\n'.join(parts)


def _models(results: Document) -> str:
    rows = [[name, text] for name, text in results['models'].items()]
    return '## Our models, as held-out error chose them\n\n' + _table(
        ['trained on', 'model'], rows
    )


def _board(results: Document) -> str:
    if not results['measured_board']:
        return ''
    rows = [
        [
            run['name'],
            f'{run["points"]}',
            f'{1e3 * run["before_m"]:.2f}',
            f'{1e3 * run["after_m"]:.2f}',
            f'{1e3 * run["across_m"]:.2f}',
            'yes' if run['confirmed'] else 'no',
            run['shape'],
        ]
        for run in results['measured_board']
    ]
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
