"""Only the noise has grown."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

from anser_ros.effects.effect import Array, Effect, Family, Remedy, needed
from anser_ros.effects.term import Site, Term
from anser_ros.field.model import EffectRecord


@dataclass(frozen=True, kw_only=True)
class ExcessNoiseTerm(Term):
    """States how much the noise has grown.

    Attributes
    ----------
    factor, sigma : float
        Noise over what it should be, and its standard deviation.
    """

    factor: float
    sigma: float = 0.0


class ExcessNoise(Effect[ExcessNoiseTerm]):
    """Is found from the residuals' spread once they show no structure (`anser_ros.diagnosis`)."""

    name = 'excess_noise'
    summary = 'the noise is larger than it should be, and nothing else'
    units: ClassVar[Mapping[str, str]] = {'factor': '1', 'channels': '1'}
    plausible: ClassVar[Mapping[str, tuple[float, float]]] = {'factor': (1.0, 1000.0)}
    remedy = Remedy.NONE
    family = Family.SEEN

    def record(self, term: ExcessNoiseTerm, covariance: Array) -> EffectRecord:
        """Record the factor, and the channels where not all have it."""
        parameters: dict[str, object] = {'factor': term.factor}
        if 'channels' in term.site:
            parameters['channels'] = list(term.site['channels'])
        return EffectRecord(self.name, parameters, {'factor': term.sigma})

    def term(self, record: EffectRecord) -> ExcessNoiseTerm:
        """Read the factor by which the noise has grown from a record."""
        return ExcessNoiseTerm(self, factor=float(needed(record, 'factor')))


EXCESS_NOISE = ExcessNoise()
EFFECTS = (EXCESS_NOISE,)


def excess_noise_of(factor: float, sigma: float, channels: Sequence[int]) -> ExcessNoiseTerm:
    """Return noise that has grown on some channels, or on all where none are named."""
    site: Site = {'channels': tuple(channels)} if channels else {}
    return ExcessNoiseTerm(EXCESS_NOISE, site, factor=factor, sigma=sigma)
