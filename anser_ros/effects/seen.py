"""Holds what effects share that are seen in the residuals, with one number that says how much."""

from collections.abc import Sequence
from dataclasses import dataclass

from anser_ros.effects.effect import Array, Effect, Family, Remedy, needed
from anser_ros.effects.term import Site, Term
from anser_ros.field.model import EffectRecord


@dataclass(frozen=True, kw_only=True)
class SeenTerm(Term):
    """States how much of an effect there is, on the channels of its site, or on all."""

    # amount, sigma: What the effect's first parameter is, and its standard deviation
    amount: float
    sigma: float = 0.0


class SeenEffect(Effect[SeenTerm]):
    """Is found in what is left, and corrects nothing; its first parameter says how much."""

    remedy = Remedy.NONE
    family = Family.SEEN

    @property
    def _key(self) -> str:
        return next(iter(self.units))

    def record(self, term: SeenTerm, covariance: Array) -> EffectRecord:
        """Record the number, and the channels where not all have the effect."""
        parameters: dict[str, object] = {self._key: term.amount}
        if 'channels' in term.site:
            parameters['channels'] = list(term.site['channels'])
        return EffectRecord(self.name, parameters, {self._key: term.sigma})

    def term(self, record: EffectRecord) -> SeenTerm:
        """Read the number from a record."""
        return SeenTerm(self, amount=float(needed(record, self._key)))

    def seen(self, amount: float, sigma: float, channels: Sequence[int] = ()) -> SeenTerm:
        """Return the effect on some channels, or on all where none are named."""
        site: Site = {'channels': tuple(channels)} if channels else {}
        return SeenTerm(self, site, amount=amount, sigma=sigma)
