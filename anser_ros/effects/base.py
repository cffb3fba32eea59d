"""Defines what every effect and every term offers to the engine that fits and selects them.

Fluxes (`anser_ros.effects.effect`) and poses are two observations; each adds its own stages. What
effects on fluxes know of a session is its apparatus, and the predicted readings of one body.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any, ClassVar, Generic, Self, TypeVar

import numpy as np

from anser_ros.arrays import Array, ComplexArray, Integers
from anser_ros.field.model import Dipoles, EffectRecord
from anser_ros.physics.sensor import SensorTable, clusters_of

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

    name: str = ''
    summary: str = ''
    units: Mapping[str, str] = {}
    plausible: Mapping[str, tuple[float, float]] = {}
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


@dataclass(frozen=True)
class Apparatus:
    """Holds tools, references, emitters and the space that they take up."""

    tools: tuple[SensorTable, ...]  # One table for each tool body
    references: SensorTable | None  # The sensors that are fixed in fg
    emitters: int  # Number of emitters, K
    omega: Array  # (K,), angular drive frequencies, rad/s
    duration: float  # Length of the session, s
    illumination: Dipoles  # The emitters' own field, good also beside and below the board
    # (2, 3), lower and upper corner of the box in which tool sensors were during this session, m,
    # frame fg: what the data can tell about, not where tools may be (that is
    # `physics.volume.TrackedVolume`)
    visited_box: Array
    board: Array  # (2, 3), lower and upper corner of the field generator, m, frame fg

    @property
    def tool_channels(self) -> tuple[int, ...]:
        """Return the channels of all tool sensors, in the tables' order."""
        return tuple(int(c) for table in self.tools for c in table.channel)

    @property
    def channels(self) -> tuple[int, ...]:
        """Return channels of all sensors, those of the tools first."""
        extra = () if self.references is None else self.references.channel
        return self.tool_channels + tuple(int(c) for c in extra)

    def clusters(self) -> list[tuple[int, ...]]:
        """Return the channels of tool sensors that share one centre, two or more of them."""
        return [
            tuple(table.channel[rows].tolist())
            for table in self.tools
            for rows in clusters_of(table)
            if rows.size > 1
        ]


@dataclass(frozen=True)
class View:
    """Holds predicted readings of a body's S sensors in F frames, with some active effects."""

    time: Array  # (F,), s since the session's start
    sensors: SensorTable  # The sensors as the effects say that they are
    position: Array  # (F, 3), of the body, m, frame fg
    rotation: Array  # (F, 3, 3), from the body's frame to fg
    velocity: Array  # (F, 6), m/s and rad/s along the axes of fg, of the body's origin
    centres: Array  # (F, S, 3), of the sensors, m, frame fg
    axes: Array  # (F, S, 3), their unit axes, frame fg
    linear: ComplexArray  # (F, S, K), flux before offsets and compression, T
    flux: ComplexArray  # (F, S, K), flux as it is read, T
    d_position: ComplexArray  # (F, S, 3, K), derivative of the flux by the sensor's centre, T/m
    d_axis: ComplexArray  # (F, S, 3, K), the same by its axis vector, T
    d_turn: ComplexArray  # (F, S, 3, K), the same by a turn of the body about its origin, T/rad
    dipoles: Dipoles  # The field that the sensors see, without what moves
    illumination: Dipoles  # The emitters' own field, as metal sees it
    omega: Array  # (K,), angular drive frequencies, rad/s
    is_reference: bool  # Whether the sensors are the references, which are fixed in fg

    def row(self, channel: int) -> int | None:
        """Return the row of a channel, or None where the body doesn't carry it."""
        found = np.flatnonzero(self.sensors.channel == channel)
        return int(found[0]) if found.size else None

    def columns(self, count: int) -> ComplexArray:
        """Return zeros of shape (F, S, K, count), to be filled with columns."""
        return np.zeros((*self.flux.shape, count), dtype=complex)

    def frames(self, rows: Integers) -> 'View':
        """Return the view of some frames, named by index."""
        each = (
            'time', 'position', 'rotation', 'velocity', 'centres', 'axes', 'linear', 'flux',
            'd_position', 'd_axis', 'd_turn',
        )  # fmt: skip
        return replace(self, **{name: getattr(self, name)[rows] for name in each})

    def along(self, field_flux: ComplexArray) -> ComplexArray:
        """Return fluxes of flattened sensors, shape (F S, K), in the shape (F, S, K)."""
        return field_flux.reshape(self.flux.shape)

    @property
    def flat(self) -> tuple[Array, Array, Array]:
        """Return centres, axes (F S, 3) and lengths (F S,) of every sensor in every frame."""
        lengths = np.tile(self.sensors.length, self.time.size)
        return self.centres.reshape(-1, 3), self.axes.reshape(-1, 3), lengths
