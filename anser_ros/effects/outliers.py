"""Some frames are outliers, which no model of the field explains."""

from collections.abc import Sequence

from anser_ros.effects.seen import SeenEffect, SeenTerm
from anser_ros.field.model import EffectRecord


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


OUTLIERS, LOOSE_CONTACT = Outliers(), LooseContact()
EFFECTS = (OUTLIERS, LOOSE_CONTACT)


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
