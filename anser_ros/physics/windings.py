"""Computes the fluxes of sensors that are weighted sums of points: loops, and gradiometers.

A table is taken apart into points, each with the axis of its sensor; the kernels of `dipole` work
on these, and the points of each sensor are summed up again. A single coil is one point with its
length.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.physics.dipole import flux_basis, flux_jacobian
from anser_ros.physics.sensor import SensorTable

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PlacedPoints:
    """Holds the P points of S sensors of a body at one pose, sensor by sensor."""

    # points, axes: (P, 3), m, and unit vectors, frame fg
    points: Array
    axes: Array
    # lengths, weights: (P,), m; factor of each point's flux density
    lengths: Array
    weights: Array
    arms: Array  # (P, 3), from the sensor's place to the point, m, frame fg
    first: NDArray[np.int64]  # (S,), the first point of each sensor

    @staticmethod
    def of(sensors: SensorTable, position: Array, rotation: Array) -> 'PlacedPoints':
        """Return the points of a table's sensors, its body at a position (3,) and rotation
        (3, 3).
        """
        centres, axes = sensors.placed(position, rotation)
        row, arm = np.arange(len(sensors)), np.zeros((len(sensors), 3))
        weight = np.ones(len(sensors))
        if sensors.windings is not None:
            given, is_sum = sensors.windings, sensors.windings.is_sum
            used = np.where(is_sum[:, None], given.weight != 0.0, False)
            used[~is_sum, 0] = True
            row, column = np.nonzero(used)
            arm = np.where(is_sum[row, None], given.offset[row, column] @ rotation.T, 0.0)
            weight = np.where(is_sum[row], given.weight[row, column], 1.0)
        return PlacedPoints(
            centres[row] + arm, axes[row], sensors.length[row], weight, arm,
            np.searchsorted(row, np.arange(len(sensors))),
        )  # fmt: skip

    def summed(self, values: Array) -> Array:
        """Return what the sensors make (S, ...) of values of their points (P, ...)."""
        weight = self.weights.reshape(-1, *[1] * (values.ndim - 1))
        return np.asarray(np.add.reduceat(values * weight, self.first, axis=0))

    def basis(self, positions: Array, directions: Array) -> Array:
        """Return each sensor's flux (S, N), T/(A m^2), of N unit dipoles (m, unit vectors)."""
        rows = flux_basis(self.points, self.axes, self.lengths, positions, directions)
        return self.summed(rows)

    def slopes(self, positions: Array, directions: Array, moments: Array) -> tuple[Array, Array]:
        """Return the derivatives by a shift and a turn of each sensor about its own place.

        Each is of the shape (S, 3, C), T/m and T/rad, along and about the axes of fg, for each of
        C parts of the ``moments`` (N, C), A m^2, of dipoles at ``positions`` (m) with unit
        ``directions`` (N, 3).
        """
        by_place, by_axis = self._by_point(positions, directions, moments)
        turn = np.cross(self.arms[:, :, None], by_place, axis=1)
        turn = turn + np.cross(self.axes[:, :, None], by_axis, axis=1)
        return self.summed(by_place), self.summed(turn)

    def shifts(self, positions: Array, directions: Array, moments: Array) -> Array:
        """Return the first of `slopes` alone."""
        return self.summed(self._by_point(positions, directions, moments)[0])

    def _by_point(
        self, positions: Array, directions: Array, moments: Array
    ) -> tuple[Array, Array]:
        """Derivatives (P, 3, C) of each point's flux by its place and its axis."""
        # The kernel takes complex columns: two real ones make one.
        pairs = np.zeros((len(moments), 2 * ((moments.shape[1] + 1) // 2)))
        pairs[:, : moments.shape[1]] = moments
        _, by_place, by_axis = flux_jacobian(
            self.points, self.axes, self.lengths, positions, directions,
            np.ascontiguousarray(pairs).view(np.complex128),
        )  # fmt: skip
        shape, count = (len(self.points), 3, pairs.shape[1]), moments.shape[1]
        place = np.ascontiguousarray(by_place).view(np.float64).reshape(shape)
        axis = np.ascontiguousarray(by_axis).view(np.float64).reshape(shape)
        return place[:, :, :count], axis[:, :, :count]
