"""Frames that belong to no model."""

from collections.abc import Mapping
from typing import ClassVar

from anser_ros.effects.effect import Array, Effect, Remedy, Term, needed
from anser_ros.field.model import EffectRecord


class Outliers(Effect):
    """Found as frames that stand out from their neighbours in time (`anser_ros.diagnosis`)."""

    name = 'outliers'
    summary = 'some frames belong to no model'
    units: ClassVar[Mapping[str, str]] = {'fraction': '1', 'channels': '1'}
    plausible: ClassVar[Mapping[str, tuple[float, float]]] = {'fraction': (0.0, 0.5)}
    remedy = Remedy.NONE

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        """The share of frames, and the channels where not all have them."""
        parameters = {'fraction': term.site['fraction']}
        if 'channels' in term.site:
            parameters['channels'] = list(term.site['channels'])
        return EffectRecord(self.name, parameters, {'fraction': term.site['sigma']})

    def term(self, record: EffectRecord) -> Term:
        """From the share."""
        return Term(self, {'fraction': float(needed(record, 'fraction')), 'sigma': 0.0})


class LooseContact(Outliers):
    """As `Outliers`, where always the same channels stand out."""

    name = 'loose_contact'
    summary = 'single readings of a channel fail now and then'


EFFECTS = (Outliers(), LooseContact())
