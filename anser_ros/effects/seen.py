"""Effects that are seen in the residuals, with one number that says how much: noise, outliers."""

from collections.abc import Sequence
from dataclasses import dataclass

from anser_ros.effects.effect import Array, Effect, Family, Site, Term, needed, recorded_site
from anser_ros.field.model import EffectRecord


@dataclass(frozen=True, kw_only=True)
class SeenTerm(Term):
    """States how much of an effect there is, on the channels of its site, or on all."""

    amount: float  # What the effect's first parameter is
    sigma: float = 0.0  # Its standard deviation


class SeenEffect(Effect[SeenTerm]):
    """Is found in what is left, and corrects nothing; its first parameter says how much."""

    family = Family.SEEN

    @property
    def _key(self) -> str:
        return next(iter(self.units))

    def record(self, term: SeenTerm, covariance: Array) -> EffectRecord:
        """Record the number, and the channels where not all have the effect."""
        parameters = {self._key: term.amount, **recorded_site(term)}
        return EffectRecord(self.name, parameters, {self._key: term.sigma})

    def term(self, record: EffectRecord) -> SeenTerm:
        """Read the number from a record."""
        return SeenTerm(self, amount=float(needed(record, self._key)))

    def seen(self, amount: float, sigma: float, channels: Sequence[int] = ()) -> SeenTerm:
        """Return the effect on some channels, or on all where none are named."""
        site: Site = {'channels': tuple(channels)} if channels else {}
        return SeenTerm(self, site, amount=amount, sigma=sigma)


class ExcessNoise(SeenEffect):
    """Is found from the residuals' spread once they show no structure (`anser_ros.diagnosis`)."""

    name = 'excess_noise'
    summary = 'the noise is larger than it should be, and nothing else'
    units = {'factor': '1', 'channels': '1'}
    plausible = {'factor': (1.0, 1000.0)}


class Outliers(SeenEffect):
    """Is found as frames that stand out from their neighbours in time (`anser_ros.diagnosis`)."""

    name = 'outliers'
    summary = 'some frames fit no model'
    units = {'fraction': '1', 'channels': '1'}
    plausible = {'fraction': (0.0, 0.5)}


class LooseContact(Outliers):
    """Does what `Outliers` does, where always the same channels stand out."""

    name = 'loose_contact'
    summary = 'single readings of a channel fail now and then'


EXCESS_NOISE, OUTLIERS, LOOSE_CONTACT = ExcessNoise(), Outliers(), LooseContact()
EFFECTS = EXCESS_NOISE, OUTLIERS, LOOSE_CONTACT


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
