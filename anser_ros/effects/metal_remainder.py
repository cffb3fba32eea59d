"""What a simple metal body leaves: small scatterers about it, a few modes of them.

Not an effect of its own (no registry holds it): it belongs to the metal that it refines, so that
the corrected field is as good as the data allow while the metal's own parameters stay few. Each
point carries a scatterer along x, y and z (the field along the axis makes a moment along it); a
mode is a fixed combination of all of them, with a complex amplitude.
"""

import numpy as np

from anser_ros.effects.dipoles import Dipoles
from anser_ros.effects.effect import Array, ComplexArray, Effect, Remedy, Term, View
from anser_ros.effects.metal_body import UNIT, by_modes
from anser_ros.fitting.model import EffectRecord
from anser_ros.physics.constants import MU_0
from anser_ros.physics.dipole import flux_basis


class MetalRemainder(Effect):
    """theta: real, then imaginary parts of the modes' amplitudes."""

    name = 'metal_remainder'
    summary = 'what a simple metal body leaves'
    remedy = Remedy.FIELD

    def about(self, parent: Term, offsets: Array, modes: Array, size: float) -> Term:
        """A remainder of a metal effect.

        Parameters
        ----------
        parent : Term
            The metal, at rest.
        offsets : ndarray, shape (n, 3)
            Points in fg, m.
        modes : ndarray, shape (3 n, m)
            In units of 1e-4 m^3, axis by axis.
        size : float
            Prior standard deviation of an amplitude.
        """
        site = {
            'of': parent.effect.name, '_offsets': offsets, '_modes': modes, '_size': size,
            '_parent': parent.site,
        }  # fmt: skip
        return Term(self, site, np.zeros(2 * modes.shape[1]))

    def prior(self, term: Term) -> Array:
        """As given."""
        return np.full(term.theta.size, float(term.site['_size']))

    def _amplitudes(self, term: Term) -> ComplexArray:
        parts = term.theta.reshape(2, -1)
        return np.asarray(parts[0] + 1j * parts[1])

    def unit(self, term: Term, view: View) -> ComplexArray:
        """Flux of each mode, (F, S, K, m)."""
        offsets = term.site['_offsets']
        frames, sensors, emitters = view.flux.shape
        centres, axes, lengths = view.flat
        coupling = np.concatenate(
            [
                flux_basis(centres, axes, lengths, offsets, np.broadcast_to(e, offsets.shape))
                for e in np.eye(3)
            ],
            axis=1,
        )
        field = view.illumination.field(offsets).transpose(1, 0, 2).reshape(-1, emitters)
        lit = coupling[:, None, :] * field.T[None]
        unit = by_modes(lit, term.site['_modes']) * (UNIT / MU_0)
        return unit.reshape(frames, sensors, emitters, -1)

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """Linear."""
        unit = self.unit(term, view)
        return np.concatenate([unit, 1j * unit], axis=-1)

    def sources(
        self, term: Term, base: Dipoles, illumination: Dipoles, omega: Array
    ) -> Dipoles | None:
        """The modes' sum."""
        if not np.any(term.theta):
            return None
        offsets = term.site['_offsets']
        strength = (term.site['_modes'] @ self._amplitudes(term)).reshape(3, -1).T
        moments = illumination.field(offsets) * strength[..., None] * (UNIT / MU_0)
        return Dipoles.vectors(offsets, moments)

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        """Size only; the parent's record names the metal."""
        rms = float(np.sqrt(np.mean(term.theta**2)))
        return EffectRecord(self.name, {'of': term.site['of'], 'rms': rms})


REMAINDER = MetalRemainder()
