"""Sums the fields of sets of dipoles, and finds the axis about which a set may be turned.

The octupole of sources on an axis, about their middle, is that of their second moment: the mean
square distance from the middle, weighted by the moments. It is negative where moments beside the
middle are of the opposite sign, as those are that stand for a flat coil.
"""

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


OFF_AXIS = 1e-6
"""Moment across the axis, as a fraction of the whole, and distance from the axis as a fraction of
a metre, up to which a dipole is on it: far below what anybody can measure."""
STEP_M = 1e-3
"""Way along the axis over which a second derivative is a difference, m. Its relative error is 2.5
times the square of the way over the distance of the sensor, 0.3 % at 3 cm; a far smaller way makes
moments so large that rounding is seen."""


@dataclass(frozen=True)
class SymmetryAxis:
    """Describes an axis of rotation that leaves a field as it is."""

    # (3,), the middle of the sources on it, m, frame fg: that of their moments, about which their
    # field has no quadrupole
    point: Array
    direction: Array  # (3,), unit vector; the first emitter's moment points along it
    second_moment_m2: float  # Of the sources about the middle, along the axis, m^2


def symmetry_axis(
    positions: Array, directions: Array, moments: NDArray[np.complex128]
) -> SymmetryAxis | None:
    """Return the axis on which all dipoles lie and along which all moments point, if there is one.

    Positions (m) and unit directions (N, 3) are in the frame fg, moments (N, K) in A m^2.
    """
    size = np.abs(moments)
    strong = size > OFF_AXIS * size.max()
    used = strong.any(axis=1)
    if not used.any():
        return None
    places = positions[used]
    vectors = (moments.real @ np.ones(moments.shape[1]))[:, None] * directions
    total = vectors.sum(axis=0)
    if np.linalg.norm(total) < OFF_AXIS * size.sum():
        return None
    axis = total / np.linalg.norm(total)
    weight = vectors[used] @ axis
    middle = weight @ places / weight.sum()
    away = places - middle
    along = away @ axis
    away -= np.outer(along, axis)
    if np.abs(away).max() > OFF_AXIS:
        return None
    # Dipoles at one place count together: three components of one vector may point anywhere.
    whole = np.einsum('nk,ni->ki', moments, directions)
    keys = np.round(places / OFF_AXIS).astype(np.int64)
    for place in np.unique(keys, axis=0):
        here = np.flatnonzero(used)[(keys == place).all(axis=1)]
        vector = np.einsum('nk,ni->ki', moments[here], directions[here])
        across = vector - np.einsum('ki,i->k', vector, axis)[:, None] * axis
        if np.linalg.norm(across) > OFF_AXIS * np.linalg.norm(whole):
            return None
    return SymmetryAxis(middle, axis, float(weight @ along**2 / weight.sum()))


def spread_along(base: Dipoles, emitter: int, axis: Array, second_moment_m2: float) -> Dipoles:
    """Return dipoles that give an emitter a second moment along an axis besides its own.

    Their field is half the second moment times the second derivative, along the axis, of the
    field that the emitter has by ``base``: three dipoles, without a moment together, for each.
    """
    only = np.zeros_like(base.moments)
    only[:, emitter] = base.moments[:, emitter] * (second_moment_m2 / (2.0 * STEP_M**2))
    used = np.flatnonzero(only.any(axis=1))
    place, moments, step = base.positions[used], only[used], STEP_M * axis
    return Dipoles(
        np.concatenate([place + step, place, place - step]),
        np.tile(base.directions[used], (3, 1)),
        np.concatenate([moments, -2.0 * moments, moments]),
    )


def size_parameters(
    second_moment_m2: float, sigma_m2: float
) -> tuple[dict[str, float], dict[str, float]]:
    """Return a second moment with the size of a source that has it, and their uncertainties.

    A positive one is that of a thin magnet, along its axis, of length L, L^2 / 12; a negative one
    that of a flat disc of diameter D, magnetised across, -D^2 / 16.
    """
    key, share = ('length_m', 12.0) if second_moment_m2 >= 0.0 else ('diameter_m', 16.0)
    size = float(np.sqrt(share * abs(second_moment_m2)))
    # Near zero a size is known only to be below the root of its square's uncertainty.
    sigma = share * sigma_m2 / max(2.0 * size, np.sqrt(share * sigma_m2), 1e-300)
    return (
        {'second_moment_m2': second_moment_m2, key: size},
        {'second_moment_m2': sigma_m2, key: float(sigma)},
    )
