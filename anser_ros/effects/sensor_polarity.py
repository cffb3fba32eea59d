"""Some sensors are wired the other way round."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.effect import Array, ComplexArray, Effect, Family, Remedy, whole_numbers
from anser_ros.effects.term import Term
from anser_ros.field.model import EffectRecord


class SensorPolarity(Effect[Term]):
    """Turns the channels' signs round, without a parameter."""

    name = 'sensor_polarity'
    summary = 'a sensor is wired the other way round'
    units: ClassVar[Mapping[str, str]] = {'channels': '1'}
    remedy = Remedy.FLUX
    family = Family.SEEN

    def channel_matrix(self, term: Term, channels: NDArray[np.int64]) -> ComplexArray:
        """Return a diagonal matrix with -1 for every reversed channel."""
        signs = np.where(np.isin(channels, term.site['channels']), -1.0, 1.0)
        return np.diag(signs).astype(complex)

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        """Record the channels that are reversed."""
        return EffectRecord(self.name, {'channels': list(term.site['channels'])})

    def term(self, record: EffectRecord) -> Term:
        """Read the channels that are reversed from a record."""
        channels = whole_numbers(record, 'channels')
        return Term(self, {'channels': channels})


SENSOR_POLARITY = SensorPolarity()
EFFECTS = (SENSOR_POLARITY,)
