"""All sensors of a tool share a gain that is off, as behind one amplifier; references don't."""

from collections.abc import Sequence

import numpy as np

from anser_ros.effects.apparatus import Apparatus
from anser_ros.effects.complex_gain import GainOfChannels, theta_of
from anser_ros.effects.effect import whole_numbers
from anser_ros.effects.term import Term
from anser_ros.field.model import EffectRecord


class ToolGain(GainOfChannels):
    """Is the complex gain of all of a tool's channels."""

    name = 'tool_gain'
    summary = "the gain that all of a tool's sensors share is off"
    units = {'channels': '1', 'gain': '1', 'phase_deg': 'deg'}

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Return a candidate for every body with two sensors or more."""
        return [
            Term(self, {'channels': tuple(int(c) for c in table.channel)}, np.zeros(2))
            for table in apparatus.tools
            if len(table) > 1
        ]

    def term(self, record: EffectRecord) -> Term:
        """Return the term of a gain and a phase."""
        return Term(self, {'channels': whole_numbers(record, 'channels')}, theta_of(record))


EFFECTS = (ToolGain(),)
