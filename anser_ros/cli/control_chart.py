"""Draws a control chart: a figure over the sessions of a history, with its limits."""

from datetime import datetime

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from anser_ros.assessment.control import ALERT, FAIL, FEWEST_SESSIONS, NOTE, PASS, Verdict
from anser_ros.assessment.history import EarlierFigure, SessionVerdict, figures_of
from anser_ros.assessment.protocols import Assessment
from anser_ros.cli.accuracy_document import shown_unit
from anser_ros.pictures import legend_beside

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
