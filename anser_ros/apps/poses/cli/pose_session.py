"""Takes sessions of trackers that give poses only: options, diagnosis, evaluation and report."""

import argparse
import csv
import math
import re
from collections.abc import Callable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import yaml
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from anser_ros.apps.poses.corrector import to_document, to_model
from anser_ros.apps.poses.diagnosis import PoseDiagnosis, diagnose_poses
from anser_ros.apps.poses.effect import Role, effect_with
from anser_ros.apps.poses.importing import read_pose_session
from anser_ros.apps.poses.problem import PosePart, PoseState
from anser_ros.apps.poses.sequence import PoseSession
from anser_ros.arrays import Array
from anser_ros.cli.diagnosis_words import short_ones, value_text
from anser_ros.cli.output import (
    Result,
    Tell,
    add_list,
    loss_notes,
    make_folder,
    number,
    terminal_table,
    write_files,
)
from anser_ros.cli.page import (
    AFTER,
    BEFORE,
    Html,
    details,
    heading,
    legend_below,
    page,
    paragraph,
    picture,
    spell_out,
    table,
    top,
)
from anser_ros.errors import ParameterError
from anser_ros.physics.constants import DEGREES
from anser_ros.sessions.tracked_session import error_statistics

UNSHOWN = ('centre_m', 'size_m', 'lowest', 'middle_s', 'degree', 'strain')
"""Parameters that tell how a map or a course is written, and not what it does."""
SCALES = {'s': (1e3, 'ms'), 'm': (1e3, 'mm'), 'rad': (180 / math.pi, 'deg'), 'deg': (1.0, 'deg'),
          'ppm': (1.0, 'ppm')}  # fmt: skip
"""By the unit at the end of a parameter's name: the factor to the one that is shown, and that."""
TIMES = ('t_start', 't_end', 'since')  # times of a session, which stay in s
MOST_DECIMALS = 4


def sizes(parameters: Mapping[str, Any], sigmas: Mapping[str, Any]) -> list[str]:
    """Return a line for each parameter that fits one, with its standard deviation."""
    by_time = 'rms_s' in parameters
    return [
        _line(key, value, sigmas.get(key), by_time)
        for key, value in short_ones(dict(parameters))
        if key not in UNSHOWN and value not in (None, [], {})
    ]


def _line(key: str, value: Any, sigma: Any, by_time: bool) -> str:
    if isinstance(value, dict):
        factor, unit = SCALES['s'] if by_time else (1.0, '')
        each = [
            f'{name}\xa0{_number(factor * one if isinstance(one, float) else one, None)}'
            for name, one in value.items()
        ]
        return f'{_name(key)}: {", ".join(each)} {unit}'.rstrip()
    name, _, unit = key.rpartition('_')
    if not isinstance(value, float):
        return f'{_name(key)}: {value_text(value)}'
    if key == 'fraction':
        return f'share: {_number(100 * value, None)} %'
    if name in TIMES:
        return f'{_name(name)}: {value:.1f} s'
    factor, shown = SCALES.get(unit, (1.0, '')) if name else (1.0, '')
    spread = factor * sigma if isinstance(sigma, float) else None
    text = _number(factor * value, spread)
    if spread is not None:
        text += f'\xa0±\xa0{_number(spread, spread)}'
    return f'{_name(name if shown else key)}: {text} {shown}'.rstrip()


def _name(key: str) -> str:
    return key.removeprefix('t_').replace('_', ' ')


def _number(value: float, sigma: float | None) -> str:
    """A number with as many decimals as its standard deviation has two digits, or three digits."""
    if isinstance(value, int):
        return str(value)
    size = sigma if sigma else abs(value) / 10
    if not math.isfinite(size) or size <= 0:
        return f'{value:.3g}'
    decimals = 1 - math.floor(math.log10(size))
    return f'{value:.{min(max(decimals, 0), MOST_DECIMALS)}f}'


GROUPS = 5  # groups of equal numbers of poses by distance, speed and orientation
LIMITS = 1.96  # standard deviations within which 95 % of normal differences lie


def _parted(document: dict[str, Any]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """The frames of each sensor, which are no effects, and what was found."""
    name, effects = effect_with(Role.MOUNT).name, document['effects']
    return [e for e in effects if e['name'] == name], [e for e in effects if e['name'] != name]


def pose_verdict(document: dict[str, Any]) -> str:
    """State in one paragraph what was found and what stays unexplained."""
    held, rest = document['held_out'], document['unexplained']
    _, found = _parted(document)
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
    for effect in _parted(document)[1]:
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
    for effect in _parted(document)[0]:
        lever, mount, translation, rotation = (
            _triple(effect['parameters'], effect['uncertainty'], key, scale)
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
    measures: dict[str, Callable[[PosePart], Array]] = {
        'distance from the field generator, mm': lambda p: _size(1e3 * p.view.measured),
        'speed, mm/s': lambda p: _size(1e3 * p.view.velocity[:, :3]),
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


def _size(vectors: Array) -> Array:
    return np.asarray(np.linalg.norm(vectors, axis=1))


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


OPTIONS = {'tracked': 'topics', 'optical': 'optical'}  # of this kind of session alone


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options of a session of poses."""
    add_topic_options(parser, 'sensor', 'with --poses: ')


def add_topic_options(parser: argparse.ArgumentParser, what: str, when: str = '') -> None:
    """Declare the options that name topics of poses in a bag."""
    add_list(
        parser, '--tracked', metavar='NAME=TOPIC', dest='topics',
        help=f'{when}a tracked {what} and its topic, by default all /tracked/<sensor>/pose',
    )  # fmt: skip
    parser.add_argument(
        '--optical', metavar='TOPIC',
        help=f'{when}topic of the reference, by default the only /optical/<body>/pose',
    )  # fmt: skip


def load_poses(path: Path | str, args: argparse.Namespace) -> PoseSession:
    """Load the session that the options name."""
    topics = {}
    for text in args.topics:
        name, _, topic = text.partition('=')
        if not name or not topic:
            raise ParameterError(f'--tracked takes NAME=TOPIC, got {text!r}')
        topics[name] = topic
    return read_pose_session(path, topics or None, args.optical)


def diagnose(args: argparse.Namespace, tell: Tell) -> Result:
    """Diagnose a session of poses into the folder of the arguments."""
    found, document = _found(args, tell)
    written = write_files(
        args.out,
        {
            'diagnosis.json': document,
            'model.yaml': yaml.safe_dump(to_model(found), sort_keys=False),
            'report.html': render_poses(found, document, str(args.session)),
        },
    )
    return _result(args, found, document, document, written)


def evaluate(args: argparse.Namespace, tell: Tell) -> Result:
    """Report the errors of a session of poses, into the folder of the arguments."""
    found, diagnosis = _found(args, tell)
    document = _evaluation(found, diagnosis)
    written = write_files(args.out, {'evaluation.json': document})
    _write_poses(args.out / 'poses.csv', found)
    return _result(args, found, document, diagnosis, (*written, args.out / 'poses.csv'))


def _found(args: argparse.Namespace, tell: Tell) -> tuple[PoseDiagnosis, dict[str, Any]]:
    session = load_poses(args.session, args)
    make_folder(args.out)
    found = diagnose_poses(session, tell)
    return found, to_document(found)


def _result(
    args: argparse.Namespace, found: PoseDiagnosis, document: dict[str, Any],
    diagnosis: dict[str, Any], written: tuple[Path, ...],
) -> Result:  # fmt: skip
    rows = [
        [
            name,
            *(number(row[f'position_rmse_{key}_m'], 1e3, '.2f')
              for key in ('registration_only', 'before', 'after')),
            number(row['orientation_rmse_after_rad'], DEGREES, '.2f'),
        ]
        for name, row in diagnosis['sensors'].items()
    ]  # fmt: skip
    head = ['sensor', 'registration mm', 'hand-eye mm', 'effects mm', 'effects deg']
    shown = terminal_table(head, rows), pose_verdict(diagnosis)
    return Result(document, loss_notes(args.session, found.session.lost), shown, written)


def _evaluation(found: PoseDiagnosis, document: dict[str, Any]) -> dict[str, Any]:
    """The errors of every sensor with the frames and effects that were found."""
    sensors: dict[str, Any] = {}
    for part in found.fit.state.parts:
        poses, residual = found.session.sensors[part.view.sensor], part.residual[part.used]
        sensors[part.view.sensor] = {
            'n': len(residual),
            'tracked_fraction': poses.size / max(poses.size + poses.missing.size, 1),
            **error_statistics('position', 'm', np.linalg.norm(residual[:, :3], axis=1)),
            **error_statistics('orientation', 'rad', np.linalg.norm(residual[:, 3:], axis=1)),
        }
    return {
        'schema': 'anser_evaluation/1', 'sensors': sensors, 'bodies': {},
        'held_out': document['held_out'],
    }  # fmt: skip


def _write_poses(path: Path, found: PoseDiagnosis) -> None:
    """Write the corrected poses in the optical body's prediction frame, a row each."""
    with path.open('w', encoding='utf-8', newline='') as stream:
        writer = csv.writer(stream)
        writer.writerow(['stamp_ns', 'sensor', 'x_m', 'y_m', 'z_m', 'distance_m', 'angle_rad',
                         'status'])  # fmt: skip
        for part in found.fit.state.parts:
            stamps = found.session.start_ns + np.round(1e9 * part.view.time).astype(np.int64)
            place = part.view.position + part.residual[:, :3]
            for k, stamp in enumerate(stamps.tolist()):
                size = [np.linalg.norm(half) for half in np.split(part.residual[k], 2)]
                status = 'ok' if part.used[k] else 'outlier_or_no_reference'
                values = [f'{v:.9g}' for v in (*place[k], *size)]
                writer.writerow([stamp, part.view.sensor, *values, status])
