"""Only the noise has grown."""

from collections.abc import Mapping
from typing import ClassVar

from anser_ros.effects.effect import Array, Effect, Remedy, Term, needed
from anser_ros.field.model import EffectRecord


class ExcessNoise(Effect):
    """Found from the residuals' spread once they show no structure (`anser_ros.diagnosis`)."""

    name = 'excess_noise'
    summary = 'the noise is larger than it should be, and nothing else'
    units: ClassVar[Mapping[str, str]] = {'factor': '1', 'channels': '1'}
    plausible: ClassVar[Mapping[str, tuple[float, float]]] = {'factor': (1.0, 1000.0)}
    remedy = Remedy.NONE

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        """The factor, and the channels where not all have it."""
        parameters = {'factor': term.site['factor']}
        if 'channels' in term.site:
            parameters['channels'] = list(term.site['channels'])
        return EffectRecord(self.name, parameters, {'factor': term.site['sigma']})

    def term(self, record: EffectRecord) -> Term:
        """From the factor."""
        return Term(self, {'factor': float(needed(record, 'factor')), 'sigma': 0.0})


EFFECTS = (ExcessNoise(),)
