"""Metal of the tests: fields of dipoles, and the moments that bodies take in them."""

import numpy as np

from anser_ros.physics.constants import DIPOLE_CONSTANT
from anser_ros.physics.dipole import dipole_rows, field_basis, fill_fields


def dipole_field(points, positions, moments):
    """Return the sum (P, 3) of the fields of dipoles with vector moments, T."""
    return field_basis(points, positions, moments).sum(axis=1)


def dipole_gradient(points, positions, moments):
    """Return ``dB_j / dx_i``, shape (P, 3, 3), of the same, T/m."""
    basis = np.empty((len(points), 9, len(positions)))
    fill_fields(points, dipole_rows(positions, moments), basis)
    xx, xy, xz, yy, yz, zz = basis[:, 3:].sum(axis=2).T
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]).transpose(2, 0, 1)


def dipole_tensor(points, sources):
    """Return the field at points per vector moment at sources; zero where both are the same."""
    d = points[:, None] - sources[None]
    square = np.einsum('psi,psi->ps', d, d)
    same = square == 0.0
    square = np.where(same, 1.0, square)
    tensor = 3.0 * np.einsum('psi,psj->psij', d, d) / square[..., None, None] - np.eye(3)
    tensor *= (DIPOLE_CONSTANT * square**-1.5)[..., None, None]
    tensor[same] = 0.0
    return tensor


def induced_moments(positions, polarisability, field):
    """Return the moments (Q, K, 3) of bodies that drive each other in the fields of K emitters.

    The polarisability (A m^2 / T) is one a body, or one a body and emitter; `field` (Q, K, 3) is
    each emitter's where the bodies lie.
    """
    at = np.asarray(positions, dtype=float)
    alpha = np.asarray(polarisability, dtype=complex)
    if alpha.ndim == 1:
        alpha = np.broadcast_to(alpha[:, None], field.shape[:2])
    moments = alpha[:, :, None] * field
    tensor, size = dipole_tensor(at, at), 3 * len(at)
    for k in range(field.shape[1]):
        back = alpha[:, k, None, None, None] * tensor
        matrix = np.eye(size) - back.swapaxes(1, 2).reshape(size, size)
        moments[:, k] = np.linalg.solve(matrix, moments[:, k].reshape(size)).reshape(-1, 3)
    return moments
