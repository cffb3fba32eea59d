"""Some frames are outliers, which no model of the field explains."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

from anser_ros.effects.effect import Array, Effect, Family, Remedy, needed
from anser_ros.effects.term import Term
from anser_ros.field.model import EffectRecord


@dataclass(frozen=True, kw_only=True)
class OutliersTerm(Term):
    """States how many frames stand out.

    Attributes
    ----------
    fraction, sigma : float
        Share of the frames, and its standard deviation.
    """

    fraction: float
    sigma: float = 0.0


class Outliers(Effect[OutliersTerm]):
    """Is found as frames that stand out from their neighbours in time (`anser_ros.diagnosis`)."""

    name = 'outliers'
    summary = 'some frames fit no model'
    units: ClassVar[Mapping[str, str]] = {'fraction': '1', 'channels': '1'}
    plausible: ClassVar[Mapping[str, tuple[float, float]]] = {'fraction': (0.0, 0.5)}
    remedy = Remedy.NONE
    family = Family.SEEN

    def record(self, term: OutliersTerm, covariance: Array) -> EffectRecord:
        """Record the share of frames, and the channels where not all have them."""
        parameters: dict[str, object] = {'fraction': term.fraction}
        if 'channels' in term.site:
            parameters['channels'] = list(term.site['channels'])
        return EffectRecord(self.name, parameters, {'fraction': term.sigma})

    def term(self, record: EffectRecord) -> OutliersTerm:
        """Read the share of outlying frames from a record."""
        return OutliersTerm(self, fraction=float(needed(record, 'fraction')))


class LooseContact(Outliers):
    """Does what `Outliers` does, where always the same channels stand out."""

    name = 'loose_contact'
    summary = 'single readings of a channel fail now and then'


OUTLIERS, LOOSE_CONTACT = Outliers(), LooseContact()
EFFECTS = (OUTLIERS, LOOSE_CONTACT)


def known_share(records: Sequence[EffectRecord]) -> float:
    """Return the share of frames that a model's records know to stand out in every session."""
    return sum(
        float(record.parameters.get('fraction', 0.0))
        for record in records
        if record.name == OUTLIERS.name
    )


def outliers_of(fraction: float, sigma: float, channels: Sequence[int]) -> OutliersTerm:
    """Return outliers in whole frames, or of some channels, which is what a loose contact does."""
    if not channels:
        return OutliersTerm(OUTLIERS, fraction=fraction, sigma=sigma)
    return OutliersTerm(
        LOOSE_CONTACT, {'channels': tuple(channels)}, fraction=fraction, sigma=sigma
    )
