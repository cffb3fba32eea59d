"""A piece of metal seen from outside: one polarisability that all emitters illuminate.

The induced moment at a point is ``alpha B_k / mu0`` with the same alpha (m^3, complex) for every
emitter k. An extended body is stood for by isotropic scatterers at its centre and on shells about
it (which span the isotropic multipoles, so that a sphere's true centre fits best), and by the five
traceless tensors at its centre (for what is longer one way than another).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.dipoles import Dipoles
from anser_ros.physics.constants import DIPOLE_CONSTANT, MU_0

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

NEGLIGIBLE = 1e-4
UNIT = 1e-4
"""Polarisabilities count in 1e-4 m^3; a perfectly conducting ball of 25 mm has -1."""


def _sphere_points() -> tuple[Array, Array]:
    """Lebedev's rule with 26 points: unit vectors and weights, exact to degree 7."""
    corners, weights = [], []
    for v in np.ndindex(3, 3, 3):
        point = np.array(v, dtype=np.float64) - 1
        kind = int(np.abs(point).sum())
        if kind:
            corners.append(point / np.linalg.norm(point))
            weights.append({1: 1 / 21, 2: 4 / 105, 3: 9 / 280}[kind])
    return np.array(corners), np.array(weights)


SPHERE_POINTS, SPHERE_WEIGHTS = _sphere_points()
TRACELESS = np.array(
    [
        [[1, 0, 0], [0, -1, 0], [0, 0, 0]],
        [[1, 0, 0], [0, 1, 0], [0, 0, -2]],
        [[0, 1, 0], [1, 0, 0], [0, 0, 0]],
        [[0, 0, 1], [0, 0, 0], [1, 0, 0]],
        [[0, 0, 0], [0, 0, 1], [0, 1, 0]],
    ],
    dtype=np.float64,
)


@dataclass(frozen=True)
class BodyShape:
    """Scatterers about a centre, gathered in groups that share one polarisability each.

    Attributes
    ----------
    offsets : ndarray, shape (n, 3)
        From the body's centre, m.
    tensors : ndarray, shape (g, n, 3, 3)
        Each group's tensor at every point; group g's moments are ``alpha_g tensors[g] B / mu0``.
    """

    offsets: Array
    tensors: Array

    @property
    def groups(self) -> int:
        """Number of complex polarisabilities."""
        return int(self.tensors.shape[0])

    @staticmethod
    def ball(radii: tuple[float, ...] = (0.025,)) -> 'BodyShape':
        """Centre and shells, each isotropic, and the centre's traceless tensors."""
        offsets = np.concatenate([np.zeros((1, 3))] + [r * SPHERE_POINTS for r in radii])
        count = offsets.shape[0]
        groups = [np.zeros((count, 3, 3)) for _ in range(1 + len(radii) + len(TRACELESS))]
        groups[0][0] = np.eye(3)
        for shell in range(len(radii)):
            rows = slice(1 + shell * len(SPHERE_POINTS), 1 + (shell + 1) * len(SPHERE_POINTS))
            groups[1 + shell][rows] = SPHERE_WEIGHTS[:, None, None] * np.eye(3)
        for i, tensor in enumerate(TRACELESS):
            groups[1 + len(radii) + i][0] = tensor
        return BodyShape(offsets, np.array(groups))

    @staticmethod
    def point() -> 'BodyShape':
        """One isotropic scatterer."""
        return BodyShape(np.zeros((1, 3)), np.eye(3)[None, None])

    @staticmethod
    def cloud(offsets: Array) -> 'BodyShape':
        """Independent isotropic scatterers."""
        count = offsets.shape[0]
        tensors = np.zeros((count, count, 3, 3))
        tensors[np.arange(count), np.arange(count)] = np.eye(3)
        return BodyShape(offsets, tensors)

    def complex_polarisability(self, alpha: Array) -> ComplexArray:
        """(g,) complex, m^3, from real and imaginary parts in `UNIT` (2 g,)."""
        parts = alpha.reshape(2, -1) * UNIT
        return np.asarray(parts[0] + 1j * parts[1])

    def sources(self, centre: Array, alpha: Array, illumination: Dipoles) -> Dipoles:
        """Induced dipoles of the body at a place (m)."""
        points = centre + self.offsets
        field = illumination.field(points)
        tensors = np.einsum('g,gnij->nij', self.complex_polarisability(alpha), self.tensors)
        return Dipoles.vectors(points, np.einsum('nij,njk->nik', tensors, field) / MU_0)

    def responses(self, centre: Array, illumination: Dipoles) -> tuple[Array, ComplexArray]:
        """Scatterers (n, 3) and moments (g, n, 3, K) of a unit polarisability of each group."""
        points = centre + self.offsets
        field = illumination.field(points)
        return points, np.einsum('gnij,njk->gnik', self.tensors, field) * (UNIT / MU_0)

    def total(self, alpha: Array) -> ComplexArray:
        """The body's whole dipole polarisability, shape (3, 3), m^3."""
        tensors = self.tensors.sum(axis=1)
        return np.asarray(np.einsum('g,gij->ij', self.complex_polarisability(alpha), tensors))


def group_flux(
    points: Array, moments: ComplexArray, centres: Array, axes: Array, lengths: Array
) -> ComplexArray:
    """Flux (P, K, g) of scatterers (n, 3) with the moments (g, n, 3, K) of g groups."""
    sources = Dipoles.vectors(points, np.moveaxis(moments, 0, -1).reshape(len(points), 3, -1))
    flux = sources.flux(centres, axes, lengths)
    return flux.reshape(len(centres), -1, moments.shape[0])


def scatterer_coupling(points: Array, centres: Array, axes: Array) -> Array:
    """Flux of unit moments along x, y, z at points that are elsewhere in every frame.

    Parameters
    ----------
    points : ndarray, shape (F, n, 3)
    centres, axes : ndarray, shape (F, S, 3)
        Sensors, taken as points.

    Returns
    -------
    ndarray, shape (F, S, n, 3)
        T / (A m^2).
    """
    d = centres[:, :, None, :] - points[:, None, :, :]
    r2 = np.einsum('fsni,fsni->fsn', d, d)
    inverse3 = DIPOLE_CONSTANT / (r2 * np.sqrt(r2))
    along = np.einsum('fsni,fsi->fsn', d, axes) * (3 * inverse3 / r2)
    # n . B of a moment m is m . (3 (n.d) d / d^5 - n / d^3).
    return np.asarray(along[..., None] * d - inverse3[..., None] * axes[:, :, None, :])


def by_modes(lit: ComplexArray, modes: Array) -> ComplexArray:
    """Fluxes of single scatterers (..., n) gathered into modes (n, m): (..., m)."""
    flat = lit.reshape(-1, lit.shape[-1])
    out = np.zeros((flat.shape[0], modes.shape[1]), dtype=complex)
    out.real = np.ascontiguousarray(flat.real) @ modes
    # Emitters drive in phase with their current: the other part is mostly nothing at all.
    if np.abs(flat.imag).max(initial=0.0) > NEGLIGIBLE * np.abs(flat.real).max(initial=0.0):
        out.imag = np.ascontiguousarray(flat.imag) @ modes
    return out.reshape(*lit.shape[:-1], modes.shape[1])
