"""Sums the fields of sets of magnetic dipoles that have one moment for each emitter."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.physics.dipole import dipole_field, flux_basis
from anser_ros.physics.sensor import along_each_axis

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class Dipoles:
    """Holds a set of N dipoles with one moment for each of K emitters."""

    # positions, directions: (N, 3), positions (m) and unit directions, frame fg
    positions: Array
    directions: Array
    # (N, K), moments along the directions at each emitter's nominal current, A m^2
    moments: ComplexArray

    @staticmethod
    def none(emitters: int) -> 'Dipoles':
        """Return the empty set for a number of emitters."""
        empty = np.zeros((0, 3))
        return Dipoles(empty, empty, np.zeros((0, emitters), dtype=complex))

    @staticmethod
    def vectors(points: Array, moments: ComplexArray) -> 'Dipoles':
        """Return dipoles with vector moments (M, 3, K), A m^2: rows x, y, z of each point (m)."""
        flat = np.ascontiguousarray(moments.reshape(3 * len(points), -1))
        return Dipoles(*along_each_axis(points), flat)

    def joined(self, other: 'Dipoles') -> 'Dipoles':
        """Return the union of these dipoles and the others."""
        return Dipoles(
            np.concatenate([self.positions, other.positions]),
            np.concatenate([self.directions, other.directions]),
            np.concatenate([self.moments, other.moments]),
        )

    def field(self, points: Array) -> ComplexArray:
        """Return each emitter's field, shape (P, 3, K), T, at points, shape (P, 3), m."""
        return dipole_field(points, self.positions, self.directions, self.moments)

    def flux(self, points: Array, axes: Array, lengths: Array | None) -> ComplexArray:
        """Return each emitter's flux density (P, K), T, along sensors' axes.

        Sensor centres (m) and unit axes (P, 3) are in the frame fg; no ``lengths`` are those of
        points.
        """
        basis = flux_basis(points, axes, lengths, self.positions, self.directions)
        return np.asarray(basis @ self.moments)
