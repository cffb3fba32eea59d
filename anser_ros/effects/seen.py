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
    """Has no parameter: its site, which is all lists of numbers, says what is wired how.

    What ``read_as`` names takes the place of what the site names first; without it, the signs of
    the latter are turned round.
    """

    family = Family.SEEN
    remedy = Remedy.FLUX

    def __init__(self, name: str, summary: str, *keys: str) -> None:
        self.name, self.summary = name, summary
        self.units, self._of = dict.fromkeys(keys, '1'), keys[0]

    def term(self, record: EffectRecord) -> Term:
        return Term(self, self.site_of(record))

    def matrix(self, term: Term, numbers: Integers) -> ComplexArray:
        """Return what is read (rows) of what is there; as it is where a number is missing."""
        shown = np.eye(numbers.size, dtype=complex)
        named = term.recorded_site[self._of]
        if 'read_as' not in term.site:
            return shown * np.where(np.isin(numbers, named), -1.0, 1.0)
        if np.isin(named, numbers).all():
            row = {number: i for i, number in enumerate(numbers.tolist())}
            there, true = ([row[n] for n in some] for some in (term.site['read_as'], named))
            shown[there] = shown[true]
        return shown


class ChannelWiring(Wiring):
    """Reads channels in each other's place, or the other way round."""

    def channel_matrix(self, term: Term, channels: Integers) -> ComplexArray:
        return self.matrix(term, channels)


class CoilWiring(Wiring):
    """Shows emitters in each other's place, or the other way round."""

    def emitter_matrix(self, term: Term, time: Array, omega: Array) -> ComplexArray:
        return self.matrix(term, np.arange(omega.size))[None]


class DeadChannel(Wiring):
    """Silences channels whose readings are noise; they take no part in anything."""

    remedy = Remedy.NONE

    def silenced(self, term: Term) -> tuple[int, ...]:
        return term.channels


SWAPPED_CHANNELS = ChannelWiring(
    'swapped_channels', 'sensors are plugged into each other', 'channels', 'read_as'
)
SWAPPED_COILS = CoilWiring(
    'swapped_coils', 'emitters are plugged into each other', 'coils', 'read_as'
)
DEAD_CHANNEL = DeadChannel('dead_channel', 'a channel receives nothing', 'channels')
SENSOR_POLARITY = ChannelWiring(
    'sensor_polarity', 'a sensor is wired the other way round', 'channels'
)
COIL_POLARITY = CoilWiring('coil_polarity', 'an emitter is wired the other way round', 'coils')


@dataclass(frozen=True, kw_only=True)
class SeenTerm(Term):
    """States how much of an effect there is, on the channels of its site, or on all."""

    amount: float  # What the effect's first parameter is
    sigma: float = 0.0  # Its standard deviation


class SeenEffect(Effect[SeenTerm]):
    """Is found in what is left, and corrects nothing; its first parameter says how much."""

    family = Family.SEEN

    def __init__(self, name: str, summary: str, units: Mapping[str, str]) -> None:
        self.name, self.summary, self.units, self._key = name, summary, units, next(iter(units))

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
    {'factor': '1', 'channels': '1'},
)  # fmt: skip
OUTLIERS, LOOSE_CONTACT = (
    SeenEffect(name, summary, {'fraction': '1', 'channels': '1'})
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
