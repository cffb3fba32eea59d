"""Effects that are seen directly, without a parameter to fit: wiring, noise, outliers.

Plugs in wrong sockets are found before the search (`anser_ros.diagnosis.screening`), noise and
outliers in what it leaves, with one number that says how much.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from anser_ros.arrays import Array, ComplexArray, Integers
from anser_ros.effects.effect import Effect, Family, Remedy, Site, Term
from anser_ros.field.model import EffectRecord


class Wiring(Effect[Term]):
    """Has no parameter: its site, which is all lists of numbers, says what is wired how."""

    family = Family.SEEN

    def term(self, record: EffectRecord) -> Term:
        return Term(self, self.site_of(record))


def _exchanged(size: int, shown: Sequence[int], true: Sequence[int]) -> ComplexArray:
    """Return the matrix that shows rows in the place of others, (size, size)."""
    order = np.arange(size)
    order[list(shown)] = true
    return np.eye(size, dtype=complex)[order]


class SwappedChannels(Wiring):
    """Reads each of ``channels`` at the place of the one in ``read_as``."""

    name = 'swapped_channels'
    summary = 'sensors are plugged into each other'
    units = {'channels': '1', 'read_as': '1'}
    remedy = Remedy.FLUX

    def channel_matrix(self, term: Term, channels: Integers) -> ComplexArray:
        """Return a permutation; channels of which one is missing stay as they are."""
        row = {int(c): i for i, c in enumerate(channels)}
        if not all(c in row for c in term.site['channels']):
            return np.eye(channels.size, dtype=complex)
        shown, true = ([row[c] for c in term.site[key]] for key in ('read_as', 'channels'))
        return _exchanged(channels.size, shown, true)


class SwappedCoils(Wiring):
    """Shows each emitter of ``coils`` in the place of the one in ``read_as``."""

    name = 'swapped_coils'
    summary = 'emitters are plugged into each other'
    units = {'coils': '1', 'read_as': '1'}
    remedy = Remedy.FLUX

    def emitter_matrix(self, term: Term, time: Array, omega: Array) -> ComplexArray:
        return _exchanged(omega.size, term.site['read_as'], term.site['coils'])[None]


class DeadChannel(Wiring):
    """Silences channels whose readings are noise; they take no part in anything."""

    name = 'dead_channel'
    summary = 'a channel receives nothing'
    units = {'channels': '1'}

    def silenced(self, term: Term) -> tuple[int, ...]:
        return term.channels


class SensorPolarity(Wiring):
    """Turns the channels' signs round, without a parameter."""

    name = 'sensor_polarity'
    summary = 'a sensor is wired the other way round'
    units = {'channels': '1'}
    remedy = Remedy.FLUX

    def channel_matrix(self, term: Term, channels: Integers) -> ComplexArray:
        signs = np.where(np.isin(channels, term.site['channels']), -1.0, 1.0)
        return np.diag(signs).astype(complex)


class CoilPolarity(Wiring):
    """Turns the emitters' signs round, without a parameter."""

    name = 'coil_polarity'
    summary = 'an emitter is wired the other way round'
    units = {'coils': '1'}
    remedy = Remedy.FLUX

    def emitter_matrix(self, term: Term, time: Array, omega: Array) -> ComplexArray:
        signs = np.where(np.isin(np.arange(omega.size), term.site['coils']), -1.0, 1.0)
        return np.diag(signs).astype(complex)[None]


SWAPPED_CHANNELS, SWAPPED_COILS, DEAD_CHANNEL = SwappedChannels(), SwappedCoils(), DeadChannel()
SENSOR_POLARITY, COIL_POLARITY = SensorPolarity(), CoilPolarity()


@dataclass(frozen=True, kw_only=True)
class SeenTerm(Term):
    """States how much of an effect there is, on the channels of its site, or on all."""

    amount: float  # What the effect's first parameter is
    sigma: float = 0.0  # Its standard deviation


class SeenEffect(Effect[SeenTerm]):
    """Is found in what is left, and corrects nothing; its first parameter says how much."""

    family = Family.SEEN

    def __init__(
        self, name: str, summary: str, units: Mapping[str, str], plausible: tuple[float, float]
    ) -> None:
        self.name, self.summary, self.units, self._key = name, summary, units, next(iter(units))
        self.plausible = {self._key: plausible}

    def record(self, term: SeenTerm, covariance: Array) -> EffectRecord:
        parameters = {self._key: term.amount, **term.recorded_site}
        return EffectRecord(self.name, parameters, {self._key: term.sigma})

    def term(self, record: EffectRecord) -> SeenTerm:
        return SeenTerm(self, amount=float(record.needed(self._key)))

    def seen(self, amount: float, sigma: float, channels: Sequence[int] = ()) -> SeenTerm:
        """Return the effect on some channels, or on all where none are named."""
        site: Site = {'channels': tuple(channels)} if channels else {}
        return SeenTerm(self, site, amount=amount, sigma=sigma)


EXCESS_NOISE = SeenEffect(
    'excess_noise', 'the noise is larger than it should be, and nothing else',
    {'factor': '1', 'channels': '1'}, (1.0, 1000.0),
)  # fmt: skip
OUTLIERS, LOOSE_CONTACT = (
    SeenEffect(name, summary, {'fraction': '1', 'channels': '1'}, (0.0, 0.5))
    for name, summary in (
        ('outliers', 'some frames fit no model'),
        ('loose_contact', 'single readings of a channel fail now and then'),
    )
)


def known_share(records: Sequence[EffectRecord]) -> float:
    """Return the share of frames that a model's records know to stand out in every session."""
    return sum(
        float(record.parameters.get('fraction', 0.0))
        for record in records
        if record.name == OUTLIERS.name
    )


def outliers_of(fraction: float, sigma: float, channels: Sequence[int]) -> SeenTerm:
    """Return outliers in whole frames, or of some channels, which is what a loose contact does."""
    return (LOOSE_CONTACT if channels else OUTLIERS).seen(fraction, sigma, channels)


EFFECTS = (
    SWAPPED_CHANNELS, SWAPPED_COILS, DEAD_CHANNEL, SENSOR_POLARITY, COIL_POLARITY,
    EXCESS_NOISE, OUTLIERS, LOOSE_CONTACT,
)  # fmt: skip
