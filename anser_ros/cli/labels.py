"""Names points of a picture, so that no name lies on another one, or on what is drawn."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.text import Text
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

DISTANCES_PT = (4.0, 8.0, 14.0, 22.0, 32.0, 44.0)
"""Distances of a name from its point that are tried, points."""
LEADER_PT = 14.0
"""Distance from which on a thin line leads from a name to its point, points."""
DIRECTIONS = 16
"""Directions about a point in which its name is tried."""
MARGIN_PT = 2.0
"""Least distance of a name from another one and from what is drawn, points."""
POINTS_PER_INCH = 72.0
"""A point is a 72nd of an inch."""


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
    dots = figure.dpi / POINTS_PER_INCH
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
    """Shift of a name from its point, pixels, and its distance, points: the nearest free one, in
    the direction that is nearest to the wanted one.
    """
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
