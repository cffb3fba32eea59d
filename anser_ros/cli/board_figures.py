"""Draws boards: coils of a setup, proposed places, and names that cover nothing."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.text import Text
from numpy.typing import ArrayLike, NDArray

from anser_ros.cli.page import legend_under, spell_out
from anser_ros.physics.sensor import SensorTable
from anser_ros.refit.clouds import Region
from anser_ros.refit.design import Design
from anser_ros.sessions.nominal_board import NominalBoard, tracked_volume
from anser_ros.wire.setup import SensorRows, SensorSpec, Setup

Array = NDArray[np.float64]

DISTANCES_PT = (4.0, 8.0, 14.0, 22.0, 32.0, 44.0)
"""Distances of a name from its point that are tried, points."""
LEADER_PT = 14.0
"""Distance from which on a thin line leads from a name to its point, points."""
DIRECTIONS = 16
"""Directions about a point in which its name is tried."""
MARGIN_PT = 2.0
"""Least distance of a name from another one and from what is drawn, points."""


class Label(NamedTuple):
    """The name of a point, in the coordinates of the data."""

    text: str
    at: tuple[float, float]
    away: tuple[float, float] = (0.0, 0.0)  # where the name should lie from the point; or anywhere


def name_points(axes: Axes, labels: Sequence[Label], drawn: ArrayLike, size: float) -> None:
    """Write names of a size, points, beside their points, once all else is drawn.

    That may be by ``figure.draw_without_rendering()``, which settles the layout and with it the
    scale. Texts of the axes, and points ``drawn``, shape (n, 2), are not covered.
    """
    figure = axes.figure.figure  # not a figure inside it; older versions have no other way
    dots = figure.dpi / 72.0  # pixels in a point
    margin = MARGIN_PT * dots
    taken = [_box(text) for text in axes.texts]
    covered = axes.transData.transform(np.asarray(drawn, dtype=np.float64).reshape(-1, 2))
    frame = np.array(axes.get_window_extent().extents)
    for label in labels:
        note = axes.annotate(
            label.text, label.at, (0, 0), textcoords='offset points', fontsize=size, ha='center',
            va='center',
        )  # fmt: skip
        here = axes.transData.transform(label.at)
        there = axes.transData.transform(np.add(label.at, label.away))
        box = _box(note)
        half = 0.5 * (box[2:] - box[:2])
        reach = 2.0 * half + margin + DISTANCES_PT[-1] * dots
        near = covered[np.all(np.abs(covered - here) <= reach, axis=1)]
        shift, distance = _best(here, there - here, half, dots, margin, frame, taken, near)
        note.set_position((shift / dots).tolist())
        taken.append(np.concatenate([here + shift - half, here + shift + half]))
        if distance >= LEADER_PT:
            axes.annotate(
                '', label.at, (shift / dots).tolist(), textcoords='offset points',
                arrowprops={'arrowstyle': '-', 'lw': 0.4, 'color': '0.5', 'shrinkA': size / 2,
                            'shrinkB': 1.0},
            )  # fmt: skip


def _box(text: Text) -> Array:
    """Left, lower, right and upper end of a text, in pixels."""
    return np.array(text.get_window_extent().extents)


def _best(
    here: Array, away: Array, half: Array, dots: float, margin: float, frame: Array,
    taken: Sequence[Array], covered: Array,
) -> tuple[Array, float]:  # fmt: skip
    """Nearest free shift of a name, pixels, in the direction nearest to the wanted; its length."""
    begin = float(np.arctan2(away[1], away[0])) if away.any() else -0.75 * np.pi
    turns = np.arange(DIRECTIONS)
    angle = begin + 2.0 * np.pi / DIRECTIONS * np.where(turns % 2, (turns + 1) // 2, -(turns // 2))
    way = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    # Where a box of this size is beside the point, whichever way it is.
    beside = np.min(half / np.maximum(np.abs(way), 1e-9), axis=1)
    reach = np.add.outer(dots * np.array(DISTANCES_PT), beside)
    shift = (reach[..., None] * way).reshape(-1, 2)
    low, high = here + shift - half - margin, here + shift + half + margin
    hidden = np.all((covered > low[:, None]) & (covered < high[:, None]), axis=2).sum(axis=1)
    other = np.reshape(taken, (-1, 4))
    across = np.all((low[:, None] < other[:, 2:]) & (high[:, None] > other[:, :2]), axis=2)
    outside = np.any((low < frame[:2]) | (high > frame[2:]), axis=1)
    best = int(np.argmin(100.0 * across.sum(axis=1) + 100.0 * outside + hidden))
    return shift[best], DISTANCES_PT[best // DIRECTIONS]


SIDES = ((0, 1, 'from above'), (0, 2, 'from the side'))
"""Panels: the two coordinates that each shows, and its title."""
ARROW = 0.08
"""Length of a coil's axis as drawn, as a part of what the panel shows."""
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
        name_points(panel, labels, drawn, size=6.0)
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
        coils = [sensors[row] for row in rows]
        words = [f'{c.name} ({c.channel})' if names else str(c.channel) for c in coils]
        away = axis[rows[0]] if np.abs(axis[rows[0]]).max() > LEVEL else np.zeros(2)
        labels.append(Label('\n'.join(words), end, tuple((size * away).tolist())))
    panel.update_datalim(ends)
    panel.margins(0.4 if names else 0.1)
    panel.autoscale_view()
    return labels, np.vstack([_along(np.stack(one)) for one in zip(place, ends, strict=True)])


PLACE_ARROW = 0.15
"""Length of an axis in the picture, in halves of the board."""
ARROW_POINTS = 8
"""Points of an arrow that no number should cover."""


def places_figure(
    candidates: SensorTable,
    region: Region,
    designs: Sequence[Design],
    random: Mapping[int, Sequence[Design]],
) -> Figure:
    """Draw the chosen coils from above and from the side, and the error against their number."""
    figure = Figure(figsize=(13.0, 4.2), layout='constrained')
    above, side, right = figure.subplots(1, 3)
    chosen = list(designs[-1].coils)
    named = []
    for axes, sides in ((above, [0, 1]), (side, [0, 2])):
        labels, drawn = _draw_places(axes, candidates, chosen, region, sides)
        named.append((axes, labels, drawn))
    above.set_title('from above')
    side.set_title('from the side')
    _draw_errors(right, designs, random)
    for panel in (above, right):  # below, where no place and no error lies
        legend_under(panel, 0.14, columns=2)
    figure.draw_without_rendering()
    for axes, labels, drawn in named:
        name_points(axes, labels, drawn, size=8.0)
    return figure


def _draw_places(
    axes: Any, candidates: SensorTable, chosen: list[int], region: Region, sides: list[int]
) -> tuple[list[Label], Any]:
    """Draw candidates, chosen coils and board; the coils' numbers, and what these should spare."""
    axes.plot(*candidates.position[:, sides].T, '.', color='0.75', label='candidates')
    at, axis = candidates.position[chosen][:, sides], candidates.axis[chosen][:, sides]
    size = PLACE_ARROW * region.half
    axes.quiver(
        *at.T, *axis.T, angles='xy', scale_units='xy', scale=1.0 / size, color='tab:blue',
        width=0.006,
    )  # fmt: skip
    axes.update_datalim(at + size * axis)
    axes.margins(0.12)
    square = region.half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    board = np.column_stack([square + region.centre, np.zeros(5)])[:, sides]
    axes.plot(*board.T, color='tab:brown', label='board')
    axes.set_aspect('equal', 'datalim')
    axes.locator_params(axis='x', nbins=5)
    axes.set(xlabel='x / m', ylabel=f'{"xyz"[sides[1]]} / m')
    labels = [
        Label(str(rank), tuple(point), tuple(-way))
        for rank, (point, way) in enumerate(zip(at.tolist(), axis, strict=True), start=1)
    ]
    steps = np.linspace(0.0, 1.0, ARROW_POINTS)[:, None, None]
    arrows = (at + steps * size * axis).reshape(-1, 2)
    return labels, np.vstack([candidates.position[:, sides], arrows])


def _draw_errors(
    axes: Any, designs: Sequence[Design], random: Mapping[int, Sequence[Design]]
) -> None:
    counts = [len(design.coils) for design in designs]
    axes.plot(counts, [1e3 * design.error_m for design in designs], 's-', label='proposed')
    errors = [[1e3 * design.error_m for design in drawn] for drawn in random.values()]
    mean, low, high = (np.array([pick(e) for e in errors]) for pick in (np.mean, min, max))
    axes.errorbar(
        list(random), mean, [mean - low, high - mean], fmt='o', color='0.5', capsize=3,
        label='random places, best to worst',
    )  # fmt: skip
    axes.set_xscale('log', base=2)
    axes.set_yscale('log')
    spell_out(axes.yaxis)
    axes.set_xticks(list(random), [str(n) for n in random])
    axes.set(xlabel='reference coils', ylabel='expected position error / mm')
    axes.grid(True, which='both', alpha=0.3)
