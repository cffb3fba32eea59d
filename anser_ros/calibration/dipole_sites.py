"""Virtual dipoles as places, and the matrix that turns their moments into readings."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.field.measurements import Measurements
from anser_ros.physics.dipole import flux_basis

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DipoleSites:
    """Where virtual dipoles are: positions (m, frame fg) and unit directions, shape (N, 3)."""

    positions: Array
    directions: Array

    def __len__(self) -> int:
        return int(self.positions.shape[0])


def basis_rows(measurements: Measurements, dipoles: DipoleSites) -> Array:
    """The article's matrix M at the measurements' poses, shape (F S, N), T / (A m^2)."""
    points, axes = measurements.placed()
    lengths = np.tile(measurements.sensors.length, len(measurements.time))
    return flux_basis(
        points.reshape(-1, 3), axes.reshape(-1, 3), lengths, dipoles.positions, dipoles.directions
    )
