"""Draws what a diagnosis leaves over time, over the volume, by channel and by emitter.

In all of them 1 is what noise alone would give.
"""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from anser_ros.cli.html_page import AFTER, BEFORE, legend_under
from anser_ros.diagnosis.problem import Part, State
from anser_ros.diagnosis.residuals import tool_parts
from anser_ros.pictures import WIDE, legend_beside, spell_out

Array = NDArray[np.float64]


def strongest(state: State) -> str:
    """State in words on which channel and emitter the residual is largest."""
    largest = []
    parts = tool_parts(state)
    for kind, axis in (('channel', 1), ('emitter', 0)):
        sizes: dict[int, float] = {}
        for part in parts:
            values = np.sqrt(_power(part).mean(axis=axis)).tolist()
            names = part.view.sensors.channel.tolist() if axis else range(len(values))
            for name, value in zip(names, values, strict=True):
                sizes[name] = max(sizes.get(name, 0.0), value)
        worst = max(sizes, key=lambda name: sizes[name])
        usual = float(np.median(list(sizes.values())))
        largest.append(
            f'{kind} {worst} ({sizes[worst]:.1f} times the expected, the median is {usual:.1f}'
        )
    return f'It is largest on {") and on ".join(largest)}).'


def _rms(part: Part, axis: int) -> Array:
    good = part.whitener.weight > 0
    return np.asarray(
        np.sqrt((part.white**2 * good).sum(axis=axis) / np.maximum(good.sum(axis=axis), 1))
    )


def _power(part: Part) -> Array:
    """Mean square of the residual by channel and emitter."""
    sensors, emitters = part.view.flux.shape[1:]
    return np.asarray((_rms(part, 0) ** 2).reshape(2, sensors, emitters).mean(axis=0))


def time_line(before: State, after: State) -> Figure:
    """Draw the residual of every frame over time, without and with the effects."""
    figure, axes = plt.subplots(figsize=(9, 3), layout='constrained')
    # Larger below: where nothing is corrected, both lie on each other.
    for state, colour, label, size in (
        (before, BEFORE, 'before', 6), (after, AFTER, 'after', 3),
    ):  # fmt: skip
        for part in tool_parts(state):
            axes.plot(part.view.time, _rms(part, 1), '.', ms=size, color=colour, label=label)
    axes.axhline(1.0, color='0.6', lw=0.8)
    axes.set(xlabel='time, s', ylabel='residual / expected')
    sizes = np.concatenate([_rms(part, 1) for one in (before, after) for part in tool_parts(one)])
    if sizes.max() > WIDE * sizes.min():
        axes.set(yscale='log')
        spell_out(axes.yaxis)
    legend_beside(figure)
    return figure


def maps(before: State, after: State) -> Figure:
    """Draw the residual of every frame where the tool was, seen from above."""
    figure, panels = plt.subplots(1, 2, figsize=(9, 4), layout='constrained', sharey=True)
    sizes = [np.concatenate([_rms(part, 1) for part in tool_parts(s)]) for s in (before, after)]
    top = max(float(np.percentile(sizes[0], 98)), 1.5)
    for panel, state, size, title in zip(
        panels, (before, after), sizes, ('before', 'after'), strict=True
    ):
        place = np.concatenate([part.view.position for part in tool_parts(state)])
        shown = panel.scatter(1e3 * place[:, 0], 1e3 * place[:, 1], c=size, s=8, vmin=0, vmax=top)
        panel.set(title=title, xlabel='x, mm', aspect='equal')
    panels[0].set_ylabel('y, mm')
    figure.colorbar(shown, ax=panels, label='residual / expected')
    return figure


def course(path: dict[str, Any], sigma: Any, state: State) -> Figure:
    """Draw where something was, from above and over time, with the tool's places and the board.

    ``path`` has ``time_s`` (P,) and ``position_m`` (P, 3) in fg; ``sigma``, m, is (P, 3), (P,) or
    None; ``state`` holds where the tool was.
    """
    figure, (above, over) = plt.subplots(1, 2, figsize=(9, 3.6), layout='constrained')
    time, place = np.asarray(path['time_s']), 1e3 * np.asarray(path['position_m'])
    tool = 1e3 * np.concatenate([part.view.position for part in tool_parts(state)])
    above.plot(tool[:, 0], tool[:, 1], '.', ms=3, color='0.8', label='tool')
    above.plot(place[:, 0], place[:, 1], '.-', color=BEFORE, label='path')
    above.plot(*place[0, :2], 'o', ms=9, mfc='none', color=BEFORE, label='start')
    above.set(xlabel='x, mm', ylabel='y, mm', aspect='equal')
    spread = None if sigma is None else 1e3 * np.asarray(sigma).reshape(len(time), -1)
    for axis, (name, mark) in enumerate((('x', ':'), ('y', '--'), ('z', '-'))):
        over.plot(time, place[:, axis], mark, color=BEFORE, label=name)
        if spread is not None:
            wide = spread[:, min(axis, spread.shape[1] - 1)]
            low, high = place[:, axis] - wide, place[:, axis] + wide
            over.fill_between(time, low, high, color=BEFORE, alpha=0.12, lw=0)
    over.set(xlabel='time, s', ylabel='position, mm')
    for panel in (above, over):
        legend_under(panel)
        panel.grid(alpha=0.3)
    return figure


def bars(before: State, after: State) -> Figure:
    """Draw the residual of every channel and of every emitter."""
    figure, panels = plt.subplots(1, 2, figsize=(9, 3), layout='constrained')
    for offset, state, colour, label in (
        (-0.2, before, BEFORE, 'before'), (0.2, after, AFTER, 'after'),
    ):  # fmt: skip
        for panel, axis in zip(panels, ('channel', 'emitter'), strict=True):
            names, sizes = _by(state, axis)
            panel.bar(np.arange(len(names)) + offset, sizes, 0.4, color=colour, label=label)
            panel.set_xticks(np.arange(len(names)), names)
            panel.set_xlabel(axis)
    panels[0].set_ylabel('residual / expected')
    legend_beside(figure)
    return figure


def _by(state: State, axis: str) -> tuple[list[str], Array]:
    """Return the names of all channels or emitters, and the residual of each."""
    parts = tool_parts(state)
    if axis == 'channel':
        names = [str(c) for part in parts for c in part.view.sensors.channel.tolist()]
        return names, np.sqrt(np.concatenate([_power(part).mean(axis=1) for part in parts]))
    size = np.sqrt(np.mean([_power(part).mean(axis=0) for part in parts], axis=0))
    return [str(k) for k in range(len(size))], size
