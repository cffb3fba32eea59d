"""Shows an assessment as a self-contained page: figures, what they are made from, pictures."""

import html
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from anser_ros.assessment.history import SessionVerdict
from anser_ros.assessment.protocols import PROTOCOLS, Assessment
from anser_ros.cli.accuracy_document import figure_rows
from anser_ros.cli.control_chart import control_chart
from anser_ros.cli.html_page import page, table
from anser_ros.pictures import image, legend_below

MOST_ROWS = 500  # rows of a table of single errors; all are in accuracy.json


def render(found: Assessment, document: dict[str, Any], verdict: SessionVerdict | None) -> str:
    """Return the page of an assessment as HTML.

    Parameters
    ----------
    found : Assessment
    document : dict
        `accuracy.json`.
    verdict : SessionVerdict or None
        None where nothing is judged.
    """
    files = ', '.join(found.recordings[:3]) + (' ...' if len(found.recordings) > 3 else '')
    heads = ('figure', 'value', '95 % interval', *(['state'] if 'qa' in document else []))
    sections = [
        f'<h1>Accuracy of {html.escape(found.body)}: {found.protocol}</h1>'
        f'<p class="note">{html.escape(PROTOCOLS[found.protocol])}; '
        f'<code>{html.escape(files)}</code></p>',
        _verdict(document),
        table(heads, [row[: len(heads)] for row in figure_rows(found, document)]),
        *(f'<p class="note">{html.escape(words)}</p>' for words in found.notes),
    ]
    if verdict is not None and any(verdict.past.values()):
        sections += ['<h2>Over sessions</h2>', image(control_chart(found, verdict))]
    # A stuck sensor has none, and nothing for logarithmic axes.
    if any(np.any(curve.deviation > 0) for curve in found.allan.values()):
        sections += ['<h2>Allan deviation</h2>', image(_allan(found))]
    if found.groups:
        sections += ['<h2>Errors</h2>', image(_errors(found))]
    if found.speeds:
        sections += ['<h2>By speed</h2>', image(_speeds(found)), _speed_table(found)]
    if found.points:
        sections += ['<h2>Points</h2>', image(_points(found)), _point_table(found)]
    for name, group in found.groups.items():
        if len(group.errors) > MOST_ROWS:
            continue
        rows = [
            (words, f'{size:.3f}', f'{signed:+.3f}')
            for words, size, signed in zip(
                group.descriptions, group.errors, group.signed, strict=True
            )
        ]
        sections += [
            f'<h2>{html.escape(name)}</h2>',
            table(('', f'error, {group.unit}', f'measured minus true, {group.unit}'), rows),
        ]
    return page('Accuracy', sections)


def _verdict(document: dict[str, Any]) -> str:
    if 'qa' not in document:
        return ''
    qa = document['qa']
    words = '; '.join(
        f'{name}: {one["state"]}, {one["words"]}'
        for name, one in qa['figures'].items()
        if one['words']
    )
    text = f'{qa["state"]}, compared with {qa["earlier_sessions"]} earlier sessions. {words}'
    return f'<p class="verdict">{html.escape(text)}</p>'


def _allan(found: Assessment) -> Figure:
    figure, axes = plt.subplots(figsize=(9, 4), layout='constrained')
    for axis, curve in found.allan.items():
        axes.plot(curve.tau_s, 1e3 * curve.deviation, 'o-', ms=3, label=axis)
        axes.fill_between(curve.tau_s, 1e3 * curve.low, 1e3 * curve.high, alpha=0.2)
    axes.set(xlabel='averaging time, s', ylabel='overlapping Allan deviation, mm',
             xscale='log', yscale='log')  # fmt: skip
    axes.grid(alpha=0.3, which='both')
    figure.legend(loc='outside right upper')
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
    for panel, scale, series in (
        (left, 1e3, [('live', [g.error_live_m for g in found.speeds]),
                     ('offset taken out', [g.error_m for g in found.speeds])]),
        (right, 1e3, [('', [g.latency_s for g in found.speeds])]),
    ):  # fmt: skip
        for rank, (label, estimates) in enumerate(series, start=1):
            width = 1.5 + 2.5 * (len(series) - rank)  # the last does not hide those that equal it
            value = scale * np.array([e.value for e in estimates])
            bars = scale * np.array([[e.value - e.low, e.high - e.value] for e in estimates]).T
            panel.errorbar(
                speed, value, yerr=np.maximum(bars, 0.0), fmt='o-', ms=3, lw=width, label=label
            )
        panel.set_xlabel('speed, mm/s')
        panel.grid(alpha=0.3)
    left.set_ylabel('error, rms mm')
    legend_below(figure, left)
    right.set_ylabel('latency against the reference, ms')
    return figure


def _speed_table(found: Assessment) -> str:
    rows = [
        (f'{1e3 * g.low_m_s:.0f} to {1e3 * g.high_m_s:.0f}', str(g.n),
         f'{1e3 * g.error_live_m.value:.2f}', f'{1e3 * g.error_m.value:.2f}',
         f'{1e3 * g.latency_s.value:.1f} ({1e3 * g.latency_s.low:.1f} .. '
         f'{1e3 * g.latency_s.high:.1f})')
        for g in found.speeds
    ]  # fmt: skip
    head = ('speed, mm/s', 'poses', 'error live, rms mm', 'offset taken out, rms mm',
            'latency, ms')  # fmt: skip
    return table(head, rows)


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


def _point_table(found: Assessment) -> str:
    rows = [
        (str(k), f'{p.begin_s:.1f} to {p.end_s:.1f}', str(p.n),
         ' '.join(f'{1e3 * v:.2f}' for v in p.position), f'{1e3 * p.jitter_m:.3f}')
        for k, p in enumerate(found.points, start=1)
    ]  # fmt: skip
    return table(('point', 'time, s', 'poses', 'position, mm', 'jitter, rms mm'), rows)
