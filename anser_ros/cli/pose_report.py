"""Shows the diagnosis of a tracker of poses as a self-contained page for a clinic's engineer."""

import html
from typing import Any

import matplotlib

matplotlib.use('Agg')
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from anser_ros.cli.diagnosis_figures import AFTER, BEFORE, image
from anser_ros.cli.diagnosis_words import short_ones, value_text
from anser_ros.cli.html_page import page, table
from anser_ros.poses.diagnosis import PoseDiagnosis
from anser_ros.poses.problem import PosePart, PoseState

Array = NDArray[np.float64]

GROUPS = 5  # groups of equal numbers of poses in the tables by distance, speed and orientation
LIMITS = 1.96  # standard deviations within which 95 % of normal differences lie


def pose_verdict(document: dict[str, Any]) -> str:
    """State in one paragraph what was found and what stays unexplained."""
    held, rest = document['held_out'], document['unexplained']
    found = [effect for effect in document['effects'] if effect['name'] != 'hand_eye']
    before, after = 1e3 * held['position_rmse_before_m'], 1e3 * held['position_rmse_after_m']
    if found:
        names = ', '.join(dict.fromkeys(str(effect['name']) for effect in found))
        text = f'Found: {names}. On held-out poses the error falls from '
        text += f'{before:.2f} to {after:.2f} mm.'
    else:
        text = f'No effect is found: with hand-eye alone the held-out error is {after:.2f} mm.'
    if rest['fraction'] > 0:
        on = ', '.join(rest['depends_on']) or 'none of the variables examined'
        text += f' {rest["fraction"]:.0%} of the squared error above the jitter stays'
        text += f' unexplained; it depends on {on}.'
    return text


def render_poses(found: PoseDiagnosis, document: dict[str, Any], session: str) -> str:
    """Return the page as HTML with its figures inside."""
    before, after = found.states
    sections = [
        f'<h1>Diagnosis of poses</h1><p class="note">session <code>{html.escape(session)}</code>'
        f'</p><p class="verdict">{html.escape(pose_verdict(document))}</p>',
        '<h2>Before and after</h2><p>Root mean square errors of every fifth stretch of time, '
            'which was used neither to choose nor to fit.</p>',
        _by_sensor(document),
        '<h2>Effects</h2>',
        _effects(document),
        '<h2>By distance, speed and orientation</h2>',
        _groups(before, after),
        '<h2>Over time</h2>',
        image(_over_time(before, after)),
        '<h2>Agreement of both trackers (Bland and Altman)</h2><p>Difference of the two trackers '
        'against their mean, by axis; the lines are the mean difference and the limits between '
        'which 95% of differences lie.</p>',
        image(_bland_altman(after)),
        '<h2>What was tried and not named</h2>',
        table(['candidate', 'why not'],
               [[row['candidate'], row['why']] for row in document['refused']]),
    ]  # fmt: skip
    return page('Diagnosis', sections)


def _mm(value: float | None) -> str:
    return '-' if value is None else f'{1e3 * value:.2f}'


def _deg(value: float | None) -> str:
    return '-' if value is None else f'{np.rad2deg(value):.2f}'


def _by_sensor(document: dict[str, Any]) -> str:
    rows = [
        [
            name, _mm(row['position_rmse_registration_only_m']),
            _mm(row['position_rmse_before_m']), _mm(row['position_rmse_after_m']),
            _deg(row['orientation_rmse_before_rad']), _deg(row['orientation_rmse_after_rad']),
        ]
        for name, row in document['sensors'].items()
    ]  # fmt: skip
    return table(
        ['sensor', 'registration only, mm', 'with lever arm and mount, mm', 'with effects, mm',
         'with mount, deg', 'with effects, deg'], rows,
    )  # fmt: skip


def _effects(document: dict[str, Any]) -> str:
    rows = []
    for effect in document['effects']:
        evidence = effect['evidence']
        rows.append([
            effect['name'],
            str(evidence.get('summary') or ''),
            '\n'.join(f'{k} = {value_text(v)}' for k, v in short_ones(effect['parameters'])),
            '\n'.join(f'{k} ± {value_text(v)}' for k, v in short_ones(effect['uncertainty'])),
            _mm(evidence.get('position_rmse_without_m')),
        ])  # fmt: skip
    head = ['effect', 'what it is', 'parameters', '1 sigma', 'error without it, mm']
    return table(head, rows).replace('\n', '<br>')


def _groups(before: PoseState, after: PoseState) -> str:
    rows = []
    for label, unit, measure in (
        ('distance from the field generator', 'mm', _distance),
        ('speed', 'mm/s', _speed),
        ('turn from the mean orientation', 'deg', _turn),
    ):
        value = np.concatenate([measure(part)[part.used] for part in after.parts])
        errors = [
            np.concatenate([np.sum(p.residual[p.used, :3] ** 2, axis=1) for p in state.parts])
            for state in (before, after)
        ]
        if value.size < 2 * GROUPS or errors[0].size != value.size:
            continue
        edges = np.quantile(value, np.linspace(0, 1, GROUPS + 1))
        for k in range(GROUPS):
            inside = (value >= edges[k]) & (value <= edges[k + 1])
            one, other = (1e3 * float(np.sqrt(np.mean(e[inside]))) for e in errors)
            where = f'{label} {edges[k]:.0f} to {edges[k + 1]:.0f} {unit}'
            rows.append([where, str(int(inside.sum())), f'{one:.2f}', f'{other:.2f}'])
    return table(['poses', 'number', 'before, mm', 'after, mm'], rows)


def _distance(part: PosePart) -> Array:
    return np.asarray(1e3 * np.linalg.norm(part.view.measured, axis=1))


def _speed(part: PosePart) -> Array:
    return np.asarray(1e3 * np.linalg.norm(part.view.velocity[:, :3], axis=1))


def _turn(part: PosePart) -> Array:
    turns = Rotation.from_matrix(part.view.measured_rotation)
    return np.asarray(np.rad2deg((turns.mean().inv() * turns).magnitude()))


def _over_time(before: PoseState, after: PoseState) -> Figure:
    figure, axes = plt.subplots(figsize=(9, 3), layout='constrained')
    for state, colour, label in ((before, BEFORE, 'before'), (after, AFTER, 'after')):
        for k, part in enumerate(state.parts):
            size = 1e3 * np.linalg.norm(part.residual[:, :3], axis=1)
            axes.plot(part.view.time[part.used], size[part.used], '.', ms=2, color=colour,
                      label=label if k == 0 else None)  # fmt: skip
    axes.set(xlabel='time, s', ylabel='distance, mm', yscale='log')
    axes.legend()
    return figure


def _bland_altman(state: PoseState) -> Figure:
    figure, panels = plt.subplots(1, 3, figsize=(9, 3), layout='constrained', sharey=True)
    for axis, (panel, name) in enumerate(zip(panels, 'xyz', strict=True)):
        every = []
        for part in state.parts:
            difference = 1e3 * part.residual[part.used, axis]
            mean = 1e3 * part.view.position[part.used, axis] + 0.5 * difference
            panel.plot(mean, difference, '.', ms=2)
            every.append(difference)
        values = np.concatenate(every)
        middle, spread = float(values.mean()), LIMITS * float(values.std())
        for line in (middle - spread, middle, middle + spread):
            panel.axhline(line, color='0.4', lw=0.8)
        panel.set(xlabel=f'{name}, mm')
        panel.locator_params(axis='x', nbins=5)
    panels[0].set_ylabel('tracked minus optical, mm')
    return figure
