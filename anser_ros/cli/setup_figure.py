"""Draws a setup document: board, references and volume from above and the side, and tools."""

from collections import defaultdict
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from anser_ros.pictures import save
from anser_ros.sessions.drawing import Drawing
from anser_ros.sessions.volume import pose_volume
from anser_ros.wire.setup import SensorSpec, Setup

SIDES = ((0, 1, 'from above'), (0, 2, 'from the side'))
"""Panels: the two coordinates that each shows, and its title."""
ARROW = 0.08
"""Length of a coil's axis as drawn, as a part of what the panel shows."""
SMALLEST_MM = 5.0
"""Least extent of a tool as drawn, mm: one of a single coil has none."""


def draw_setup(setup: Setup, path: Path) -> None:
    """Draw the board with references and tracked volume, and each tool in its own frame."""
    rows = 1 + len(setup.bodies)
    figure, panels = plt.subplots(
        rows, 2, figsize=(10, 4.6 * rows), layout='constrained', squeeze=False
    )
    for panel, (across, up, title) in zip(panels[0], SIDES, strict=True):
        _board(panel, setup, across, up)
        _sensors(panel, setup.reference_sensors, across, up, 'C1', names=False)
        panel.set_title(f'board, {title}')
    for line, body in zip(panels[1:], setup.bodies, strict=True):
        coils = tuple(sensor for sensor in setup.sensors if sensor.body == body)
        for panel, (across, up, title) in zip(line, SIDES, strict=True):
            _sensors(panel, coils, across, up, 'C2', names=True)
            panel.plot(0, 0, '+', color='0.4')
            panel.set_title(f'{body}, {title}')
    for line in panels:
        for panel, (across, up, _) in zip(line, SIDES, strict=True):
            panel.set(xlabel=f'{"xyz"[across]}, mm', ylabel=f'{"xyz"[up]}, mm')
            panel.set_aspect('equal', adjustable='datalim')
            panel.grid(alpha=0.3)
    save(figure, path)


def _board(panel: Any, setup: Setup, across: int, up: int) -> None:
    board = Drawing.of(setup).board
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
    volume = pose_volume(setup)
    low, high = 1e3 * np.array(volume.low), 1e3 * np.array(volume.high)
    size = high - low
    panel.add_patch(
        Rectangle((low[across], low[up]), size[across], size[up], fill=False, ls='--', color='0.5')
    )
    panel.annotate('tracked volume', (low[across], high[up]), fontsize=7, color='0.4', va='bottom')


def _sensors(
    panel: Any,
    sensors: tuple[SensorSpec, ...],
    across: int,
    up: int,
    colour: str,
    *,
    names: bool,
) -> None:
    if not sensors:
        return
    place = 1e3 * np.array([sensor.position_m for sensor in sensors])
    axis = np.array([sensor.axis for sensor in sensors])
    reach = np.vstack([place, np.zeros((1, 3))])
    size = ARROW * max(float(np.ptp(reach, axis=0).max()), SMALLEST_MM)
    if names:
        size *= 3.0
    panel.quiver(
        place[:, across], place[:, up], size * axis[:, across], size * axis[:, up],
        angles='xy', scale_units='xy', scale=1.0, color=colour, width=0.004,
    )  # fmt: skip
    panel.plot(place[:, across], place[:, up], 'o', ms=3, color=colour)
    ends: NDArray[np.float64] = place + size * axis
    together: defaultdict[tuple[float, ...], list[str]] = defaultdict(list)
    for sensor, end in zip(sensors, ends, strict=True):
        words = f'{sensor.name} ({sensor.channel})' if names else str(sensor.channel)
        together[tuple(end[[across, up]].round(3).tolist())].append(words)
    foot = {tuple(one[[across, up]].round(3).tolist()) for one in place}
    for end, several in together.items():
        # What points at the viewer is named on the other side of its foot.
        side, level = (-3, 'top') if end in foot else (3, 'bottom')
        panel.annotate(
            '\n'.join(several), end, (side, side), textcoords='offset points', fontsize=6,
            ha='right' if end in foot else 'left', va=level,
        )  # fmt: skip
    panel.update_datalim(ends[:, [across, up]])
    panel.margins(0.4 if names else 0.1)
    panel.autoscale_view()
