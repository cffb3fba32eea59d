"""Some sensors are wired the other way round."""

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.effect import ComplexArray, Remedy
from anser_ros.effects.term import Term
from anser_ros.effects.wiring import Wiring


class SensorPolarity(Wiring):
    """Turns the channels' signs round, without a parameter."""

    name = 'sensor_polarity'
    summary = 'a sensor is wired the other way round'
    units = {'channels': '1'}
    remedy = Remedy.FLUX

    def channel_matrix(self, term: Term, channels: NDArray[np.int64]) -> ComplexArray:
        """Return a diagonal matrix with -1 for every reversed channel."""
        signs = np.where(np.isin(channels, term.site['channels']), -1.0, 1.0)
        return np.diag(signs).astype(complex)


SENSOR_POLARITY = SensorPolarity()
EFFECTS = (SENSOR_POLARITY,)
