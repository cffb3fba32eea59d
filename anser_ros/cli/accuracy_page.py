"""Shows an assessment as a self-contained page: figures, what they are made from, pictures."""

from collections.abc import Iterator
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from anser_ros.assessment.history import SessionVerdict
from anser_ros.assessment.protocols import PROTOCOLS, Assessment
from anser_ros.cli.accuracy_document import figure_rows, qa_words
from anser_ros.cli.control_chart import control_chart
from anser_ros.cli.html_page import heading, page, paragraph, picture, table, top
from anser_ros.pictures import legend_below, legend_beside

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
