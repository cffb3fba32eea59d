"""One sensor's complex gain is off."""

from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.apparatus import Apparatus
from anser_ros.effects.complex_gain import figures_of, theta_of
from anser_ros.effects.effect import Array, ComplexArray, Effect, Remedy, needed, unit_matrix
from anser_ros.effects.term import Term
from anser_ros.effects.view import View
from anser_ros.field.model import EffectRecord


class SensorGain(Effect[Term]):
    """Theta is the real and imaginary part of (gain - 1)."""

    name = 'sensor_gain'
    summary = "one sensor's gain is off"
    units: ClassVar[Mapping[str, str]] = {'channel': '1', 'gain': '1', 'phase_deg': 'deg'}
    plausible: ClassVar[Mapping[str, tuple[float, float]]] = {
        'gain': (0.2, 3.0),
        'phase_deg': (-60.0, 60.0),
    }
    remedy = Remedy.FLUX

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Return a term for every channel, references too."""
        return [Term(self, {'channel': c}, np.zeros(2)) for c in apparatus.channels]

    def prior(self, term: Term) -> Array:
        """Expect a gain within some ten percent of one."""
        return np.full(2, 0.3)

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """Return the channel's own flux, in phase and turned by a quarter."""
        row = view.row(term.site['channel'])
        if row is None:
            return None
        out = view.columns(2)
        gain = 1 + term.theta[0] + 1j * term.theta[1]
        own = view.linear[:, row] / gain
        out[:, row, :, 0], out[:, row, :, 1] = own, 1j * own
        return out

    def channel_matrix(self, term: Term, channels: NDArray[np.int64]) -> ComplexArray:
        """Return a unit matrix with the channel's complex gain on its diagonal."""
        matrix = unit_matrix(channels.size)
        for row in np.flatnonzero(channels == term.site['channel']):
            matrix[row, row] = 1 + term.theta[0] + 1j * term.theta[1]
        return matrix

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        """Record the gain's size and phase."""
        figures, sigmas = figures_of(term.theta, covariance)
        return EffectRecord(self.name, {'channel': term.site['channel'], **figures}, sigmas)

    def term(self, record: EffectRecord) -> Term:
        """Return the term of a gain and a phase."""
        return Term(self, {'channel': int(needed(record, 'channel'))}, theta_of(record))


EFFECTS = (SensorGain(),)
