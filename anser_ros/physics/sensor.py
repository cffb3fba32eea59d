"""Pick-up coils as a table: which channel, on which body, where, along which axis, how long."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LARGEST_FLUX_T = 1.0
"""A reading with a component beyond this is absurd, T."""


@dataclass(frozen=True)
class SensorTable:
    """S coils, a row each.

    Attributes
    ----------
    channel : ndarray, shape (S,)
    name, body : tuple of str, length S
    position, axis : ndarray, shape (S, 3)
        Centre (m) and unit sensitive axis in the frame of the sensor's body.
    length : ndarray, shape (S,)
        Coil length along its axis, m; 0 for a point.
    """

    channel: NDArray[np.int64]
    name: tuple[str, ...]
    body: tuple[str, ...]
    position: Array
    axis: Array
    length: Array

    def __len__(self) -> int:
        return len(self.name)

    def select(self, rows: Sequence[int] | NDArray[np.generic]) -> 'SensorTable':
        """The rows named by index or mask, in that order."""
        index = np.arange(len(self))[np.asarray(rows)]
        return SensorTable(
            channel=self.channel[index],
            name=tuple(self.name[i] for i in index),
            body=tuple(self.body[i] for i in index),
            position=self.position[index],
            axis=self.axis[index],
            length=self.length[index],
        )

    def of_body(self, body: str) -> 'SensorTable':
        """The rows on one body."""
        return self.select([i for i, name in enumerate(self.body) if name == body])

    def with_geometry(
        self, position: Array | None = None, axis: Array | None = None, length: Array | None = None
    ) -> 'SensorTable':
        """The same sensors with other positions, axes or lengths."""
        return replace(
            self,
            position=self.position if position is None else position,
            axis=self.axis if axis is None else axis,
            length=self.length if length is None else length,
        )

    def placed(self, position: Array, rotation: Array) -> tuple[Array, Array]:
        """Centres and axes in fg when the body has a pose.

        Parameters
        ----------
        position : ndarray, shape (..., 3)
            Body origin in fg, m.
        rotation : ndarray, shape (..., 3, 3)
            Body axes in fg (columns).

        Returns
        -------
        centres, axes : ndarray, shape (..., S, 3)
        """
        turned = np.einsum('...ij,sj->...si', rotation, self.position)
        return turned + position[..., None, :], np.einsum('...ij,sj->...si', rotation, self.axis)
