"""An emitter is stronger or weaker than the model has it, all the time."""

from collections.abc import Sequence

import numpy as np

from anser_ros.effects.apparatus import Apparatus
from anser_ros.effects.complex_gain import ComplexGain, theta_of
from anser_ros.effects.effect import Array, ComplexArray, needed, unit_matrix
from anser_ros.effects.term import Term
from anser_ros.effects.view import View
from anser_ros.field.model import EffectRecord


class CoilGain(ComplexGain):
    """Is the complex gain of one emitter."""

    name = 'coil_gain'
    summary = "an emitter's strength is not the calibrated one"
    units = {'coil': '1', 'gain': '1', 'phase_deg': 'deg'}

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Return a candidate for every emitter."""
        return [Term(self, {'coil': k}, np.zeros(2)) for k in range(apparatus.emitters)]

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """Return the emitter's own flux, for the real and the imaginary part of its gain."""
        own = view.linear[:, :, term.site['coil']] / (1 + complex(*term.theta))
        out = view.columns(2)
        out[:, :, term.site['coil'], 0], out[:, :, term.site['coil'], 1] = own, 1j * own
        return out

    def emitter_matrix(self, term: Term, time: Array, omega: Array) -> ComplexArray:
        """Return a unit matrix with the emitter's complex gain on its diagonal."""
        matrix = unit_matrix(omega.size)
        matrix[term.site['coil'], term.site['coil']] = 1 + complex(*term.theta)
        return matrix[None]

    def term(self, record: EffectRecord) -> Term:
        """Return the term of a gain and a phase."""
        return Term(self, {'coil': int(needed(record, 'coil'))}, theta_of(record))


EFFECTS = (CoilGain(),)
