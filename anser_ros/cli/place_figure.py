"""Draws a proposal of places: where the coils are, and what more of them would gain."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from anser_ros.cli.html_page import legend_under
from anser_ros.cli.labels import Label, name_points
from anser_ros.physics.sensor import SensorTable
from anser_ros.pictures import spell_out
from anser_ros.refit.clouds import Region
from anser_ros.refit.design import Design

PLACE_ARROW = 0.15
"""Length of an axis in the picture, in halves of the board."""
ARROW_POINTS = 8
"""Points of an arrow that no number should cover."""
NUMBERS_PT = 8.0
"""Size of the coils' numbers, points."""


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
        name_points(axes, labels, drawn, NUMBERS_PT)
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
