"""Shows an assessment: as the document `accuracy.json`, as control chart and as page."""

from collections.abc import Iterator, Mapping
from datetime import datetime
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

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
)
from anser_ros.apps.poses.assessment.hummel import ErrorGroup
from anser_ros.apps.poses.assessment.intervals import IntervalEstimate, mitk_statistics
from anser_ros.apps.poses.assessment.protocols import PROTOCOLS, Assessment
from anser_ros.apps.poses.corrector import finite
from anser_ros.cli.page import heading, page, paragraph, picture, table, top
from anser_ros.physics.constants import DEGREES
from anser_ros.pictures import legend_below, legend_beside

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
        'recordings': list(found.recordings), 'start_ns': found.start_ns,
        'figures': {name: _estimate(e) for name, e in found.estimates.items()},
        'groups': {name: _group(group) for name, group in found.groups.items()},
        'points': [
            {
                'begin_s': p.begin_s, 'end_s': p.end_s, 'n': p.n,
                'position_m': p.position.tolist(),
                'quaternion_xyzw': Rotation.from_matrix(p.rotation).as_quat().tolist(),
                'jitter_rms_m': p.jitter_m,
            }
            for p in found.points
        ],
        'allan': {
            axis: {
                'tau_s': c.tau_s.tolist(), 'deviation_m': c.deviation.tolist(),
                'low_m': c.low.tolist(), 'high_m': c.high.tolist(),
            }
            for axis, c in found.allan.items()
        },
        'speeds': [
            {
                'speed_low_m_s': g.low_m_s, 'speed_high_m_s': g.high_m_s,
                'speed_mean_m_s': g.mean_m_s, 'n': g.n, 'error_rms_m': _estimate(g.error_m),
                'error_live_rms_m': _estimate(g.error_live_m),
                'latency_s': _estimate(g.latency_s),
            }
            for g in found.speeds
        ],
        'notes': list(found.notes),
    }  # fmt: skip
    if verdict is not None:
        document['qa'] = {
            'state': verdict.state,
            'earlier_sessions': verdict.sessions,
            'figures': {name: _verdict(v) for name, v in verdict.figures.items()},
        }
    return dict(finite(document))


def _estimate(estimate: IntervalEstimate) -> dict[str, float]:
    return {'value': estimate.value, 'low': estimate.low, 'high': estimate.high}


def _group(group: ErrorGroup) -> dict[str, Any]:
    return {
        'unit': group.unit,
        'statistics': mitk_statistics(group.errors),
        'summary': {name: _estimate(e) for name, e in group.summary.items()},
        'errors': [
            {'description': words, 'distanceError': float(size), 'signedError': float(signed)}
            for words, size, signed in zip(
                group.descriptions, group.errors, group.signed, strict=True
            )
        ],
    }


def _verdict(verdict: Verdict) -> dict[str, Any]:
    limits = verdict.limits
    names = ('mean', 'sigma', 'note', 'alert')
    return {
        'state': verdict.state,
        'words': verdict.words,
        **{name: None if limits is None else getattr(limits, name) for name in names},
        'sessions': 0 if limits is None else limits.n,
        'tolerance': verdict.tolerance,
    }


def qa_words(qa: Mapping[str, Any]) -> str:
    """State in a line how a session compares with earlier ones."""
    words = [f'{name}: {one["words"]}' for name, one in qa['figures'].items() if one['words']]
    compared = f'{qa["state"]}, compared with {qa["earlier_sessions"]} earlier sessions'
    return ': '.join([compared, *filter(None, ['; '.join(words)])])


def figure_rows(found: Assessment, document: Mapping[str, Any]) -> list[tuple[str, str, str, str]]:
    """Return name, value with unit, interval, and state of every figure."""
    judged = document.get('qa', {}).get('figures', {})
    figures = dict(found.estimates)
    for name, group in found.groups.items():
        figures |= {f'{name}/{key}': estimate for key, estimate in group.summary.items()}
    return [
        (name, *_texts(one, *shown_unit(found, name)), judged.get(name, {}).get('state', ''))
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
    if any(np.any(curve.deviation > 0) for curve in found.allan.values()):
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
                (f'{1e3 * g.low_m_s:.0f} to {1e3 * g.high_m_s:.0f}', str(g.n),
                 f'{1e3 * g.error_live_m.value:.2f}', f'{1e3 * g.error_m.value:.2f}',
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
        axes.plot(curve.tau_s, 1e3 * curve.deviation, 'o-', ms=3, label=axis)
        axes.fill_between(curve.tau_s, 1e3 * curve.low, 1e3 * curve.high, alpha=0.2)
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
    speed = [1e3 * g.mean_m_s for g in found.speeds]
    live, freed, late = (
        [getattr(g, name) for g in found.speeds]
        for name in ('error_live_m', 'error_m', 'latency_s')
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
    legend_below(figure, left)
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
