"""Assess a tracker by the protocols that the field publishes, and watch it over sessions."""

import argparse
from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from anser_ros.apps.poses.assessment.distances import ORDERS, RING_STEP_DEG, SPACING_M, ErrorGroup
from anser_ros.apps.poses.assessment.history import (
    ALERT,
    FAIL,
    FEWEST_SESSIONS,
    NOTE,
    PASS,
    EarlierFigure,
    SessionVerdict,
    Verdict,
    figures_of,
    judge,
    keep,
)
from anser_ros.apps.poses.assessment.intervals import IntervalEstimate, mitk_statistics
from anser_ros.apps.poses.assessment.protocols import (
    PROTOCOLS,
    Assessment,
    ProtocolOptions,
    assess,
)
from anser_ros.apps.poses.assessment.rest import PauseRule
from anser_ros.apps.poses.assessment.source import read_poses
from anser_ros.apps.poses.cli.pose_source import add_source_options, source_of
from anser_ros.apps.poses.corrector import as_document
from anser_ros.apps.poses.sequence import missing_words
from anser_ros.cli import output
from anser_ros.cli.page import heading, legend_beside, page, paragraph, picture, table, top
from anser_ros.errors import ParameterError
from anser_ros.physics.constants import DEGREES
from anser_ros.wire.tables import read_table

SEED = 1
"""Seed of the resamples, so that the same recordings give the same intervals."""
NO_DATE_NS = 10**18
"""Stamp, ns, before which a recording does not say when it was made: it would be of 2001."""
OPTICAL_TRUTH = 'optical'
COLORS = {'pass': 'green', 'note': 'yellow', 'alert': 'magenta', 'fail': 'red'}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    lines = '\n'.join(f'  {name:<15} {words}' for name, words in PROTOCOLS.items())
    parser.epilog = (
        f'protocols:\n{lines}\n\n'
        'example: anser accuracy dynamic bags/moving.mcap --model config/demo_model.yaml '
        '--out result/;\n'
        'with a recording of a board: '
        'anser accuracy grid board.mcap --topic /anser/pen/tip/pose --out result/;\n'
        'every day: anser accuracy rest daily.mcap --history qa/ '
        '--limit position_jitter_rms_m=5e-4'
    )
    parser.add_argument('protocol', choices=list(PROTOCOLS), help='what was recorded, see below')
    parser.add_argument(
        'recordings', nargs='+', type=Path,
        help='bag or file of poses; several files: one per point (grid, rotation, point-to-point)',
    )  # fmt: skip
    add_source_options(parser)
    parser.add_argument('--optical', metavar='TOPIC', help='topic of the reference')
    parser.add_argument(
        '--pause-s', type=float, default=PauseRule().least_s,
        help=f'shortest pause that counts as a point, s ({PauseRule().least_s:g})',
    )  # fmt: skip
    parser.add_argument('--grid', metavar='RxC', help='rows and columns of a board of your own')
    words = 'spacing of the holes of the board, mm (50)'
    parser.add_argument('--spacing-mm', type=float, default=1e3 * SPACING_M, help=words)
    words = 'rows: all in one direction; serpentine: every other one backwards'
    parser.add_argument('--order', choices=ORDERS, default=ORDERS[0], help=words)
    words = 'step of the holes of the ring, degrees (11.25)'
    parser.add_argument('--step-deg', type=float, default=RING_STEP_DEG, help=words)
    words = 'for a sensor without roll: the direction whose rotation is evaluated'
    parser.add_argument('--axis', metavar='X,Y,Z', help=words)
    parser.add_argument(
        '--truth', default=OPTICAL_TRUTH, metavar='FILE',
        help="CSV of the phantom's points in order (x_m,y_m,z_m or x_mm,y_mm,z_mm); without it "
        'the optical reference',
    )  # fmt: skip
    parser.add_argument(
        '--history', type=Path, metavar='DIR',
        help='judge by the earlier sessions in this folder (pass, note, alert, fail), and keep '
        'this one there',
    )  # fmt: skip
    words = 'largest size of a figure, beyond which the session fails'
    output.add_list(parser, '--limit', metavar='FIGURE=VALUE', help=words)
    output.add_out(parser, 'accuracy.json and report.html', required=False)
    output.add_json(parser, 'accuracy.json on stdout')


def work(args: argparse.Namespace, tell: output.Tell) -> output.Result:
    """Assess the recordings of the arguments, and judge them where that is wanted."""
    options, tolerances = _options(args), _tolerances(args.limit)
    output.make_folder(args.out)
    output.make_folder(args.history)
    wanted = source_of(args)
    recordings = []
    for k, path in enumerate(args.recordings):
        tell('reading', k / len(args.recordings))
        recordings.append(read_poses(path, wanted))
    tell(args.protocol, 0.5)
    found = assess(args.protocol, recordings, options, np.random.default_rng(SEED))
    missing = tuple(filter(None, (missing_words(one.poses) for one in recordings)))
    found = replace(found, notes=(*found.notes, *missing))
    if found.start_ns < NO_DATE_NS:  # a device's own counter: the file says when
        found = replace(found, start_ns=args.recordings[0].stat().st_mtime_ns)
    is_judged = args.history is not None or bool(tolerances)
    verdict = judge(found, args.history, tolerances) if is_judged else None
    document = to_document(found, verdict)
    report = render(found, document, verdict) if args.out else None
    written = output.write_files(args.out, {'accuracy.json': document, 'report.html': report})
    if verdict is not None and args.history is not None:
        written = (*written, keep(found, args.history, verdict.figures))
    notes = output.loss_notes(*(one.session for one in recordings))
    return output.Result(document, notes, _shown(found, document), written)


def _shown(found: Assessment, document: dict[str, Any]) -> tuple[Any, ...]:
    qa = document.get('qa')
    rows = figure_rows(found, document)
    head = ['figure', 'value', '95 % interval', 'state']
    for row in rows:
        row[-1] = f'[{COLORS.get(row[-1], "white")}]{row[-1]}[/]'
    if not qa:
        head, rows = head[:-1], [row[:-1] for row in rows]
    points = [f'{len(found.points)} points'] if found.points else []
    return (
        output.terminal_table(head, rows),
        *points,
        *found.notes,
        *([qa_words(qa)] if qa else []),
    )


def _options(args: argparse.Namespace) -> ProtocolOptions:
    for name in ('pause_s', 'spacing_mm', 'step_deg'):
        if not (np.isfinite(getattr(args, name)) and getattr(args, name) > 0):
            raise ParameterError(f'--{name.replace("_", "-")} must be positive')
    grid = None
    if args.grid:
        parts = args.grid.lower().split('x')
        if len(parts) != 2 or not all(p.isdigit() and int(p) > 0 for p in parts):
            raise ParameterError(f'--grid takes ROWSxCOLUMNS such as 9x10, got {args.grid!r}')
        grid = int(parts[0]), int(parts[1])
    axis = None
    if args.axis:
        try:
            axis = np.array([float(v) for v in args.axis.split(',')])
        except ValueError as error:
            raise ParameterError(f'--axis takes three numbers, got {args.axis!r}') from error
        if axis.shape != (3,) or not np.linalg.norm(axis) > 0:
            raise ParameterError(f'--axis takes three numbers, got {args.axis!r}')
    truth = None
    if args.truth != OPTICAL_TRUTH and args.protocol == 'point-to-point':
        truth = read_table(args.truth).positions()
    rule = PauseRule()
    # Points of a narrow board, or of a fine ring, are not merged.
    apart_m = min(rule.apart_m, 0.2e-3 * args.spacing_mm)
    apart_rad = min(rule.apart_rad, 0.3 * np.deg2rad(args.step_deg))
    return ProtocolOptions(
        PauseRule(args.pause_s, apart_m, apart_rad), grid, 1e-3 * args.spacing_mm, args.step_deg,
        args.order, axis, truth,
    )  # fmt: skip


def _tolerances(texts: list[str]) -> dict[str, float]:
    found = {}
    for text in texts:
        name, _, value = text.rpartition('=')
        try:
            found[name] = float(value)
        except ValueError as error:
            raise ParameterError(f'--limit takes FIGURE=VALUE, got {text!r}') from error
        if not name or not found[name] > 0:
            raise ParameterError(f'--limit takes FIGURE=VALUE with a positive value, got {text!r}')
    return found


SCHEMA = 'anser_accuracy/1'
SHOWN_UNITS = (
    ('_m_per_h', 1e3, 'mm/h'), ('_rad_per_h', DEGREES, 'deg/h'), ('_m_s', 1e3, 'mm/s'),
    ('_m', 1e3, 'mm'), ('_rad', DEGREES, 'deg'), ('_s', 1e3, 'ms'),
)  # fmt: skip
"""Endings of figures' names, with the factor to the unit that is shown."""


def to_document(found: Assessment, verdict: SessionVerdict | None) -> dict[str, Any]:
    """Return the assessment as plain data, null where there is no number; judged by a verdict."""
    document: dict[str, Any] = {
        'schema': SCHEMA, 'protocol': found.protocol, 'body': found.body,
        'recordings': found.recordings, 'start_ns': found.start_ns,
        'figures': {name: vars(estimate) for name, estimate in found.estimates.items()},
        'groups': {name: _group(group) for name, group in found.groups.items()},
        'points': [
            {
                'begin_s': p.begin_s, 'end_s': p.end_s, 'n': p.n, 'position_m': p.position,
                'quaternion_xyzw': Rotation.from_matrix(p.rotation).as_quat(),
                'jitter_rms_m': p.jitter_m,
            }
            for p in found.points
        ],
        'allan': {axis: vars(curve) for axis, curve in found.allan.items()},
        'speeds': [asdict(group) for group in found.speeds],
        'notes': found.notes,
    }  # fmt: skip
    if verdict is not None:
        document['qa'] = {
            'state': verdict.state,
            'earlier_sessions': verdict.sessions,
            'figures': {name: _verdict(v) for name, v in verdict.figures.items()},
        }
    return as_document(document)


def _group(group: ErrorGroup) -> dict[str, Any]:
    errors = zip(group.descriptions, group.errors, group.signed, strict=True)
    return {
        'unit': group.unit,
        'statistics': mitk_statistics(group.errors),
        'summary': {name: vars(estimate) for name, estimate in group.summary.items()},
        'errors': [
            {'description': words, 'distanceError': size, 'signedError': signed}
            for words, size, signed in errors
        ],
    }


def _verdict(verdict: Verdict) -> dict[str, Any]:
    sessions, *levels = (0, *4 * [None]) if verdict.limits is None else verdict.limits
    return {
        'state': verdict.state, 'words': verdict.words,
        **dict(zip(('mean', 'sigma', 'note', 'alert'), levels, strict=True)),
        'sessions': sessions, 'tolerance': verdict.tolerance,
    }  # fmt: skip


def qa_words(qa: Mapping[str, Any]) -> str:
    """State in a line how a session compares with earlier ones."""
    words = [f'{name}: {one["words"]}' for name, one in qa['figures'].items() if one['words']]
    compared = f'{qa["state"]}, compared with {qa["earlier_sessions"]} earlier sessions'
    return ': '.join([compared, *filter(None, ['; '.join(words)])])


def figure_rows(found: Assessment, document: Mapping[str, Any]) -> list[list[str]]:
    """Return name, value with unit, interval, and state of every figure."""
    judged = document.get('qa', {}).get('figures', {})
    figures = dict(found.estimates)
    for name, group in found.groups.items():
        figures |= {f'{name}/{key}': estimate for key, estimate in group.summary.items()}
    return [
        [name, *_texts(one, *shown_unit(found, name)), judged.get(name, {}).get('state', '')]
        for name, one in figures.items()
    ]


def shown_unit(found: Assessment, name: str) -> tuple[float, str]:
    """Return the factor from a figure, by its name, to the unit that is shown, and that unit."""
    group = found.groups.get(name.rpartition('/')[0])
    if group is not None:
        return 1.0, group.unit
    for ending, scale, unit in SHOWN_UNITS:
        if name.endswith(ending):
            return scale, unit
    return 1.0, ''


def _texts(estimate: IntervalEstimate, scale: float, unit: str) -> tuple[str, str]:
    value = f'{scale * estimate.value:.4g} {unit}'
    if not np.isfinite(estimate.low):
        return value, '-'
    return value, f'{scale * estimate.low:.4g} .. {scale * estimate.high:.4g}'


MARKS = {
    PASS: ('o', '#2a7d3f'),
    NOTE: ('^', '#c79100'),
    ALERT: ('D', '#a3329e'),
    FAIL: ('X', '#c62828'),
}
"""Form and colour of a session by its state: either alone says it."""
MOST_TICKS = 8  # dates that have room beside each other


def control_chart(found: Assessment, session: SessionVerdict) -> Figure:
    """Return the chart of every figure that earlier sessions have, this session's last.

    Limits are those that this session is judged by; of earlier ones each has the state that it had
    in its session.
    """
    values = figures_of(found)
    names = [name for name, past in session.past.items() if past]
    figure, panels = plt.subplots(
        len(names), 1, figsize=(9, 3.2 * len(names)), layout='constrained', squeeze=False
    )
    for panel, name in zip(panels[:, 0], names, strict=True):
        scale, unit = shown_unit(found, name)
        verdict = session.figures[name]
        now = EarlierFigure(found.start_ns, values[name], verdict.state)
        sessions = [*session.past[name], now]
        levels = _draw_limits(panel, verdict, scale, len(sessions))
        _set_range(panel, [*levels, *_draw_sessions(panel, sessions, scale)], sessions)
        panel.set_ylabel(unit)
        lacking = '' if verdict.limits else f' (no limits before {FEWEST_SESSIONS} sessions)'
        panel.set_title(f'{name}{lacking}', fontsize=9)
    legend_beside(figure)
    return figure


def _draw_limits(panel: Axes, verdict: Verdict, scale: float, count: int) -> list[float]:
    """Draw mean, limits of note and alert, and tolerance across all sessions; their levels."""
    ends = (0.5, count + 0.5)
    lines = []
    if limits := verdict.limits:
        lines.append((limits.mean, '-', '0.4', 'mean'))
        for reach, state, style in ((limits.note, NOTE, '--'), (limits.alert, ALERT, '-.')):
            words = f'limit of {state}'
            lines += [(limits.mean + d, style, MARKS[state][1], words) for d in (-reach, reach)]
    if verdict.tolerance is not None:
        lines.append((verdict.tolerance, ':', MARKS[FAIL][1], 'tolerance'))
    for level, style, colour, label in lines:
        panel.plot(ends, [scale * level] * 2, style, color=colour, lw=1, label=label)
    panel.set_xlim(*ends)
    return [scale * level for level, *_ in lines]


def _draw_sessions(panel: Axes, sessions: list[EarlierFigure], scale: float) -> list[float]:
    """Draw the value of each session in the mark of its state; the values."""
    at = np.arange(1, len(sessions) + 1)
    value = scale * np.array([one.value for one in sessions])
    panel.plot(at, value, color='0.7', lw=0.8, zorder=1)
    for state, (mark, colour) in MARKS.items():
        rows = [k for k, one in enumerate(sessions) if one.state == state]
        panel.scatter(at[rows], value[rows], marker=mark, color=colour, zorder=2, label=state)
    panel.plot(at[-1:], value[-1:], 'o', ms=13, mfc='none', mec='0.2', label='this session')
    ticks = np.unique(np.linspace(1, len(sessions), min(len(sessions), MOST_TICKS)).astype(int))
    dates = [datetime.fromtimestamp(1e-9 * sessions[k - 1].start_ns) for k in ticks]
    panel.set_xticks(ticks, [f'{date:%Y-%m-%d\n%H:%M}' for date in dates], fontsize=7)
    return [one for one in value.tolist() if np.isfinite(one)]


def _set_range(panel: Axes, levels: list[float], sessions: list[EarlierFigure]) -> None:
    """All sessions and limits are shown, but nothing below 0 of what cannot be negative."""
    low, high = min(levels), max(levels)
    margin = 0.08 * (high - low) or 1e-3 * abs(high) or 1.0
    is_size = all(one.value >= 0 for one in sessions if np.isfinite(one.value))
    panel.set_ylim(max(low - margin, 0.0) if is_size else low - margin, high + margin)


MOST_ROWS = 500  # rows of a table of single errors; all are in accuracy.json


def render(found: Assessment, document: dict[str, Any], verdict: SessionVerdict | None) -> str:
    """Return the page of an assessment, and of `accuracy.json`, as HTML."""
    qa = document.get('qa')
    files = ', '.join(found.recordings[:3]) + (' ...' if len(found.recordings) > 3 else '')
    heads = ('figure', 'value', '95 % interval', *(['state'] if qa else []))
    return page(
        'Accuracy',
        top(
            f'Accuracy of {found.body}: {found.protocol}',
            qa_words(qa) if qa else '',
            PROTOCOLS[found.protocol],
            of=files,
        ),
        table(heads, [row[: len(heads)] for row in figure_rows(found, document)]),
        [paragraph(words, 'note') for words in found.notes],
        _sections(found, verdict),
        _groups(found),
    )


def _sections(found: Assessment, verdict: SessionVerdict | None) -> Iterator[str]:
    """A section of each kind of result that there is."""
    if verdict is not None and any(verdict.past.values()):
        yield heading('Over sessions')
        yield picture(control_chart(found, verdict))
    # A stuck sensor has none, and nothing for logarithmic axes.
    if any(np.any(curve.deviation_m > 0) for curve in found.allan.values()):
        yield heading('Allan deviation')
        yield picture(_allan(found))
    if found.groups:
        yield heading('Errors')
        yield picture(_errors(found))
    if found.speeds:
        yield heading('By speed')
        yield picture(_speeds(found))
        yield table(
            ['speed, mm/s', 'poses', 'error live, rms mm', 'offset taken out, rms mm',
             'latency, ms'],
            [
                (f'{1e3 * g.speed_low_m_s:.0f} to {1e3 * g.speed_high_m_s:.0f}', str(g.n),
                 f'{1e3 * g.error_live_rms_m.value:.2f}', f'{1e3 * g.error_rms_m.value:.2f}',
                 f'{1e3 * g.latency_s.value:.1f} ({1e3 * g.latency_s.low:.1f} .. '
                 f'{1e3 * g.latency_s.high:.1f})')
                for g in found.speeds
            ],
        )  # fmt: skip
    if found.points:
        yield heading('Points')
        yield picture(_points(found))
        yield table(
            ['point', 'time, s', 'poses', 'position, mm', 'jitter, rms mm'],
            [
                (str(k), f'{p.begin_s:.1f} to {p.end_s:.1f}', str(p.n),
                 ' '.join(f'{1e3 * v:.2f}' for v in p.position), f'{1e3 * p.jitter_m:.3f}')
                for k, p in enumerate(found.points, start=1)
            ],
        )  # fmt: skip


def _groups(found: Assessment) -> Iterator[str]:
    """The single errors of each group that is not too long."""
    for name, group in found.groups.items():
        if len(group.errors) <= MOST_ROWS:
            errors = zip(group.descriptions, group.errors, group.signed, strict=True)
            yield heading(name)
            yield table(
                ['', f'error, {group.unit}', f'measured minus true, {group.unit}'],
                [(words, f'{size:.3f}', f'{signed:+.3f}') for words, size, signed in errors],
            )


def _allan(found: Assessment) -> Figure:
    figure, axes = plt.subplots(figsize=(9, 4), layout='constrained')
    for axis, curve in found.allan.items():
        axes.plot(curve.tau_s, 1e3 * curve.deviation_m, 'o-', ms=3, label=axis)
        axes.fill_between(curve.tau_s, 1e3 * curve.low_m, 1e3 * curve.high_m, alpha=0.2)
    axes.set(xlabel='averaging time, s', ylabel='overlapping Allan deviation, mm',
             xscale='log', yscale='log')  # fmt: skip
    axes.grid(alpha=0.3, which='both')
    legend_beside(figure)
    return figure


def _errors(found: Assessment) -> Figure:
    count = len(found.groups)
    figure, panels = plt.subplots(1, count, figsize=(9, 3.2), layout='constrained', squeeze=False)
    for panel, (name, group) in zip(panels[0], found.groups.items(), strict=True):
        panel.hist(group.signed, bins=min(30, max(5, group.signed.size // 4)))
        panel.axvline(0.0, color='0.5')
        panel.set(xlabel=f'measured minus true, {group.unit}')
        panel.set_title(name, fontsize=9)
    panels[0][0].set_ylabel('number')
    return figure


def _speeds(found: Assessment) -> Figure:
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), layout='constrained')
    speed = [1e3 * g.speed_mean_m_s for g in found.speeds]
    live, freed, late = (
        [getattr(g, name) for g in found.speeds]
        for name in ('error_live_rms_m', 'error_rms_m', 'latency_s')
    )
    # The last does not hide those that equal it.
    for panel, label, estimates, width in (
        (left, 'live', live, 4.0), (left, 'offset taken out', freed, 1.5), (right, '', late, 1.5),
    ):  # fmt: skip
        value, low, high = 1e3 * np.array([(e.value, e.low, e.high) for e in estimates]).T
        reach = np.maximum([value - low, high - value], 0.0)
        panel.errorbar(speed, value, yerr=reach, fmt='o-', ms=3, lw=width, label=label)
    for panel in (left, right):
        panel.set_xlabel('speed, mm/s')
        panel.grid(alpha=0.3)
    left.set_ylabel('error, rms mm')
    legend_beside(figure, below=1.0)
    right.set_ylabel('latency against the reference, ms')
    return figure


def _points(found: Assessment) -> Figure:
    place = 1e3 * np.array([p.position for p in found.points])
    figure, panels = plt.subplots(1, 2, figsize=(9, 4), layout='constrained')
    for panel, (a, b) in zip(panels, ((0, 1), (0, 2)), strict=True):
        panel.plot(place[:, a], place[:, b], 'o-', ms=4, lw=0.5)
        panel.set(xlabel=f'{"xyz"[a]}, mm', ylabel=f'{"xyz"[b]}, mm')
        panel.grid(alpha=0.3)
    # Not from the side, from where rows of holes cover each other.
    for number in range(0, len(place), max(1, len(place) // 20)):
        panels[0].annotate(
            str(number + 1), place[number, :2], (4, 2), textcoords='offset points', fontsize=7
        )
    panels[0].margins(x=0.1)
    panels[0].set_aspect('equal')  # the heights of a board, which is flat, would be a line
    return figure
