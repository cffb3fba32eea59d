"""Draws a setup document: board, references and volume from above and the side, and tools."""

from collections import defaultdict
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from anser_ros.cli.labels import Label, name_points
from anser_ros.sessions.drawing import NominalBoard
from anser_ros.sessions.volume import tracked_volume
from anser_ros.wire.setup import SensorRows, SensorSpec, Setup

Array = NDArray[np.float64]

SIDES = ((0, 1, 'from above'), (0, 2, 'from the side'))
"""Panels: the two coordinates that each shows, and its title."""
ARROW = 0.08
"""Length of a coil's axis as drawn, as a part of what the panel shows."""
LETTERS_PT = 6.0
"""Size of the coils' names, points."""
LEVEL = 0.05
"""Largest part of an axis in a panel of a coil that points at the viewer."""
LINE_POINTS = 20
"""Points of an arrow, or of a side of a coil, that no name should cover."""
MOST_TICKS = 8
"""Numbers along an axis that have room beside each other."""
SMALLEST_MM = 5.0
"""Least extent of a tool as drawn, mm: one of a single coil has none."""


def setup_figure(setup: Setup) -> Figure:
    """Draw the board with references and tracked volume, and each tool in its own frame."""
    rows = 1 + len(setup.bodies)
    figure, panels = plt.subplots(
        rows, 2, figsize=(10, 4.6 * rows), layout='constrained', squeeze=False
    )
    named = []
    for panel, (across, up, title) in zip(panels[0], SIDES, strict=True):
        lines = _board(panel, setup, across, up)
        labels, drawn = _sensors(panel, setup.reference_sensors, across, up, names=False)
        named.append((panel, labels, np.vstack([lines, drawn])))
        panel.set_title(f'board, {title}')
    for line, body in zip(panels[1:], setup.bodies, strict=True):
        coils = tuple(sensor for sensor in setup.sensors if sensor.body == body)
        for panel, (across, up, title) in zip(line, SIDES, strict=True):
            named.append((panel, *_sensors(panel, coils, across, up, names=True)))
            panel.plot(0, 0, '+', color='0.4')
            panel.set_title(f'{body}, {title}')
    for line in panels:
        for panel, (across, up, _) in zip(line, SIDES, strict=True):
            panel.set(xlabel=f'{"xyz"[across]}, mm', ylabel=f'{"xyz"[up]}, mm')
            panel.set_aspect('equal', adjustable='datalim')
            panel.locator_params(nbins=MOST_TICKS)
            panel.grid(alpha=0.3)
    figure.draw_without_rendering()
    for panel, labels, drawn in named:
        name_points(panel, labels, drawn, LETTERS_PT)
    return figure


def _board(panel: Any, setup: Setup, across: int, up: int) -> Array:
    """Draw emitters and tracked volume; points of the lines."""
    lines = []
    board = NominalBoard.of(setup).board
    for rank, coil in enumerate(setup.emitter.coils):
        centre = 1e3 * np.array(coil.centre_m)
        if board is not None:
            corners = 1e3 * np.vstack([board.paths[rank], board.paths[rank][:1]])
            panel.plot(corners[:, across], corners[:, up], color='C0', lw=0.5)
            lines.append(corners[:, [across, up]])
        if up == 1:  # from the side they lie on each other
            panel.annotate(
                f'{coil.name}\n{coil.frequency_hz:g} Hz', centre[:2], fontsize=6, ha='center',
                va='center',
            )  # fmt: skip
    volume = tracked_volume(setup)
    low, high = 1e3 * np.array(volume.low), 1e3 * np.array(volume.high)
    size = high - low
    panel.add_patch(
        Rectangle((low[across], low[up]), size[across], size[up], fill=False, ls='--', color='0.5')
    )
    panel.annotate('tracked volume', (low[across], high[up]), fontsize=7, color='0.4', va='bottom')
    round_it = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]])
    lines.append(low[[across, up]] + round_it * size[[across, up]])
    return np.vstack([_along(line) for line in lines])


def _along(line: Array) -> Array:
    """Points along a line of corners (n, 2), some to each side."""
    steps = np.linspace(0.0, 1.0, LINE_POINTS)[:, None, None]
    return np.asarray((line[:-1] + steps * np.diff(line, axis=0)).reshape(-1, 2))


def _sensors(
    panel: Any, sensors: tuple[SensorSpec, ...], across: int, up: int, *, names: bool
) -> tuple[list[Label], Array]:
    """Draw coils as arrows; their names, and the points that names should not cover."""
    if not sensors:
        return [], np.zeros((0, 2))
    sides = [across, up]
    _, position, axis = SensorRows.of(sensors)
    place = 1e3 * position
    reach = np.vstack([place, np.zeros((1, 3))])
    size = ARROW * max(float(np.ptp(reach, axis=0).max()), SMALLEST_MM)
    if names:
        size *= 3.0
        panel.update_datalim(0.5 * SMALLEST_MM * np.array([[-1.0, -1.0], [1.0, 1.0]]))
    colour = 'C2' if names else 'C1'
    panel.quiver(
        place[:, across], place[:, up], size * axis[:, across], size * axis[:, up],
        angles='xy', scale_units='xy', scale=1.0, color=colour, width=0.004,
    )  # fmt: skip
    panel.plot(place[:, across], place[:, up], 'o', ms=3, color=colour)
    place, axis = place[:, sides], axis[:, sides]
    ends = place + size * axis
    together: defaultdict[tuple[float, float], list[int]] = defaultdict(list)
    for row, end in enumerate(ends.round(3).tolist()):
        together[end[0], end[1]].append(row)
    labels = []
    for end, rows in together.items():
        words = [_words(sensors[row], names) for row in rows]
        away = axis[rows[0]] if np.abs(axis[rows[0]]).max() > LEVEL else np.zeros(2)
        labels.append(Label('\n'.join(words), end, tuple((size * away).tolist())))
    panel.update_datalim(ends)
    panel.margins(0.4 if names else 0.1)
    panel.autoscale_view()
    return labels, np.vstack([_along(np.stack(one)) for one in zip(place, ends, strict=True)])


def _words(sensor: SensorSpec, name: bool) -> str:
    return f'{sensor.name} ({sensor.channel})' if name else str(sensor.channel)
