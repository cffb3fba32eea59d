"""Plugs in wrong sockets: channels or emitters exchanged, turned round, or receiving nothing.
None has a parameter to fit; they are found before the search (`anser_ros.diagnosis.screening`).
"""

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.effect import (
    Array,
    ComplexArray,
    Effect,
    Family,
    Remedy,
    Term,
    unit_matrix,
)
from anser_ros.field.model import EffectRecord


class Wiring(Effect[Term]):
    """Has no parameter: its site, which is all lists of numbers, says what is wired how."""

    family = Family.SEEN

    def term(self, record: EffectRecord) -> Term:
        """Read the channels or emitters, and those that they are read as, from a record."""
        return Term(self, self.site_of(record))


class SwappedChannels(Wiring):
    """Reads each of ``channels`` at the place of the one in ``read_as``."""

    name = 'swapped_channels'
    summary = 'sensors are plugged into each other'
    units = {'channels': '1', 'read_as': '1'}
    remedy = Remedy.FLUX

    def channel_matrix(self, term: Term, channels: NDArray[np.int64]) -> ComplexArray:
        """Return a permutation; channels of which one is missing stay as they are."""
        row = {int(c): i for i, c in enumerate(channels)}
        matrix = unit_matrix(channels.size)
        if not all(c in row for c in term.site['channels']):
            return matrix
        for shown, true in zip(term.site['read_as'], term.site['channels'], strict=True):
            matrix[row[shown]] = 0.0
            matrix[row[shown], row[true]] = 1.0
        return matrix


class SwappedCoils(Wiring):
    """Shows each emitter of ``coils`` in the place of the one in ``read_as``."""

    name = 'swapped_coils'
    summary = 'emitters are plugged into each other'
    units = {'coils': '1', 'read_as': '1'}
    remedy = Remedy.FLUX

    def emitter_matrix(self, term: Term, time: Array, omega: Array) -> ComplexArray:
        """Return the emitters' permutation as a matrix."""
        matrix = unit_matrix(omega.size)
        for shown, true in zip(term.site['read_as'], term.site['coils'], strict=True):
            matrix[shown] = 0.0
            matrix[shown, true] = 1.0
        return matrix[None]


class DeadChannel(Wiring):
    """Silences channels whose readings are noise; they take no part in anything."""

    name = 'dead_channel'
    summary = 'a channel receives nothing'
    units = {'channels': '1'}

    def silenced(self, term: Term) -> tuple[int, ...]:
        """Return all channels that the term names."""
        return term.channels


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


SWAPPED_CHANNELS, SWAPPED_COILS, DEAD_CHANNEL = SwappedChannels(), SwappedCoils(), DeadChannel()
SENSOR_POLARITY = SensorPolarity()
EFFECTS = SWAPPED_CHANNELS, SWAPPED_COILS, DEAD_CHANNEL, SENSOR_POLARITY
