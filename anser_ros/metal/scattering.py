"""Models what metal makes of a field: a symmetric operator between a few shapes of field.

Points about a piece of metal carry functionals that take the amplitudes of some shapes out of a
field. Emitter k's field has the amplitudes ``b_k``; whatever the metal is made of, it answers with
``a_k = T b_k``, the same T for every emitter at one frequency, and by reciprocity a sensor reads
``g_s . a_k`` with ``g_s`` the amplitudes of the field that a unit dipole in the sensor's place
would make there. T is symmetric, and its entries are the couplings of pairs of shapes.

Skin depths change with the frequency f: some couplings may have a part that grows as log f.
Couplings count in 1e-4 m^3.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.arrays import Array, ComplexArray, Integers, as_complex, as_real
from anser_ros.field.model import Dipoles
from anser_ros.kernel_cache import kernel
from anser_ros.physics.constants import DIPOLE_CONSTANT, MU_0
from anser_ros.physics.dipole import GAUSS_OFFSET

NEGLIGIBLE = 1e-4
"""Share of the emitters' field that may lie in quadrature and is left out."""
UNIT = 1e-4
"""Couplings count in 1e-4 m^3; a perfectly conducting ball of 25 mm has the polarisability -1."""


@dataclass(frozen=True, eq=False)
class Shapes:
    """Holds shapes of a field about a centre, and the pairs of them that metal couples."""

    offsets: Array  # (n, 3), from the centre, m
    # (M, n, 3), amplitude i is the sum of ``functionals[i]`` times the field at the offsets
    functionals: Array
    first: Integers  # (P,), a shape of each pair
    second: Integers  # (P,), the other shape, first <= second
    # The pairs, by index, whose coupling may have a part that grows as log f
    sloped: Integers

    @property
    def local(self) -> bool:
        """Return whether the shapes are field components at points, each answering alone."""
        return len(self.functionals) == 3 * len(self.offsets)

    @property
    def size(self) -> int:
        """Return how many couplings there are: the pairs', then the slopes with log f."""
        return int(self.first.size + self.sloped.size)

    def driven(self, field: ComplexArray) -> ComplexArray:
        """Return amplitudes (..., K, M) from the fields (..., n, 3, K) at the points."""
        shape = (*field.shape[:-3], -1, field.shape[-1])
        if self.local:
            return np.asarray(np.swapaxes(field.reshape(shape), -1, -2))
        flat = self.functionals.reshape(len(self.functionals), -1)
        return np.asarray(np.swapaxes(flat @ field.reshape(shape), -1, -2))

    def received(self, centre: Array, centres: Array, axes: Array, lengths: Array) -> Array:
        """Return amplitudes (..., S, M) of unit dipoles in the sensors' places, T / (A m^2).

        The ``centre`` has the shape (..., 3), the sensors' centres and axes (..., S, 3).
        """
        points = centre[..., None, :] + self.offsets
        if np.any(lengths):
            reach = (GAUSS_OFFSET * lengths)[:, None] * axes
            coupling = dipole_coupling(points, centres + reach, axes)
            coupling = 0.5 * (coupling + dipole_coupling(points, centres - reach, axes))
        else:
            coupling = dipole_coupling(points, centres, axes)
        coupling = coupling.reshape(*coupling.shape[:-2], -1)
        if self.local:
            return coupling
        return np.asarray(coupling @ self.functionals.reshape(len(self.functionals), -1).T)

    def mode_flux(
        self, ears: Array, drive: ComplexArray, modes: Array, omega: Array
    ) -> NDArray[np.inexact]:
        """Return the flux (..., S, K, m) of modes (`size`, m) of unit amplitude.

        ``ears`` has the shape (..., S, M), ``drive`` (..., K, M), ``omega`` (K,).
        """
        light: NDArray[np.inexact] = drive
        if np.abs(drive.imag).max() <= NEGLIGIBLE * np.abs(drive.real).max():
            # Emitters drive in phase with their current: the other part is nothing at all.
            light = drive.real
        if self.local:
            unit = ears[..., :, None, :] * (light[..., None, :, :] * (UNIT / MU_0))
            return np.asarray(unit @ modes)
        count, shapes = modes.shape[1], len(self.functionals)
        whole = self._operators(modes[: self.first.size])
        made = light @ whole
        if np.any(modes[self.first.size :]):
            slope = np.zeros((self.first.size, count))
            slope[self.sloped] = modes[self.first.size :]
            made = made + tilt(omega)[:, None] * (light @ self._operators(slope))
        # (..., K, M m) to (..., M, K m)
        made = np.moveaxis(made.reshape(*made.shape[:-1], shapes, count), -3, -2)
        made = made.reshape(*made.shape[:-3], shapes, -1) * (UNIT / MU_0)
        if np.iscomplexobj(made):
            flux = as_complex(ears @ as_real(made))
        else:
            flux = ears @ made
        return np.asarray(flux.reshape(*flux.shape[:-1], omega.size, count))

    def _operators(self, modes: Array) -> Array:
        """Each mode's T from modes of pairs (P, m), side by side: (M, M m)."""
        shapes, count = len(self.functionals), modes.shape[1]
        out = np.zeros((shapes, shapes, count))
        share = np.where(self.first == self.second, 1.0, np.sqrt(0.5))[:, None]
        out[self.first, self.second] = share * modes
        out[self.second, self.first] = share * modes
        return out.reshape(shapes, -1)

    def answer(self, drive: ComplexArray, couplings: ComplexArray, omega: Array) -> ComplexArray:
        """Return the amplitudes (..., K, M) that these couplings make of a drive (..., K, M)."""
        if self.local:
            return drive * (couplings * (UNIT / MU_0))
        count = self.first.size
        out: ComplexArray = drive @ self.matrix(couplings[:count])
        if np.any(couplings[count:]):
            slope = np.zeros(count, dtype=complex)
            slope[self.sloped] = couplings[count:]
            out = out + tilt(omega)[:, None] * (drive @ self.matrix(slope))
        return out * (UNIT / MU_0)

    def matrix(self, couplings: ComplexArray) -> ComplexArray:
        """Return T (M, M) from the couplings of the pairs (P,)."""
        out = np.zeros((len(self.functionals),) * 2, dtype=complex)
        out[self.first, self.second] = couplings
        return np.where(np.eye(len(out), dtype=bool), out, (out + out.T) / np.sqrt(2))

    def polarisability(self, couplings: ComplexArray) -> ComplexArray:
        """Return the moment in a uniform field over that field / mu0, shape (3, 3), m^3."""
        uniform = self.functionals.sum(axis=1)
        return np.asarray(uniform.T @ self.matrix(couplings[: self.first.size]) @ uniform * UNIT)

    def flux(
        self, ears: Array, drive: ComplexArray, couplings: ComplexArray, omega: Array
    ) -> ComplexArray:
        """Return the flux (..., S, K) of metal with these couplings."""
        made = np.swapaxes(self.answer(drive, couplings, omega), -1, -2)
        # Real and imaginary by turns: a product of real matrices takes half the time.
        return as_complex(ears @ as_real(made))

    def sources(
        self, centre: Array, couplings: ComplexArray, illumination: Dipoles, omega: Array
    ) -> Dipoles:
        """Return the dipoles about a centre (m) that stand for metal with these couplings."""
        points = centre + self.offsets
        made = self.answer(self.driven(illumination.field(points)), couplings, omega)
        return Dipoles.vectors(points, np.einsum('mni,km->nik', self.functionals, made))


def both_phases(unit: NDArray[np.inexact]) -> ComplexArray:
    """Return columns (..., m) in phase, then in quadrature, (..., 2 m)."""
    return np.concatenate([unit, 1j * unit], axis=-1)


def tilt(omega: Array) -> Array:
    """Return the logarithm of each emitter's frequency, less the mean of all, shape (K,)."""
    logs = np.log(omega)
    return np.asarray(logs - logs.mean())


def dipole_coupling(points: Array, centres: Array, axes: Array) -> Array:
    """Return the flux of unit moments along x, y, z at points (..., n, 3) in sensors, T / (A m^2).

    Sensors (..., S, 3) are taken as points; the result has the shape (..., S, n, 3).
    """
    frames = centres.shape[:-2]
    place = np.broadcast_to(points, (*frames, *points.shape[-2:])).reshape(-1, *points.shape[-2:])
    flat = [np.ascontiguousarray(a.reshape(-1, *a.shape[-2:])) for a in (centres, axes)]
    out = np.empty((*flat[0].shape[:2], points.shape[-2], 3))
    _fill_coupling(np.ascontiguousarray(place), flat[0], flat[1], out)
    return out.reshape(*frames, *out.shape[1:])


@kernel(nogil=True)
def _fill_coupling(points, centres, axes, out):  # type: ignore[no-untyped-def]
    """n . B of a moment m is m . (3 (n . d) d / d^5 - n / d^3)."""
    for f in range(centres.shape[0]):
        for s in range(centres.shape[1]):
            nx, ny, nz = axes[f, s, 0], axes[f, s, 1], axes[f, s, 2]
            for p in range(points.shape[1]):
                dx = centres[f, s, 0] - points[f, p, 0]
                dy = centres[f, s, 1] - points[f, p, 1]
                dz = centres[f, s, 2] - points[f, p, 2]
                inv2 = 1.0 / (dx * dx + dy * dy + dz * dz)
                inv3 = DIPOLE_CONSTANT * inv2 * math.sqrt(inv2)
                along = 3.0 * (nx * dx + ny * dy + nz * dz) * inv2
                out[f, s, p, 0] = inv3 * (along * dx - nx)
                out[f, s, p, 1] = inv3 * (along * dy - ny)
                out[f, s, p, 2] = inv3 * (along * dz - nz)
