"""Draws boards: coils of a setup, and names that cover no other."""

from collections import defaultdict
from collections.abc import Sequence
from itertools import product
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke

from anser_ros.sessions.nominal_board import NominalBoard, tracked_volume
from anser_ros.wire.setup import SensorRows, SensorSpec, Setup

DISTANCES_PT = (4.0, 10.0, 18.0, 28.0)
"""Distances of a name from its point that are tried, points."""
TURNS = np.deg2rad([0, 30, -30, 60, -60, 90, -90, 135, -135, 180])
"""Turns of a name from its wanted direction that are tried, rad."""


class Label(NamedTuple):
    """The name of a point, in the coordinates of the data."""

    text: str
    at: tuple[float, float]
    away: tuple[float, float] = (0.0, 0.0)  # where the name should lie from the point; or anywhere


def name_points(axes: Axes, labels: Sequence[Label], size: float) -> None:
    """Write names of a size, points, beside their points, where they cover no other text.

    The layout has to be settled, as by ``figure.draw_without_rendering()``.
    """
    halo = [withStroke(linewidth=1.5, foreground='white')]
    taken = [text.get_window_extent() for text in axes.texts]
    for label in labels:
        note = axes.annotate(
            label.text, label.at, (0, 0), textcoords='offset points', fontsize=size, ha='center',
            va='center', path_effects=halo,
        )  # fmt: skip
        box = note.get_window_extent()
        half = 0.5 * 72.0 / axes.figure.dpi * np.array([box.width, box.height])  # points
        begin = np.arctan2(*label.away[::-1]) if any(label.away) else -0.75 * np.pi
        for distance, turn in product(DISTANCES_PT, TURNS):
            way = np.array([np.cos(begin + turn), np.sin(begin + turn)])
            beside = np.min(half / np.maximum(np.abs(way), 1e-9))
            note.set_position(((distance + beside) * way).tolist())
            box = note.get_window_extent()
            if not box.count_overlaps(taken):
                break
        taken.append(box)


SIDES = ((0, 1, 'from above'), (0, 2, 'from the side'))
"""Panels: the two coordinates that each shows, and its title."""
ARROW = 0.08
"""Length of a coil's axis as drawn, as a part of what the panel shows."""
LEVEL = 0.05
"""Largest part of an axis in a panel of a coil that points at the viewer."""
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
        _board(panel, setup, across, up)
        references = setup.reference_sensors
        named.append((panel, _sensors(panel, references, across, up, names=False)))
        panel.set_title(f'board, {title}')
    for line, body in zip(panels[1:], setup.bodies, strict=True):
        coils = tuple(sensor for sensor in setup.sensors if sensor.body == body)
        for panel, (across, up, title) in zip(line, SIDES, strict=True):
            named.append((panel, _sensors(panel, coils, across, up, names=True)))
            panel.plot(0, 0, '+', color='0.4')
            panel.set_title(f'{body}, {title}')
    for line in panels:
        for panel, (across, up, _) in zip(line, SIDES, strict=True):
            panel.set(xlabel=f'{"xyz"[across]}, mm', ylabel=f'{"xyz"[up]}, mm')
            panel.set_aspect('equal', adjustable='datalim')
            panel.locator_params(nbins=MOST_TICKS)
            panel.grid(alpha=0.3)
    figure.draw_without_rendering()
    for panel, labels in named:
        name_points(panel, labels, size=6.0)
    return figure


def _board(panel: Any, setup: Setup, across: int, up: int) -> None:
    board = NominalBoard.of(setup).board
    for rank, coil in enumerate(setup.emitter.coils):
        centre = 1e3 * np.array(coil.centre_m)
        if board is not None:
            corners = 1e3 * np.vstack([board.paths[rank], board.paths[rank][:1]])
            panel.plot(corners[:, across], corners[:, up], color='C0', lw=0.5)
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


def _sensors(
    panel: Any, sensors: tuple[SensorSpec, ...], across: int, up: int, *, names: bool
) -> list[Label]:
    """Draw coils as arrows, and return their names."""
    if not sensors:
        return []
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
        coils = [sensors[row] for row in rows]
        words = [f'{c.name} ({c.channel})' if names else str(c.channel) for c in coils]
        away = axis[rows[0]] if np.abs(axis[rows[0]]).max() > LEVEL else np.zeros(2)
        labels.append(Label('\n'.join(words), end, tuple((size * away).tolist())))
    panel.update_datalim(ends)
    panel.margins(0.4 if names else 0.1)
    panel.autoscale_view()
    return labels
