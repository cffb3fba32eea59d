"""An emitter is not where the model has it."""

from collections.abc import Sequence

import numpy as np

from anser_ros.effects.effect import Array, ComplexArray, Effect, Remedy, Term, needed, sigmas
from anser_ros.effects.view import Apparatus, View
from anser_ros.field.dipoles import Dipoles
from anser_ros.field.model import EffectRecord

GRADIENT_ERROR = 0.07
"""Relative error of what an emitter's shift changes at a reference close to it, where the field's
gradient is known less well than the field. Smaller lets references outvote the tools with
gradients that the model only guesses; larger leaves the shift to the tools alone."""


class CoilMoved(Effect[Term]):
    """Theta is the shift of one emitter, m, frame fg."""

    name = 'coil_moved'
    summary = 'an emitter is not where the model has it'
    units = {'coil': '1', 'shift_m': 'm'}
    plausible = {'shift_m': (-0.03, 0.03)}
    remedy = Remedy.FIELD
    gradient_error = GRADIENT_ERROR

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Return a candidate for every emitter."""
        return [Term(self, {'coil': k}, np.zeros(3)) for k in range(apparatus.emitters)]

    def prior(self, term: Term) -> Array:
        """Return a prior spread of 3 mm: emitters shift by some millimetres."""
        return np.full(3, 3e-3)

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """Move the sensor the other way, which does the same as moving the source."""
        coil = term.site['coil']
        out = view.columns(3)
        out[:, :, coil] = -np.moveaxis(view.d_position[..., coil], 2, -1)
        return out

    def sources(
        self, term: Term, base: Dipoles, illumination: Dipoles, omega: Array
    ) -> Dipoles | None:
        """Return the emitter at its new place, less the one at the old."""
        return self._shifted(term, base)

    def light(self, term: Term, illumination: Dipoles) -> Dipoles:
        """Shift the emitter in the field that metal sees, too."""
        return illumination.joined(self._shifted(term, illumination))

    @staticmethod
    def _shifted(term: Term, base: Dipoles) -> Dipoles:
        only = np.zeros_like(base.moments)
        only[:, term.site['coil']] = base.moments[:, term.site['coil']]
        used = np.flatnonzero(np.abs(only).any(axis=1))
        place, direction, moment = base.positions[used], base.directions[used], only[used]
        return Dipoles(place + term.theta, direction, moment).joined(
            Dipoles(place, direction, -moment)
        )

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        """Record the emitter and its shift, m."""
        return EffectRecord(
            self.name,
            {'coil': term.site['coil'], 'shift_m': term.theta.tolist()},
            {'shift_m': sigmas(covariance).tolist()},
        )

    def term(self, record: EffectRecord) -> Term:
        """Read the emitter and its shift, m, from a record."""
        shift = np.asarray(needed(record, 'shift_m'), dtype=np.float64)
        return Term(self, {'coil': int(needed(record, 'coil'))}, shift)


EFFECTS = (CoilMoved(),)
