"""Takes sessions of trackers that give poses only: options, diagnosis, evaluation and report."""

import argparse
import csv
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import yaml
from matplotlib.figure import Figure
from rich.table import Table

from anser_ros.apps.poses.corrector import MODEL_SCHEMA, corrected, to_document, to_model
from anser_ros.apps.poses.diagnosis import PoseDiagnosis, diagnose_poses
from anser_ros.apps.poses.effect import Role, effect_with
from anser_ros.apps.poses.importing import read_pose_session
from anser_ros.apps.poses.problem import PoseState, predicted
from anser_ros.apps.poses.sequence import PoseSession
from anser_ros.arrays import Array
from anser_ros.cli import output
from anser_ros.cli.diagnosis_words import short_ones, value_text
from anser_ros.cli.page import (
    AFTER,
    BEFORE,
    Html,
    details,
    heading,
    legend_beside,
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
from anser_ros.tracking.estimate import TrackerSettings
from anser_ros.wire.text_files import read_document

UNUSED = ('refit', 'baseline', 'references', 'witnesses', 'in_phase', 'resurveyed', 'stated')
"""Options of other sessions."""
UNSHOWN = ('centre_m', 'size_m', 'lowest', 'is_equal', 'middle_s', 'degree', 'strain', 'times_s',
           'recordings', 'told_share')  # fmt: skip
"""Parameters that tell how a map or a course is written, and what has lines of its own."""
SCALES = {'s': (1e3, 'ms'), 'm': (1e3, 'mm'), 'rad': (180 / math.pi, 'deg'), 'deg': (1.0, 'deg'),
          'ppm': (1.0, 'ppm')}  # fmt: skip
"""By the unit at the end of a parameter's name: the factor to the one that is shown, and that."""
TIMES = ('t_start', 't_end', 'since')  # times of a session, which stay in s
MOST_DECIMALS = 4


def sizes(parameters: Mapping[str, Any], sigmas: Mapping[str, Any]) -> list[str]:
    """Return a line for each parameter that fits one, with its standard deviation."""
    by_time = 'rms_s' in parameters
    return [
        *(
            _line(key, value, sigmas.get(key), by_time)
            for key, value in short_ones(dict(parameters))
            if key not in UNSHOWN and value not in (None, [], {})
        ),
        *_times(parameters.get('times_s', {}), parameters.get('recordings', {})),
    ]


def _times(
    times: Mapping[str, Sequence[float]], numbers: Mapping[str, Sequence[int]]
) -> list[str]:
    """A line for the times of each stream, with the numbers of recordings where there are many."""
    return [
        f'{name} at ' + ', '.join(
            f'{time:.2f}' + (f' (recording {numbers[name][k]})' if numbers else '')
            for k, time in enumerate(every)
        ) + ' s'
        for name, every in times.items() if every
    ]  # fmt: skip


def _line(key: str, value: Any, sigma: Any, by_time: bool) -> str:
    if isinstance(value, dict):
        factor, unit = SCALES['s'] if by_time else (1.0, '')
        each = [
            f'{name}\xa0{_number(factor * one if isinstance(one, float) else one, None)}'
            for name, one in value.items()
        ]
        return f'{_name(key)}: {", ".join(each)} {unit}'.rstrip()
    name, _, unit = key.rpartition('_')
    if key == 'quaternion':
        return f'quaternion: {ORDERS.get(value, value)}'
    if key == 'spans':
        return f'spans: {", ".join(f"{a:.1f} to {b:.1f}" for a, b in value)} s'
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
    """A number with the decimals of its standard deviation, of one digit (two from a 1), or with
    three digits.
    """
    if isinstance(value, int):
        return str(value)
    size = sigma if sigma else abs(value) / 10
    if not math.isfinite(size) or size <= 0:
        return f'{value:.3g}'
    digits = 1 + (not sigma or f'{sigma:e}'.startswith('1'))
    decimals = digits - 1 - math.floor(math.log10(size))
    return f'{value:.{min(max(decimals, 0), MOST_DECIMALS)}f}'


FAR, WHEN = 'from the field generator, mm', ('before', 'after')
SLICES, CELLS = 3, 8  # groups by distance or depth; cells of arrows along the longest side
FEWEST, FEWEST_IN_CELL = 5, 2  # poses of which a group, and an arrow, is the mean
ORDERS = {
    'xyzw': 'scalar last, as stated', 'wxyz': 'scalar first', 'conjugate': 'of the inverse turn',
    'wxyz_conjugate': 'scalar first, of the inverse turn',
}  # fmt: skip
"""Orders and senses of quaternions, as a file has them."""
LIMITS = 1.96  # standard deviations within which 95 % of normal differences lie


def _parted(document: dict[str, Any]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """The frames of each sensor, which are no effects, and what was found."""
    name, effects = effect_with(Role.MOUNT).name, document['effects']
    return [e for e in effects if e['name'] == name], [e for e in effects if e['name'] != name]


def pose_verdict(document: dict[str, Any]) -> str:
    """State in one paragraph what was found and what stays unexplained."""
    held, rest = document['held_out'], document['unexplained']
    _, found = _parted(document)
    before, after, outside = (
        output.number(held[f'position_rmse_{key}_m'], 1e3, '.2f')
        for key in ('before', 'after', 'outside_episodes')
    )
    if found:
        names = ', '.join(dict.fromkeys(str(effect['name']) for effect in found))
        text = f'Found: {names}. On held-out poses the error is {before} mm'
        text += f', and {after} mm corrected' if before != after else ''
        text += f', {outside} mm outside the episodes.' if outside != after else '.'
    else:
        text = f'No effect is found: with hand-eye alone the held-out error is {after} mm.'
    if not document['knows_levers']:
        text += ' The motion hardly determines where the sensors sit on the body, so that no '
        text += 'effect of place or of a single sensor can be told: turn the body about two axes.'
    if document['left_out']:
        names = ', '.join(document['left_out'])
        text += f' Left out, with too few poses at times with a reference: {names}.'
    if round(rest['fraction'], 2) > 0:
        on = ', '.join(rest['depends_on']) or 'none of the variables examined'
        share = f'{rest["fraction"]:.0%} of the squared error above the jitter stays unexplained'
        words = share if before != after else 'The error above the jitter is not corrected'
        text += f' {words}; it depends on {on}.'
        if 'distance' in rest['depends_on']:
            text += (
                ' It is larger far from the field generator, as at the edge of its volume or '
                'beside metal that is deep in it: see what is there.'
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
        table(
            ['sensor', 'registration only, mm', 'with lever arm and mount, mm',
             'with effects, mm', 'with mount, deg', 'with effects, deg'],
            _by_sensor(document, ['registration_only', *WHEN], WHEN, '.2f'),
        ),
        _by_distance(before, after),
        heading(
            'Noise of each sensor, to compare with a data sheet',
            'Root mean square of a coordinate, between neighbouring poses: what stays when '
            'clocks, frames and maps are right, and what the reference adds.',
        ),
        _noise(document['noise']),
        heading(
            'Where space is bent',
            'Mean held-out errors in the plane of the field generator at three depths.',
        ),
        picture(_arrows(before, after)),
        heading('Over time'),
        picture(over_time({'before': (before, BEFORE), 'after': (after, AFTER)})),
        heading(
            'Agreement of both trackers (Bland and Altman)',
            'Difference of the two trackers after correction, by axis of the tracker; 95% of '
            'differences lie between the limits.',
        ),
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
    )  # fmt: skip


def short_label(label: str) -> str:
    """Return a candidate's label without the centre of its polynomial."""
    text = re.sub(r',? ?(centre_m \[[^]]*\]|(size_m|middle_s) [-+.\de]+)', '', label)
    return text.replace(' ()', '')


def _by_sensor(
    document: dict[str, Any], places: Sequence[str], turns: Sequence[str], form: str
) -> list[list[str]]:
    columns = [(f'position_rmse_{key}_m', 1e3) for key in places]
    columns += [(f'orientation_rmse_{key}_rad', DEGREES) for key in turns]
    return [
        [name, *(output.number(row[key], scale, form) for key, scale in columns)]
        for name, row in document['sensors'].items()
    ]


def _effects(document: dict[str, Any]) -> Html:
    rows = []
    for effect in _parted(document)[1]:
        evidence = effect['evidence']
        pair = [evidence.get(f'position_rmse_{when}_m') for when in ('without', 'with')]
        rows.append([
            effect['name'], str(evidence.get('summary') or ''),
            '\n'.join(sizes(effect['parameters'], effect['uncertainty'])),
            '' if pair == [None, None]
            else ' to '.join(output.number(v, 1e3, '.2f') for v in pair),
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
    pairs = [
        None if value is None else (scale * value, scale * spread)
        for value, spread in zip(values[key], sigma[key], strict=True)
    ]
    return ', '.join(
        '-' if pair is None else f'{_number(*pair)} ± {_number(pair[1], pair[1])}'
        for pair in pairs
    )


def _by_distance(before: PoseState, after: PoseState) -> Html:
    """Held-out errors by distance."""
    rows = []
    for parts in zip(before.parts, after.parts, strict=True):
        distance = _size(1e3 * parts[0].view.measured)
        for low, high in pairwise(np.quantile(distance, np.linspace(0, 1, 1 + SLICES))):
            near = (low <= distance) & (distance <= high)
            squares = [np.sum(p.residual[p.used & near, :3] ** 2, axis=1) for p in parts]
            sizes = [np.sqrt(one.mean()) if one.size > FEWEST else None for one in squares]
            rows.append([parts[0].view.sensor, f'{low:.0f} to {high:.0f}',
                         *(output.number(size, 1e3, '.2f') for size in sizes)])  # fmt: skip
    return table(['sensor', FAR, 'error before, mm', 'error after, mm'], rows)


def _noise(noise: Sequence[Mapping[str, Any]]) -> Html:
    speed = 1e3 * noise[0]['speed_m_s']
    slow, fast = (f'{way} than {speed:.0f} mm/s, mm' for way in ('slower', 'faster'))
    head = ['sensor', FAR, slow if speed else 'at rest, mm', fast, 'rotation, deg']
    keys = (('slow_m', 1e3), ('fast_m', 1e3), ('turn_rad', DEGREES))
    return table(head, [
        [row['sensor'], f'{1e3 * row["from_m"]:.0f} to {1e3 * row["to_m"]:.0f}',
         *(output.number(row[key], scale, '.3f') for key, scale in keys)]
        for row in noise
    ])  # fmt: skip


def _arrows(before: PoseState, after: PoseState) -> Figure:
    """Mean errors in cells of three slices of space, those of x and y as arrows."""
    figure, panels = plt.subplots(
        2, SLICES, figsize=(9, 6), layout='constrained', sharex=True, sharey=True
    )
    every = 1e3 * np.concatenate([p.view.measured[p.used] for p in before.parts])
    if not len(every):
        return figure
    low, high = np.percentile(every, [1, 99], axis=0)
    cell = max(float(np.max(high - low)) / CELLS, 1e-3)
    levels, longest = np.quantile(every[:, 2], np.linspace(0, 1, 1 + SLICES)), 0.0
    for row, (state, colour, label) in enumerate(
        ((before, BEFORE, 'before'), (after, AFTER, 'after'))
    ):
        place = 1e3 * np.concatenate([p.view.measured[p.used] for p in state.parts])
        error = 1e3 * np.concatenate([p.residual[p.used, :3] for p in state.parts])
        slices = np.digitize(place[:, 2], levels[1:-1])
        code = np.column_stack([slices, np.floor(place[:, :2] / cell)])
        _, index, count = np.unique(code, axis=0, return_inverse=True, return_counts=True)
        sums = np.zeros((count.size, 5))
        np.add.at(sums, index.ravel(), np.column_stack([slices, place[:, :2], error[:, :2]]))
        means = sums[count >= FEWEST_IN_CELL] / count[count >= FEWEST_IN_CELL, None]
        longest = longest or max(float(np.max(_size(means[:, 3:]), initial=0.0)), 1e-3)
        for k, panel in enumerate(panels[row]):
            x, y, u, v = means[means[:, 0].round() == k, 1:].T
            arrows = panel.quiver(x, y, u, v, color=colour, angles='xy', scale_units='xy',
                                  scale=longest / cell)  # fmt: skip
            panel.set_title(f'{label}, z {levels[k]:.0f} to {levels[k + 1]:.0f} mm', fontsize=8)
            panel.set(aspect='equal', xlim=(low[0] - cell, high[0] + cell),
                      ylim=(low[1] - cell, high[1] + cell))  # fmt: skip
    panels[0, 0].quiverkey(arrows, 0.15, 0.02, longest, f'{longest:.2g} mm', labelpos='E',
                           coordinates='figure')  # fmt: skip
    figure.supxlabel('x, mm')
    figure.supylabel('y, mm')
    return figure


def _size(vectors: Array) -> Array:
    return np.asarray(np.linalg.norm(vectors, axis=1))


def over_time(states: Mapping[str, tuple[PoseState, str]]) -> Figure:
    """Return distances of poses over time, of states by their label, each in a colour."""
    figure, axes = plt.subplots(figsize=(9, 3), layout='constrained')
    for label, (state, colour) in states.items():
        for k, part in enumerate(state.parts):
            size = 1e3 * np.linalg.norm(part.residual[part.used, :3], axis=1)
            axes.plot(part.view.time[part.used], size, '.', ms=2, color=colour,
                      label=label if k == 0 else None)  # fmt: skip
    axes.set(xlabel='time, s', ylabel='distance, mm', yscale='log')
    spell_out(axes.yaxis)
    legend_beside(figure, below=4.0)
    return figure


def _agreement(state: PoseState) -> Html:
    rows = []
    for axis, name in enumerate('xyz'):
        values = 1e3 * np.concatenate([part.residual[part.used, axis] for part in state.parts])
        middle, spread = float(values.mean()), LIMITS * float(values.std())
        rows.append([name, *(f'{middle + way * spread:.2f}' for way in (-1, 0, 1))])
    return table(['axis', 'lower limit, mm', 'mean difference, mm', 'upper limit, mm'], rows)


OPTIONS = {'tracked': 'topics', 'optical': 'optical'}  # of this kind of session alone


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the options of a session of poses."""
    add_topic_options(parser, 'sensor', 'with --poses: ')


def add_topic_options(parser: argparse.ArgumentParser, what: str, when: str = '') -> None:
    """Declare the options that name topics of poses in a bag."""
    output.add_list(
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


def diagnose(args: argparse.Namespace, tell: output.Tell) -> output.Result:
    """Diagnose a session of poses, corrected by a model if one is given, into the folder."""
    session, model = _session(args, ('baseline',))
    baseline = load_poses(args.baseline, args) if args.baseline else None
    output.make_folder(args.out)
    if model:
        session = corrected(session, model)
        baseline = baseline and corrected(baseline, model)
    found = diagnose_poses(session, tell, baseline)
    document = to_document(found)
    written = output.write_files(
        args.out,
        {
            'diagnosis.json': document,
            'model.yaml': yaml.safe_dump(to_model(found, model), sort_keys=False),
            'report.html': render_poses(found, document, str(args.session)),
        },
    )
    head = ['with lever arms, mm', 'corrected, mm', 'corrected, deg']
    shown = _by_sensor_text(document, head), pose_verdict(document)
    return output.Result(document, output.loss_notes(session), shown, written)


def evaluate(args: argparse.Namespace, tell: output.Tell) -> output.Result:
    """Report the errors of a session of poses, before and after a model's correction if one is
    given, into the folder of the arguments; nothing is searched for.
    """
    session, model = _session(args, ())
    output.make_folder(args.out)
    first = found = diagnose_poses(session, tell, is_searched=False)
    if model:
        session = corrected(session, model)
        found = diagnose_poses(session, tell, is_searched=False)
    states = first.states[0], found.states[0]
    found = replace(found, registered=first.registered, states=states)
    diagnosis = to_document(found)
    document = _evaluation(found, diagnosis)
    written = output.write_files(args.out, {'evaluation.json': document})
    _write_poses(args.out / 'poses.csv', found)
    head, words = (
        ['with lever arms, mm', '', 'deg'],
        'Nothing was searched for; diagnose names causes.',
    )
    if model:
        head = ['before, mm', 'after, mm', 'after, deg']
        sizes = [f'{1e3 * one.position_m:.2f} mm' for one in (found.before, found.after)]
        words = f'Held out, the error is {sizes[0]} before and {sizes[1]} after the model.'
        if found.after.position_m > found.before.position_m:
            words += ' It makes this session worse: use it where it was learnt, or not at all.'
    return output.Result(
        document, output.loss_notes(session),
        (_by_sensor_text(diagnosis, head), words), (*written, args.out / 'poses.csv'),
    )  # fmt: skip


def _session(
    args: argparse.Namespace, used: Sequence[str]
) -> tuple[PoseSession, dict[str, Any] | None]:
    """The session and the model that the options name.

    Raises `ParameterError` when an option is given that a session of poses has no use for.
    """
    idle = [name for name in UNUSED if name not in used and getattr(args, name, None)]
    if getattr(args, 'gate', TrackerSettings().gate) != TrackerSettings().gate:
        idle.append('gate')
    if idle:
        names = ', '.join('--' + name.replace('stated', 'set').replace('_', '-') for name in idle)
        raise ParameterError(f'without effect on a session of poses, leave out: {names}')
    model = read_document(args.model, MODEL_SCHEMA) if args.model else None
    return load_poses(args.session, args), model


def _by_sensor_text(diagnosis: dict[str, Any], head: Sequence[str]) -> Table:
    """Held-out errors of each sensor; a figure without a name in the head is left out."""
    when = [key for key, name in zip(WHEN, head, strict=False) if name]
    rows = _by_sensor(diagnosis, ['registration_only', *when], ['after'], '.3f')
    return output.terminal_table(['sensor', 'registered, mm', *filter(None, head)], rows)


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
    """Write all poses as they are corrected, tracker's frame, a row each."""
    state = found.fit.state
    with path.open('w', encoding='utf-8', newline='') as stream:
        writer = csv.writer(stream)
        writer.writerow(['stamp_ns', 'sensor', 'x_m', 'y_m', 'z_m', 'qx', 'qy', 'qz', 'qw',
                         'distance_m', 'angle_rad', 'status'])  # fmt: skip
        for name in state.problem.setting.sensors:
            poses = found.session.sensors[name]
            view, residual, known = predicted(state.problem.path, poses, state.terms)
            sizes = [_size(half)[:, None] for half in np.hsplit(residual, 2)]
            rows = [view.position + residual[:, :3], poses.quaternion, *sizes]
            stamps = found.session.start_ns + np.round(1e9 * poses.time).astype(np.int64)
            for stamp, row, is_known in zip(stamps.tolist(), np.hstack(rows), known, strict=True):
                values = [f'{value:.9g}' for value in row]
                writer.writerow([stamp, name, *values, 'ok' if is_known else 'no_reference'])
