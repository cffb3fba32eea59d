"""Holds positions and directions of virtual dipoles, and maps their moments to readings."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.field.measurements import Measurements
from anser_ros.physics.dipole import flux_basis, flux_jacobian
from anser_ros.physics.sensor import along_each_axis

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


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
    """Return the article's matrix M for all readings, shape (F S, N), T / (A m^2)."""
    return flux_basis(*_rows(measurements), dipoles.positions, dipoles.directions)


def flux_slopes(
    measurements: Measurements, dipoles: DipoleSites, moments: ComplexArray
) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """Return modelled fluxes (F, S, K), T, and their derivatives (F, S, 3, K).

    These are by the sensors' centres (T/m) and axes (T).
    """
    rows, sites = _rows(measurements), (dipoles.positions, dipoles.directions)
    flux, by_place, by_axis = flux_jacobian(*rows, *sites, moments)
    shape = (len(measurements.time), len(measurements.sensors), 3, moments.shape[1])
    return flux.reshape(*shape[:2], -1), by_place.reshape(shape), by_axis.reshape(shape)


def _rows(measurements: Measurements) -> tuple[Array, Array, Array]:
    points, axes = measurements.placed()
    lengths = np.tile(measurements.sensors.length, len(points))
    return points.reshape(-1, 3), axes.reshape(-1, 3), lengths
