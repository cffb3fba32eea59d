"""One sensor's complex gain is off."""

from collections.abc import Sequence

import numpy as np

from anser_ros.effects.apparatus import Apparatus
from anser_ros.effects.complex_gain import GainOfChannels, theta_of
from anser_ros.effects.effect import needed
from anser_ros.effects.term import Term
from anser_ros.field.model import EffectRecord


class SensorGain(GainOfChannels):
    """Is the complex gain of one channel."""

    name = 'sensor_gain'
    summary = "one sensor's gain is off"
    units = {'channel': '1', 'gain': '1', 'phase_deg': 'deg'}

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Return a term for every channel, references too."""
        return [Term(self, {'channel': c}, np.zeros(2)) for c in apparatus.channels]

    def term(self, record: EffectRecord) -> Term:
        """Return the term of a gain and a phase."""
        return Term(self, {'channel': int(needed(record, 'channel'))}, theta_of(record))


EFFECTS = (SensorGain(),)
