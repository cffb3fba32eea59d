"""Shows the diagnosis of a tracker of poses as a self-contained page for a clinic's engineer."""

import re
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from anser_ros.cli.html_page import (
    AFTER,
    BEFORE,
    Html,
    details,
    heading,
    page,
    paragraph,
    picture,
    table,
    top,
)
from anser_ros.cli.output import number
from anser_ros.cli.pose_values import sizes
from anser_ros.physics.constants import DEGREES
from anser_ros.pictures import legend_below, spell_out
from anser_ros.poses.diagnosis import PoseDiagnosis
from anser_ros.poses.effect import Role
from anser_ros.poses.problem import PosePart, PoseState
from anser_ros.poses.registry import effect_with

Array = NDArray[np.float64]

GROUPS = 5  # groups of equal numbers of poses by distance, speed and orientation
HAND_EYE = effect_with(Role.MOUNT).name
LIMITS = 1.96  # standard deviations within which 95 % of normal differences lie


def pose_verdict(document: dict[str, Any]) -> str:
    """State in one paragraph what was found and what stays unexplained."""
    held, rest = document['held_out'], document['unexplained']
    found = [effect for effect in document['effects'] if effect['name'] != HAND_EYE]
    before, after = 1e3 * held['position_rmse_before_m'], 1e3 * held['position_rmse_after_m']
    if found:
        names = ', '.join(dict.fromkeys(str(effect['name']) for effect in found))
        text = f'Found: {names}. On held-out poses the error is '
        text += f'{before:.2f} mm without and {after:.2f} mm with their correction.'
    else:
        text = f'No effect is found: with hand-eye alone the held-out error is {after:.2f} mm.'
    if not document['knows_levers']:
        text += ' The motion hardly determines where the sensors sit on the body, so that no '
        text += 'effect of place or of a single sensor can be told: turn the body about two axes.'
    if document['left_out']:
        names = ', '.join(document['left_out'])
        text += f' Left out, with too few poses at times with a reference: {names}.'
    if rest['fraction'] > 0:
        on = ', '.join(rest['depends_on']) or 'none of the variables examined'
        text += f' {rest["fraction"]:.0%} of the squared error above the jitter stays'
        text += f' unexplained; it depends on {on}.'
        if 'distance' in rest['depends_on']:
            text += (
                ' It is larger far from the field generator, as at the edge of its volume or '
                'beside metal that is deep in it: work nearer to it.'
            )
    return text


def render_poses(found: PoseDiagnosis, document: dict[str, Any], session: str) -> str:
    """Return the page as HTML with its figures inside."""
    before, after = found.states
    return page(
        'Diagnosis of poses',
        top('Diagnosis of poses', pose_verdict(document), session=session),
        heading('What is wrong, and what to do'),
        _effects(document),
        heading(
            'Error before and after',
            'Distance between both trackers, root mean square. Every fifth stretch of time took '
            'no part in choosing or fitting; these are its errors (of eight or more recordings at '
            'rest each, by a fit of the others). Before is with the lever arm and mount of each '
            'sensor, after with what was found as well.',
        ),
        _by_sensor(document),
        picture(_groups(before, after)),
        heading('Over time'),
        picture(_over_time(before, after)),
        heading(
            'Agreement of both trackers (Bland and Altman)',
            'Difference of the two trackers after correction against their mean, by axis of the '
            'tracker. The middle line is the mean difference; 95% of differences lie between the '
            'others, the limits of agreement.',
        ),
        picture(_bland_altman(after)),
        _agreement(after),
        heading(
            'Frames',
            'Where the optical frame is in that of the tracker, and where each sensor is on the '
            'body; a dash is what the motion does not determine.',
        ),
        _frames(document),
        details(
            'What was tried and not named',
            paragraph(
                'The gain is by how much the squared error falls on blocks that took no part, in '
                'units of the noise.'
            ),
            table(
                ['candidate', 'why not'],
                [[short_label(row['candidate']), row['why']] for row in document['refused']],
            ),
        ),
    )


def short_label(label: str) -> str:
    """Return a candidate's label without the centre of its polynomial."""
    text = re.sub(r',? ?(centre_m \[[^]]*\]|(size_m|middle_s) [-+.\de]+)', '', label)
    return text.replace(' ()', '')


def _by_sensor(document: dict[str, Any]) -> Html:
    places = [f'position_rmse_{key}_m' for key in ('registration_only', 'before', 'after')]
    turns = [f'orientation_rmse_{key}_rad' for key in ('before', 'after')]
    return table(
        ['sensor', 'registration only, mm', 'with lever arm and mount, mm', 'with effects, mm',
         'with mount, deg', 'with effects, deg'],
        [
            [
                name, *(number(row[key], 1e3, '.2f') for key in places),
                *(number(row[key], DEGREES, '.2f') for key in turns),
            ]
            for name, row in document['sensors'].items()
        ],
    )  # fmt: skip


def _effects(document: dict[str, Any]) -> Html:
    rows = []
    for effect in document['effects']:
        if effect['name'] == HAND_EYE:
            continue
        evidence = effect['evidence']
        pair = [evidence.get(f'position_rmse_{when}_m') for when in ('without', 'with')]
        rows.append([
            effect['name'], str(evidence.get('summary') or ''),
            '\n'.join(sizes(effect['parameters'], effect['uncertainty'])),
            '' if pair == [None, None] else ' to '.join(number(v, 1e3, '.2f') for v in pair),
            str(evidence.get('advice') or ''),
        ])  # fmt: skip
    if not rows:
        return paragraph('Nothing was found.')
    head = ['name', 'what it is', 'how much, ± 1 sigma', 'takes the error from, mm', 'what to do']
    return table(head, rows)


def _frames(document: dict[str, Any]) -> Html:
    """The lever arm and mount of each sensor, and the registration, which all of them share."""
    rows, shared = [], []
    for effect in document['effects']:
        if effect['name'] == HAND_EYE:
            pair = effect['parameters'], effect['uncertainty']
            lever, mount, translation, rotation = (
                _triple(*pair, key, scale)
                for key, scale in (
                    ('lever_arm_m', 1e3), ('mount_rotation_deg', 1.0),
                    ('registration_translation_m', 1e3), ('registration_rotation_deg', 1.0),
                )
            )  # fmt: skip
            rows.append([effect['parameters']['sensor'], lever, mount])
            shared = [['optical frame', translation, rotation]] if translation else []
    head = ['', 'place x, y, z ± 1 sigma, mm', 'rotation vector ± 1 sigma, deg']
    return table(head, [*rows, *shared])


def _triple(values: dict[str, Any], sigma: dict[str, Any], key: str, scale: float) -> str:
    """Three numbers with their sigmas; nothing where there are none."""
    if values.get(key) is None:
        return ''
    return ', '.join(
        '-' if value is None else f'{scale * value:.2f} ± {scale * spread:.2f}'
        for value, spread in zip(values[key], sigma[key], strict=True)
    )


def _groups(before: PoseState, after: PoseState) -> Figure:
    """Errors by distance, speed and orientation, in groups of equal numbers of poses."""
    measures = {
        'distance from the field generator, mm': _distance,
        'speed, mm/s': _speed,
        'turn from the mean orientation, deg': _turn,
    }
    if not any(part.view.velocity.any() for part in after.parts):
        del measures['speed, mm/s']  # all is at rest
    figure, panels = plt.subplots(
        1, len(measures), figsize=(9, 3), layout='constrained', sharey=True
    )
    for panel, (label, measure) in zip(panels, measures.items(), strict=True):
        panel.set(xlabel=label)
        _bars(panel, before, measure, -0.2, {'color': BEFORE, 'label': 'before'})
        _bars(panel, after, measure, 0.2, {'color': AFTER, 'label': 'after'})
    panels[0].set_ylabel('error, mm')
    legend_below(figure, panels[0])
    return figure


def _bars(
    panel: Axes, state: PoseState, measure: Callable[[PosePart], Array], way: float,
    style: dict[str, Any],
) -> None:  # fmt: skip
    """The error of each group by a measure, beside its middle."""
    value = np.concatenate([measure(part)[part.used] for part in state.parts])
    square = np.concatenate([np.sum(p.residual[p.used, :3] ** 2, axis=1) for p in state.parts])
    if value.size < 2 * GROUPS:
        return
    edges = np.quantile(value, np.linspace(0, 1, GROUPS + 1))
    group = np.clip(np.searchsorted(edges, value, side='right') - 1, 0, GROUPS - 1)
    found = np.unique(group)
    error = [1e3 * float(np.sqrt(np.mean(square[group == k]))) for k in found]
    bars = panel.bar(found + way, error, 0.4, **style)
    panel.bar_label(bars, [f'{v:.2g}' if v < 10 else f'{v:.0f}' for v in error], fontsize=6)
    digits = 0 if np.ptp(edges) > 10 * GROUPS else 1
    names = [f'{a:.{digits}f} to\n{b:.{digits}f}' for a, b in pairwise(edges)]
    panel.set_xticks(range(GROUPS), names, fontsize=7)


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
    spell_out(axes.yaxis)
    legend_below(figure, axes, markers=4.0)
    return figure


def _differences(state: PoseState, axis: int) -> Array:
    return 1e3 * np.concatenate([part.residual[part.used, axis] for part in state.parts])


def _limits(values: Array) -> tuple[float, float, float]:
    """The mean difference between the lower and the upper limit of agreement."""
    middle, spread = float(values.mean()), LIMITS * float(values.std())
    return middle - spread, middle, middle + spread


def _agreement(state: PoseState) -> Html:
    rows = [
        [name, *(f'{value:.2f}' for value in _limits(_differences(state, axis)))]
        for axis, name in enumerate('xyz')
    ]
    return table(['axis', 'lower limit, mm', 'mean difference, mm', 'upper limit, mm'], rows)


def _bland_altman(state: PoseState) -> Figure:
    figure, panels = plt.subplots(1, 3, figsize=(9, 3), layout='constrained', sharey=True)
    for axis, (panel, name) in enumerate(zip(panels, 'xyz', strict=True)):
        for part in state.parts:
            difference = 1e3 * part.residual[part.used, axis]
            mean = 1e3 * part.view.position[part.used, axis] + 0.5 * difference
            panel.plot(mean, difference, '.', ms=2, label=part.view.sensor)
        for line in _limits(_differences(state, axis)):
            panel.axhline(line, color='0.4', lw=0.8)
        panel.set(xlabel=f'mean of both, {name}, mm')
        panel.locator_params(axis='x', nbins=5)
    panels[0].set_ylabel('tracked minus optical, mm')
    legend_below(figure, panels[0], markers=4.0)
    return figure
