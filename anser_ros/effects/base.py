"""Defines what every effect and every term offers to the engine that fits and selects them.

Fluxes (`anser_ros.effects.effect`) and poses are two observations; each adds its own stages.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any, ClassVar, Generic, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from anser_ros.field.model import EffectRecord

Array = NDArray[np.float64]
AnyTerm = TypeVar('AnyTerm', bound='BaseTerm')


class Remedy(Enum):
    """Names what is corrected while tracking, so that an effect does no harm."""

    FLUX = 'the measured flux is corrected'
    SENSORS = 'the sensor table is corrected'
    FIELD = "the field model's dipoles are corrected"
    OPTICAL = 'the optical pose is corrected'
    NONE = 'nothing can be corrected, only reported'


class BaseEffect(Generic[AnyTerm]):
    """Changes nothing; it is the base of the effects on fluxes and on poses."""

    name: ClassVar[str] = ''
    summary: ClassVar[str] = ''
    units: ClassVar[Mapping[str, str]] = {}
    plausible: ClassVar[Mapping[str, tuple[float, float]]] = {}
    remedy: ClassVar[Remedy] = Remedy.NONE
    # standard deviation of each parameter, or of all, before anything is measured
    typical: ClassVar[float | tuple[float, ...]] = 1.0

    def prior(self, term: AnyTerm) -> Array:
        """Return each parameter's standard deviation before anything is measured, shape (q,)."""
        return np.full(term.theta.size, self.typical)

    def bounded(self, term: AnyTerm) -> AnyTerm:
        """Return the term with its parameters brought back into their domain."""
        return term

    def complexity(self, term: AnyTerm) -> int:
        """Return how many parameters are paid for when explanations are compared."""
        return int(term.theta.size)

    def covers(self, term: AnyTerm, candidate: Any) -> bool:
        """Return whether an active term of this effect stands for a candidate already."""
        return bool(candidate.name_and_site == term.name_and_site)

    def record(self, term: AnyTerm, covariance: Array) -> EffectRecord:
        """Return the term in the record's parameters; ``covariance`` (q, q) belongs to theta."""
        raise NotImplementedError

    def term(self, record: EffectRecord) -> AnyTerm:
        """Return the term of a record; raises `ModelFileError` on missing parameters."""
        raise NotImplementedError

    def possible(self, record: EffectRecord) -> bool:
        """Return whether the numbers of a record are in the ranges of ``plausible``."""
        for key, (low, high) in self.plausible.items():
            value = record.parameters.get(key)
            if value is None or isinstance(value, str):
                continue
            numbers = np.asarray(value, dtype=np.float64)
            if numbers.size and (numbers.min() < low or numbers.max() > high):
                return False
        return True


@dataclass(frozen=True)
class BaseTerm:
    """Holds an effect at one site with values of its parameters."""

    effect: BaseEffect[Any]
    site: Any = field(default_factory=dict)  # a mapping: tells it from others of the effect
    theta: Array = field(default_factory=lambda: np.zeros(0))  # (q,); zero is no effect

    def with_theta(self, theta: Array) -> Self:
        """Return the same term with other parameters."""
        return replace(self, theta=np.asarray(theta, dtype=np.float64))

    @property
    def complexity(self) -> int:
        """Return how many parameters are paid for when explanations are compared."""
        return self.effect.complexity(self)

    @property
    def name_and_site(self) -> tuple[str, str]:
        """Return name and site: the same for one term whatever its parameters, held or free."""
        return self.effect.name, repr(sorted(self.site.items()))

    @property
    def label(self) -> str:
        """Return the effect's name and its site in words."""
        parts = [f'{key} {_short(value)}' for key, value in self.site.items()]
        return f'{self.effect.name}{" (" + ", ".join(parts) + ")" if parts else ""}'


def _short(value: Any) -> str:
    if isinstance(value, float):
        return f'{value:.3g}'
    if isinstance(value, (tuple, list)):
        return '[' + ' '.join(_short(v) for v in value) + ']'
    return str(value)
