"""Holds the table of pick-up coils, and computes the fluxes of those that are sums of points.

A table is taken apart into points, each with the axis of its sensor; the kernels of `dipole` work
on these, and the points of each sensor are summed up again. A single coil is one point with its
length.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from anser_ros.arrays import AnyArray, Array, Booleans, Integers
from anser_ros.physics.dipole import flux_and_slopes, flux_basis

LARGEST_FLUX_T = 1.0
"""A component beyond this, T, is a fault of the electronics: emitters make microtesla at most."""

SAME_CENTRE_M = 2e-3
"""Sensors of a body closer than this (m) are one cluster: windings are within some 0.1 mm."""


@dataclass(frozen=True)
class Windings:
    """Holds sensors that are weighted sums of points, such as loops and gradiometers.

    A reading is the sum of each point's weight times the flux density there along the sensor's
    axis. Weights of a loop have the sum one, those of two coils wound against each other zero. A
    sensor with fewer points has further ones of weight zero.
    """

    offset: Array  # (S, Q, 3), from the sensor's position, m, in the frame of its body
    weight: Array  # (S, Q), zero in all of a row for a sensor that is a single coil

    @staticmethod
    def of(rows: Sequence[Sequence[Sequence[float]]]) -> 'Windings | None':
        """Return windings of a list of (x, y, z, weight) a sensor; None where all are empty."""
        most = max((len(row) for row in rows), default=0)
        if most == 0:
            return None
        table = np.zeros((len(rows), most, 4))
        for own, row in zip(table, rows, strict=True):
            own[: len(row)] = np.asarray(row, dtype=np.float64).reshape(-1, 4)
        return Windings(table[:, :, :3], table[:, :, 3])

    @property
    def is_sum(self) -> Booleans:
        """Return which sensors (S,) are a sum of points."""
        return np.asarray((self.weight != 0.0).any(axis=1))


ARRAYS, NAMES = ('channel', 'position', 'axis', 'length'), ('name', 'body')
"""Columns of a `SensorTable`, beside the windings."""


@dataclass(frozen=True)
class SensorTable:
    """Holds a table of S pick-up coils with one row each."""

    channel: Integers  # (S,), channel of the control unit that each coil is connected to
    name: tuple[str, ...]  # length S
    body: tuple[str, ...]  # length S, that each is fixed to; ``fg`` for reference sensors
    position: Array  # (S, 3), centre in the frame of the sensor's body, m
    axis: Array  # (S, 3), unit sensitive axis in that frame
    length: Array  # (S,), length of the coil along its axis, m; 0 for a point sensor
    # Points of the sensors that are sums of several; None where all are single coils
    windings: Windings | None = None

    @property
    def is_single(self) -> Booleans:
        """Return which sensors (S,) are single coils, not sums of points."""
        if self.windings is None:
            return np.ones(len(self), dtype=bool)
        return ~self.windings.is_sum

    def __len__(self) -> int:
        return len(self.name)

    def select(self, rows: Sequence[int] | AnyArray) -> 'SensorTable':
        """Return the table of the rows given by index or mask, in that order."""
        index = np.arange(len(self))[np.asarray(rows)]
        each: dict[str, Any] = {key: getattr(self, key)[index] for key in ARRAYS}
        each |= {key: tuple(getattr(self, key)[i] for i in index) for key in NAMES}
        own = self.windings
        return SensorTable(**each, windings=own and Windings(own.offset[index], own.weight[index]))

    def of_body(self, body: str) -> 'SensorTable':
        """Return the table of the sensors on one body."""
        return self.select([i for i, name in enumerate(self.body) if name == body])

    def joined(self, *others: 'SensorTable') -> 'SensorTable':
        """Return the table of these sensors followed by those of other tables."""
        tables = (self, *others)
        each: dict[str, Any] = {
            key: np.concatenate([getattr(table, key) for table in tables]) for key in ARRAYS
        }
        each |= {key: tuple(n for table in tables for n in getattr(table, key)) for key in NAMES}
        rows: list[Any] = []
        for table in tables:
            own = table.windings
            rows += [()] * len(table) if own is None else [*np.dstack([own.offset, own.weight])]
        return SensorTable(**each, windings=Windings.of(rows))

    def placed(self, position: Array, rotation: Array) -> tuple[Array, Array]:
        """Return centres (m) and unit axes (..., S, 3) in fg at poses of the sensors' body.

        ``position`` (..., 3) is its origin, m, ``rotation`` (..., 3, 3) from its frame to fg.
        """
        turned = np.einsum('...ij,sj->...si', rotation, self.position)
        return turned + position[..., None, :], np.einsum('...ij,sj->...si', rotation, self.axis)


def clusters_of(sensors: SensorTable) -> list[Integers]:
    """Return the rows of the sensors of each body that share a centre; most often one, or three.

    The first remaining row of a table starts a cluster of those near it.
    """
    groups = []
    for body in dict.fromkeys(sensors.body):
        left = np.array([row for row, name in enumerate(sensors.body) if name == body])
        while left.size:
            apart = np.linalg.norm(sensors.position[left] - sensors.position[left[0]], axis=1)
            groups.append(left[apart < SAME_CENTRE_M])
            left = left[apart >= SAME_CENTRE_M]
    return groups


def along_each_axis(places: Array) -> tuple[Array, Array]:
    """Return places and unit axes, (3 P, 3): along x, y and z at each of P places (P, 3), m."""
    return np.repeat(places, 3, axis=0), np.tile(np.eye(3), (len(places), 1))


@dataclass(frozen=True)
class PlacedPoints:
    """Holds the P points of S sensors of a body at one pose, sensor by sensor."""

    points: Array  # (P, 3), m, frame fg
    axes: Array  # (P, 3), unit vectors, frame fg
    lengths: Array  # (P,), m
    weights: Array  # (P,), factor of each point's flux density
    arms: Array  # (P, 3), from the sensor's place to the point, m, frame fg
    first: Integers  # (S,), the first point of each sensor

    @staticmethod
    def of(sensors: SensorTable, position: Array, rotation: Array) -> 'PlacedPoints':
        """Return a table's points, its body at a position (3,), m, and a rotation (3, 3)."""
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
        parts = self._by_point(positions, directions, moments)
        turn = np.cross(self.arms[:, :, None], parts[:, 1:4], axis=1)
        turn = turn + np.cross(self.axes[:, :, None], parts[:, 4:], axis=1)
        return self.summed(parts[:, 1:4]), self.summed(turn)

    def shifts(self, positions: Array, directions: Array, moments: Array) -> Array:
        """Return the first of `slopes` alone."""
        return self.summed(self._by_point(positions, directions, moments)[:, 1:4])

    def _by_point(self, positions: Array, directions: Array, moments: Array) -> Array:
        """Each point's flux and its derivatives by place and axis, (P, 7, C)."""
        return flux_and_slopes(
            self.points, self.axes, self.lengths, positions, directions, moments
        )
