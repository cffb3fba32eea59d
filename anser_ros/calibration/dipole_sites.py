"""Holds positions and directions of virtual dipoles, and maps their moments to readings."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.field.measurements import Measurements
from anser_ros.physics.dipole import flux_basis
from anser_ros.physics.sensor import along_each_axis

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DipoleSites:
    """Holds positions (m) and unit directions of N virtual dipoles, shape (N, 3), frame fg."""

    positions: Array
    directions: Array

    def __len__(self) -> int:
        return int(self.positions.shape[0])

    @staticmethod
    def of_any_direction(places: Array) -> 'DipoleSites':
        """Return three dipoles, along x, y and z, at each of P places (P, 3), m."""
        return DipoleSites(*along_each_axis(places))

    def joined(self, other: 'DipoleSites') -> 'DipoleSites':
        """Return these dipoles, then the others."""
        return DipoleSites(
            np.concatenate([self.positions, other.positions]),
            np.concatenate([self.directions, other.directions]),
        )


def basis_rows(measurements: Measurements, dipoles: DipoleSites) -> Array:
    """Return the article's matrix M for all readings, shape (F S, N), T / (A m^2).

    Parameters
    ----------
    measurements : Measurements
        F frames of S sensors, each with a pose.
    dipoles : DipoleSites
        N dipoles.
    """
    points, axes = measurements.placed()
    lengths = np.tile(measurements.sensors.length, len(measurements.time))
    return flux_basis(
        points.reshape(-1, 3), axes.reshape(-1, 3), lengths, dipoles.positions, dipoles.directions
    )
