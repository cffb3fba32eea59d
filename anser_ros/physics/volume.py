"""Defines the tracked volume: the box over the board in which tools are tracked.

The refit corrects the field in it, and the tracker gives poses in it. The setup document states it
(key ``volume``); otherwise it follows from the board's size, see `over_board`.
"""

from dataclasses import dataclass

import numpy as np

from anser_ros.arrays import Array
from anser_ros.errors import TrackingError

FLOOR, CEILING, REACH = 0.345, 2.3, 1.3225
"""The default volume, in halves of the board's larger side: heights over the board from which and
up to which tools are tracked, and how far to the side of its middle (`docs/refit.md`)."""
STEP_M = 0.01
"""The default is rounded to whole centimetres, so that similar boards have the same volume."""


@dataclass(frozen=True)
class TrackedVolume:
    """Describes a box, m, frame fg; the default is that over an Anser board.

    It is what `over_board` makes of the demo's board (`test/test_setup.py`), for setups whose
    board cannot be drawn. Raises `TrackingError` when the corners make no box.
    """

    low: tuple[float, float, float] = (-0.2, -0.2, 0.05)  # below ``high`` in x, y and z
    high: tuple[float, float, float] = (0.2, 0.2, 0.35)

    def __post_init__(self) -> None:
        box = np.array([self.low, self.high], dtype=np.float64)
        if box.shape != (2, 3) or not np.isfinite(box).all() or not (box[1] > box[0]).all():
            raise TrackingError(
                f'a volume needs low < high in x, y, z, got {self.low}, {self.high}'
            )

    @classmethod
    def over_board(cls, centre: Array, half: float) -> 'TrackedVolume':
        """Return the default volume over a board with its middle at ``centre`` (2,), m.

        ``half`` is half of the board's larger side, m.
        """
        middle, reach = np.asarray(centre, dtype=np.float64), REACH * half
        low, high = (*(middle - reach), FLOOR * half), (*(middle + reach), CEILING * half)
        steps = np.round(np.array([low, high]) / STEP_M)
        steps[0, 2] = max(steps[0, 2], 1.0)  # a small board's floor must stay over its plane
        steps[1] = np.maximum(steps[1], steps[0] + 1.0)
        (x, y, z), (u, v, w) = np.round(steps * STEP_M, 9).tolist()
        return cls((x, y, z), (u, v, w))

    @property
    def middle(self) -> Array:
        """Return the x and y of the middle of the box, m, shape (2,)."""
        return np.array([(a + b) / 2.0 for a, b in zip(self.low[:2], self.high[:2], strict=True)])

    @property
    def reach(self) -> Array:
        """Return half of the box's sides along x and y, m, shape (2,)."""
        return np.array([(b - a) / 2.0 for a, b in zip(self.low[:2], self.high[:2], strict=True)])

    @property
    def ceiling(self) -> float:
        """Return the height over the board up to which tools are tracked, m."""
        return self.high[2]

    def contains(self, position: Array) -> bool:
        """Return whether a position (m) lies in the box."""
        sides = zip(self.low, position.tolist(), self.high, strict=True)
        return all(low <= place <= high for low, place, high in sides)

    def grown(self, margin_m: float) -> tuple[Array, Array]:
        """Return the corners with a margin around the box; the floor keeps half of its height.

        The field of a flat board is mirrored at its plane, so a solver must not cross it.
        """
        low, high = np.array(self.low) - margin_m, np.array(self.high) + margin_m
        if self.low[2] > 0:
            low[2] = max(low[2], 0.5 * self.low[2])
        return low, high

    def samples(self, across: int = 6, up: int = 5, part: float = 1.0) -> Array:
        """Return points of the box, shape (across^2 up, 3), m, denser near the board.

        The heights form a geometric series, or an even one where the box reaches below the board.
        The points fill a part of the box: its sides and its ceiling are scaled by it.
        """
        floor, top = self.low[2], part * self.ceiling
        x, y = (
            np.linspace(-part, part, across) * reach + middle
            for reach, middle in zip(self.reach, self.middle, strict=True)
        )
        share = np.linspace(0.0, 1.0, up)
        height = floor * (top / floor) ** share if floor > 0 else floor + (top - floor) * share
        x, y, z = np.meshgrid(x, y, height, indexing='ij')
        return np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
