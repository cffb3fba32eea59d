"""A common acquisition delay turns all phasors, the faster the higher their frequency."""

from collections.abc import Sequence

import numpy as np

from anser_ros.effects.effect import Array, ComplexArray, Effect, Remedy, Term
from anser_ros.effects.view import Apparatus, View

UNIT = 1e-6
"""theta counts microseconds."""


class PhaseDelay(Effect[Term]):
    """Theta is the delay d, us: a phasor at w becomes exp(-j w d) times itself."""

    name = 'phase_delay'
    summary = 'a common acquisition delay turns all phasors'
    units = {'delay_s': 's'}
    plausible = {'delay_s': (-5e-5, 5e-5)}
    remedy = Remedy.FLUX
    typical = 5.0  # delays are some microseconds
    recorded = {'delay_s': (1, UNIT)}

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Return one candidate, as one delay holds for all channels."""
        return [Term(self, {}, np.zeros(1))]

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """Return minus j omega times the flux, for a microsecond of delay."""
        return np.asarray((-1j * UNIT * view.omega * view.linear)[..., None])

    def emitter_matrix(self, term: Term, time: Array, omega: Array) -> ComplexArray:
        """Return the turn of each emitter's phasors on the diagonal."""
        return np.diag(np.exp(-1j * omega * term.theta[0] * UNIT))[None]


EFFECTS = (PhaseDelay(),)
