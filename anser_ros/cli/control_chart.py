"""Draws a control chart: a figure over the sessions of a history, with its limits."""

from datetime import datetime

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from anser_ros.assessment.control import ALERT, FAIL, FEWEST_SESSIONS, NOTE, PASS, Verdict
from anser_ros.assessment.history import EarlierFigure, SessionVerdict, figures_of
from anser_ros.assessment.protocols import Assessment
from anser_ros.cli.accuracy_document import shown_unit

MARKS = {
    PASS: ('o', '#2a7d3f'),
    NOTE: ('^', '#c79100'),
    ALERT: ('D', '#a3329e'),
    FAIL: ('X', '#c62828'),
}
"""Form and colour of a session by its state: either alone tells it."""
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
        _draw_limits(panel, verdict, scale, len(sessions))
        _draw_sessions(panel, sessions, scale)
        _set_range(panel, verdict, [scale * one.value for one in sessions], scale)
        panel.set_ylabel(unit)
        panel.set_title(f'{name}{_lacking(verdict)}', fontsize=9)
    has_tolerance = any(session.figures[name].tolerance is not None for name in names)
    figure.legend(handles=_legend(has_tolerance), loc='outside right upper', fontsize=8)
    return figure


def _lacking(verdict: Verdict) -> str:
    return '' if verdict.limits else f' (no limits before {FEWEST_SESSIONS} sessions)'


def _draw_limits(panel: Axes, verdict: Verdict, scale: float, count: int) -> None:
    """Mean, limits of note and alert, and tolerance, as lines across all sessions."""
    ends = np.array([0.5, count + 0.5])
    if verdict.limits:
        mean = scale * verdict.limits.mean
        panel.plot(ends, [mean, mean], color='0.4', lw=1)
        for reach, state, style in (
            (verdict.limits.note, NOTE, '--'), (verdict.limits.alert, ALERT, '-.')
        ):  # fmt: skip
            for side in (-1, 1):
                level = mean + side * scale * reach
                panel.plot(ends, [level, level], style, color=MARKS[state][1], lw=1)
    if verdict.tolerance is not None:
        level = scale * verdict.tolerance
        panel.plot(ends, [level, level], ':', color=MARKS[FAIL][1], lw=1.5)
    panel.set_xlim(*ends)


def _draw_sessions(panel: Axes, sessions: list[EarlierFigure], scale: float) -> None:
    at = np.arange(1, len(sessions) + 1)
    value = scale * np.array([one.value for one in sessions])
    panel.plot(at, value, color='0.7', lw=0.8, zorder=1)
    for state, (mark, colour) in MARKS.items():
        rows = [k for k, one in enumerate(sessions) if one.state == state]
        panel.scatter(at[rows], value[rows], marker=mark, color=colour, zorder=2)
    panel.plot(at[-1:], value[-1:], 'o', ms=13, mfc='none', mec='0.2')
    ticks = np.unique(np.linspace(1, len(sessions), min(len(sessions), MOST_TICKS)).astype(int))
    dates = [datetime.fromtimestamp(1e-9 * sessions[k - 1].start_ns) for k in ticks]
    panel.set_xticks(ticks, [f'{date:%Y-%m-%d\n%H:%M}' for date in dates], fontsize=7)


def _set_range(panel: Axes, verdict: Verdict, values: list[float], scale: float) -> None:
    """All sessions and limits are shown, but nothing below 0 of what cannot be negative."""
    levels = [value for value in values if np.isfinite(value)]
    is_size = min(levels, default=0.0) >= 0
    if verdict.limits:
        reach = verdict.limits.alert
        levels += [scale * (verdict.limits.mean + side * reach) for side in (-1, 1)]
    if verdict.tolerance is not None:
        levels.append(scale * verdict.tolerance)
    low, high = min(levels), max(levels)
    margin = 0.08 * (high - low) or 1e-3 * abs(high) or 1.0
    panel.set_ylim(max(low - margin, 0.0) if is_size else low - margin, high + margin)


def _legend(has_tolerance: bool) -> list[Line2D]:
    states = [
        Line2D([], [], ls='', marker=mark, color=colour, label=state)
        for state, (mark, colour) in MARKS.items()
    ]
    lines = [
        Line2D([], [], color='0.4', lw=1, label='mean'),
        Line2D([], [], ls='--', color=MARKS[NOTE][1], lw=1, label='limit of note'),
        Line2D([], [], ls='-.', color=MARKS[ALERT][1], lw=1, label='limit of alert'),
    ]
    if has_tolerance:
        lines.append(Line2D([], [], ls=':', color=MARKS[FAIL][1], lw=1.5, label='tolerance'))
    now = Line2D([], [], ls='', marker='o', ms=10, mfc='none', mec='0.2', label='this session')
    return [*states, now, *lines]
