"""All sensors of a tool share a gain that is off, as behind one amplifier; references don't."""

from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.apparatus import Apparatus
from anser_ros.effects.complex_gain import figures_of, theta_of
from anser_ros.effects.effect import Array, ComplexArray, Effect, Remedy, whole_numbers
from anser_ros.effects.term import Term
from anser_ros.effects.view import View
from anser_ros.field.model import EffectRecord


class ToolGain(Effect[Term]):
    """Theta is the real and imaginary part of (gain - 1)."""

    name = 'tool_gain'
    summary = "the gain that all of a tool's sensors share is off"
    units: ClassVar[Mapping[str, str]] = {'channels': '1', 'gain': '1', 'phase_deg': 'deg'}
    plausible: ClassVar[Mapping[str, tuple[float, float]]] = {
        'gain': (0.2, 3.0),
        'phase_deg': (-60.0, 60.0),
    }
    remedy = Remedy.FLUX

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Return a candidate for every body with two sensors or more."""
        return [
            Term(self, {'channels': tuple(int(c) for c in table.channel)}, np.zeros(2))
            for table in apparatus.tools
            if len(table) > 1
        ]

    def prior(self, term: Term) -> Array:
        """Expect a gain within some ten percent of one."""
        return np.full(2, 0.3)

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """Return the channels' own flux, in phase and turned by a quarter."""
        rows = np.isin(view.sensors.channel, term.site['channels'])
        if not rows.any():
            return None
        out = view.columns(2)
        own = view.linear[:, rows] / (1 + complex(*term.theta))
        out[:, rows] = np.stack([own, 1j * own], axis=-1)
        return out

    def channel_matrix(self, term: Term, channels: NDArray[np.int64]) -> ComplexArray:
        """Return the gain of the tool's channels on the diagonal."""
        own = np.isin(channels, term.site['channels'])
        return np.diag(np.where(own, 1 + complex(*term.theta), 1.0))

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        """Record the gain's size and phase."""
        figures, sigmas = figures_of(term.theta, covariance)
        return EffectRecord(
            self.name, {'channels': list(term.site['channels']), **figures}, sigmas
        )

    def term(self, record: EffectRecord) -> Term:
        """Return the term of a gain and a phase."""
        return Term(self, {'channels': whole_numbers(record, 'channels')}, theta_of(record))


EFFECTS = (ToolGain(),)
