"""Plain dipoles with a column of moments for each emitter: what a field is made of."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.physics.dipole import field_basis, flux_basis

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class Dipoles:
    """N dipoles: positions (m) and unit directions (N, 3), moments (N, K) in A m^2, frame fg."""

    positions: Array
    directions: Array
    moments: ComplexArray

    @staticmethod
    def none(emitters: int) -> 'Dipoles':
        """No dipole at all."""
        empty = np.zeros((0, 3))
        return Dipoles(empty, empty, np.zeros((0, emitters), dtype=complex))

    @staticmethod
    def vectors(points: Array, moments: ComplexArray) -> 'Dipoles':
        """Dipoles with vector moments: points (M, 3), moments (M, 3, K); three rows a point."""
        count = points.shape[0]
        return Dipoles(
            np.repeat(points, 3, axis=0),
            np.tile(np.eye(3), (count, 1)),
            np.ascontiguousarray(moments.reshape(3 * count, -1)),
        )

    def joined(self, other: 'Dipoles') -> 'Dipoles':
        """These dipoles and the others."""
        return Dipoles(
            np.concatenate([self.positions, other.positions]),
            np.concatenate([self.directions, other.directions]),
            np.concatenate([self.moments, other.moments]),
        )

    def field(self, points: Array) -> ComplexArray:
        """Field of each emitter at each point, shape (P, 3, K), T."""
        basis = field_basis(points, self.positions, self.directions)
        return np.asarray(np.einsum('pnc,nk->pck', basis, self.moments, optimize=True))

    def flux(self, points: Array, axes: Array, lengths: Array | None) -> ComplexArray:
        """Flux density along each sensor's axis, shape (P, K), T."""
        basis = flux_basis(points, axes, lengths, self.positions, self.directions)
        return np.asarray(basis @ self.moments)
