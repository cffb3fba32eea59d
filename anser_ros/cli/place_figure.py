"""Draws a proposal of places: where the coils are, and what more of them would gain."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from anser_ros.cli.labels import Label, name_points
from anser_ros.physics.sensor import SensorTable
from anser_ros.refit.clouds import Region
from anser_ros.refit.design import Design

ARROW = 0.15
"""Length of an axis in the picture, in halves of the board."""
ARROW_POINTS = 8
"""Points of an arrow that no number should cover."""
LETTERS_PT = 8.0
"""Size of the coils' numbers, points."""


def write_figure(
    path: Path,
    candidates: SensorTable,
    region: Region,
    designs: Sequence[Design],
    random: Mapping[int, Sequence[Design]],
) -> None:
    """Draw the chosen coils from above and from the side, and the error against their number."""
    from matplotlib.figure import Figure

    from anser_ros.pictures import save, spell_out

    figure = Figure(figsize=(13.0, 4.2), layout='constrained')
    chosen = list(designs[-1].coils)
    half, named = region.half, []
    for panel, (across, up, words) in enumerate(((0, 1, 'from above'), (0, 2, 'from the side'))):
        axes = figure.add_subplot(1, 3, panel + 1)
        axes.plot(*candidates.position[:, (across, up)].T, '.', color='0.75', label='candidates')
        at, axis = candidates.position[chosen], candidates.axis[chosen]
        axes.quiver(
            at[:, across], at[:, up], axis[:, across], axis[:, up], angles='xy',
            scale_units='xy', scale=1.0 / (ARROW * half), color='tab:blue', width=0.006,
        )  # fmt: skip
        sides = [across, up]
        ends = at[:, sides] + ARROW * half * axis[:, sides]
        axes.update_datalim(ends)
        axes.margins(0.12)
        labels = [
            Label(str(number), tuple(point), tuple(-way))
            for number, (point, way) in enumerate(
                zip(at[:, sides].tolist(), axis[:, sides], strict=True), start=1
            )
        ]
        steps = np.linspace(0.0, 1.0, ARROW_POINTS)[:, None, None]
        arrows = (at[:, sides] + steps * (ends - at[:, sides])).reshape(-1, 2)
        named.append((axes, labels, np.vstack([candidates.position[:, sides], arrows])))
        middle = region.centre[0]
        if up == 1:
            side = half * np.array([-1, 1, 1, -1, -1])
            other = half * np.array([-1, -1, 1, 1, -1])
            axes.plot(middle + side, region.centre[1] + other, color='tab:brown', label='board')
        else:
            axes.plot(middle + half * np.array([-1, 1]), [0, 0], color='tab:brown', label='board')
        axes.set_aspect('equal', 'datalim')
        axes.locator_params(axis='x', nbins=5)
        axes.set_title(words)
        axes.set_xlabel('x / m')
        axes.set_ylabel(f'{"xyz"[up]} / m')
    axes = figure.add_subplot(1, 3, 3)
    counts = [len(design.coils) for design in designs]
    axes.plot(counts, [1e3 * design.error_m for design in designs], 's-', label='proposed')
    numbers = list(random)
    errors = [[1e3 * design.error_m for design in random[n]] for n in numbers]
    mean = np.array([np.mean(e) for e in errors])
    low, high = (np.array([pick(e) for e in errors]) for pick in (min, max))
    axes.errorbar(numbers, mean, [mean - low, high - mean], fmt='o', color='0.5', capsize=3,
                  label='random places, best to worst')  # fmt: skip
    axes.set_xscale('log', base=2)
    axes.set_yscale('log')
    spell_out(axes.yaxis)
    axes.set_xticks(numbers, [str(n) for n in numbers])
    axes.set_xlabel('reference coils')
    axes.set_ylabel('expected position error / mm')
    axes.grid(True, which='both', alpha=0.3)
    for legend_of in (figure.axes[0], axes):
        # Below, where no place and no error lies.
        legend_of.legend(fontsize=8, loc='upper center', bbox_to_anchor=(0.5, -0.14), ncols=2)
    figure.draw_without_rendering()
    for panel_axes, labels, drawn in named:
        name_points(panel_axes, labels, drawn, LETTERS_PT)
    save(figure, path)
