"""What every effect looks like: one interface, one file an effect.

The measurement chain that an effect may change runs in this order::

    optical track -> sensor table -> field -> emitters -> channels -> offset -> compression

An effect overrides the stages at which it acts, and gives the derivative of the predicted flux by
its own parameters. Its forward stages are also what undoes it live
(`anser_ros.effects.correction`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import ModelFileError
from anser_ros.field.dipoles import Dipoles
from anser_ros.field.model import EffectRecord
from anser_ros.physics.pose_track import PoseTrack
from anser_ros.physics.sensor import SensorTable

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


FROZEN = 1e-12
"""Prior spread of a parameter that a fit must leave where it is."""


class Remedy(Enum):
    """What is done about an effect live."""

    FLUX = 'the measured flux is corrected'
    SENSORS = 'the sensor table is corrected'
    FIELD = "the field model's dipoles are corrected"
    OPTICAL = 'the optical pose is corrected'
    NONE = 'nothing can be corrected, only said'


@dataclass(frozen=True)
class Apparatus:
    """What a session consists of, as far as effects need it to say where they may sit.

    Attributes
    ----------
    tools : tuple of SensorTable
        One a body.
    references : SensorTable or None
    emitters : int
    omega : ndarray, shape (K,)
        Angular drive frequencies, rad/s.
    duration : float
        s.
    illumination : Dipoles
        The emitters' own field, good also beside and below the board.
    visited_box : ndarray, shape (2, 3)
        Lower and upper corner of the box in which tool sensors were during this session, m: what
        the data can tell about, not where tools may be (that is `physics.volume.TrackedVolume`).
    board : ndarray, shape (2, 3)
        Lower and upper corner of the field generator, m.
    """

    tools: tuple[SensorTable, ...]
    references: SensorTable | None
    emitters: int
    omega: Array
    duration: float
    illumination: Dipoles
    visited_box: Array
    board: Array

    @property
    def tool_channels(self) -> tuple[int, ...]:
        """Channels of all tool sensors."""
        return tuple(int(c) for table in self.tools for c in table.channel)

    @property
    def channels(self) -> tuple[int, ...]:
        """Channels of all sensors, tools first."""
        extra = () if self.references is None else self.references.channel
        return self.tool_channels + tuple(int(c) for c in extra)

    def clusters(self) -> list[tuple[int, ...]]:
        """Channels of tool sensors that share one centre, where there are two or more."""
        groups = []
        for table in self.tools:
            left = list(range(len(table)))
            while left:
                near = [
                    i
                    for i in left
                    if np.linalg.norm(table.position[i] - table.position[left[0]]) < 2e-3
                ]
                left = [i for i in left if i not in near]
                if len(near) > 1:
                    groups.append(tuple(int(table.channel[i]) for i in near))
        return groups


@dataclass(frozen=True)
class View:
    """The predicted readings of one body's sensors at one state of all effects.

    Attributes
    ----------
    time : ndarray, shape (F,)
    sensors : SensorTable
        As the effects say that they are.
    position, rotation : ndarray, shapes (F, 3) and (F, 3, 3)
        Body pose in fg.
    velocity : ndarray, shape (F, 6)
        m/s and rad/s, axes of fg, about the body's origin.
    centres, axes : ndarray, shape (F, S, 3)
    linear : ndarray, shape (F, S, K), complex
        Flux before offsets and compression, T.
    flux : ndarray, shape (F, S, K), complex
    d_position, d_axis : ndarray, shape (F, S, 3, K), complex
        Derivatives by the sensor's centre (T/m) and by its axis vector (T).
    d_turn : ndarray, shape (F, S, 3, K), complex
        Derivative by a turn of the body about its origin, along fg's axes, T/rad.
    dipoles : Dipoles
        The field that the sensors see (static part).
    illumination : Dipoles
    omega : ndarray, shape (K,)
    is_reference : bool
    """

    time: Array
    sensors: SensorTable
    position: Array
    rotation: Array
    velocity: Array
    centres: Array
    axes: Array
    linear: ComplexArray
    flux: ComplexArray
    d_position: ComplexArray
    d_axis: ComplexArray
    d_turn: ComplexArray
    dipoles: Dipoles
    illumination: Dipoles
    omega: Array
    is_reference: bool

    def row(self, channel: int) -> int | None:
        """Row of a channel, or None where the body doesn't carry it."""
        found = np.flatnonzero(self.sensors.channel == channel)
        return int(found[0]) if found.size else None

    def columns(self, count: int) -> ComplexArray:
        """Zeros of shape (F, S, K, count)."""
        return np.zeros((*self.flux.shape, count), dtype=complex)

    def frames(self, rows: NDArray[np.int64]) -> 'View':
        """The frames named by index."""
        each = (
            'time', 'position', 'rotation', 'velocity', 'centres', 'axes', 'linear', 'flux',
            'd_position', 'd_axis', 'd_turn',
        )  # fmt: skip
        return replace(self, **{name: getattr(self, name)[rows] for name in each})

    def along(self, field_flux: ComplexArray) -> ComplexArray:
        """Fluxes of flattened sensors (F S, K) in the shape (F, S, K)."""
        return field_flux.reshape(self.flux.shape)

    @property
    def flat(self) -> tuple[Array, Array, Array]:
        """Centres, axes (F S, 3) and lengths (F S,) of every sensor in every frame."""
        lengths = np.tile(self.sensors.length, self.time.size)
        return self.centres.reshape(-1, 3), self.axes.reshape(-1, 3), lengths


@dataclass(frozen=True)
class Term:
    """An effect at one site (which channel, coil, body, ...) with values of its parameters.

    Attributes
    ----------
    effect : Effect
    site : mapping
        What tells this candidate from others of the same effect.
    theta : ndarray, shape (q,)
        Parameters in the units that the effect works in; zero is no effect.
    """

    effect: 'Effect'
    site: Mapping[str, Any] = field(default_factory=dict)
    theta: Array = field(default_factory=lambda: np.zeros(0))

    def with_theta(self, theta: Array) -> 'Term':
        """The same term with other parameters."""
        return replace(self, theta=np.asarray(theta, dtype=np.float64))

    def frozen(self, covariance: Array) -> 'Term':
        """The same term, its parameters that are not linear held; their covariance is kept."""
        return replace(self, site={**self.site, '_frozen': True, '_covariance': covariance})

    def free(self) -> 'Term':
        """The same term with all parameters free again."""
        held = ('_frozen', '_covariance')
        return replace(self, site={k: v for k, v in self.site.items() if k not in held})

    @property
    def seat(self) -> tuple[str, str]:
        """Name and site: the same for one term whatever its parameters, and held or free."""
        return self.effect.name, repr({k: v for k, v in self.site.items() if k[0] != '_'})

    @property
    def label(self) -> str:
        """Name and site in words."""
        parts = [f'{key} {_short(value)}' for key, value in self.site.items() if key[0] != '_']
        return f'{self.effect.name}{" (" + ", ".join(parts) + ")" if parts else ""}'


def _short(value: Any) -> str:
    if isinstance(value, float):
        return f'{value:.3g}'
    if isinstance(value, (tuple, list)):
        return '[' + ' '.join(_short(v) for v in value) + ']'
    return str(value)


class Effect:
    """Base of all effects: changes nothing.

    Attributes
    ----------
    name : str
        As in the contract's table, or a new descriptive one.
    summary : str
        One clause for the report.
    units : mapping
        Unit of each parameter of the record.
    plausible : mapping
        Range that a parameter may reasonably have.
    remedy : Remedy
    inexact : float
        Share of its power that its model may miss where it is truly there.
    """

    name: ClassVar[str] = ''
    summary: ClassVar[str] = ''
    units: ClassVar[Mapping[str, str]] = {}
    plausible: ClassVar[Mapping[str, tuple[float, float]]] = {}
    remedy: ClassVar[Remedy] = Remedy.NONE
    moving: ClassVar[bool] = False
    inexact: ClassVar[float] = 0.01

    # --- search ------------------------------------------------------------------------------
    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """The effect at every site where it may sit, with parameters of zero."""
        return ()

    def prior(self, term: Term) -> Array:
        """Standard deviation of each parameter before anything is measured, shape (q,)."""
        return np.ones(term.theta.size)

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """Derivative of the view's flux by the parameters, (F, S, K, q), or None."""
        return None

    def amounts(self, term: Term) -> NDArray[np.int64]:
        """Parameters, by index, that all being zero means that there is no effect."""
        return np.arange(term.theta.size)

    def probe(self, term: Term, view: View) -> ComplexArray | None:
        """Linear columns that tell quickly whether the effect is there; by default `columns`."""
        return self.columns(term, view)

    def directions(self, term: Term, view: View) -> ComplexArray | None:
        """Columns (F, S, K, q), a standard deviation long, along which every frame may move."""
        return None

    def started(self, term: Term, solution: Array) -> Sequence[Term]:
        """Start values for the full fit from the solution of the probe."""
        return (term.with_theta(solution),)

    def bounded(self, term: Term) -> Term:
        """The term with its parameters brought back into their domain."""
        return term

    # --- forward -----------------------------------------------------------------------------
    def optical(self, term: Term, track: PoseTrack) -> PoseTrack:
        """True track of the body from the optical one."""
        return track

    def table(self, term: Term, sensors: SensorTable) -> SensorTable:
        """True sensors from the surveyed ones."""
        return sensors

    def light(self, term: Term, illumination: Dipoles) -> Dipoles:
        """The emitters' own field as metal sees it, from the one that is known."""
        return illumination

    def sources(
        self, term: Term, base: Dipoles, illumination: Dipoles, omega: Array
    ) -> Dipoles | None:
        """Dipoles that the effect adds; ``base`` makes the field where sensors are."""
        return None

    def sources_at(
        self, term: Term, illumination: Dipoles, omega: Array, time: float
    ) -> Dipoles | None:
        """Dipoles that it adds at a time, for effects that are ``moving``."""
        return None

    def moving_flux(self, term: Term, view: View) -> ComplexArray:
        """What a ``moving`` effect adds to a view before the emitters' stage, (F, S, K)."""
        return np.zeros_like(view.flux)

    def emitter_matrix(self, term: Term, time: Array, omega: Array) -> ComplexArray | None:
        """Mixing of the emitters' tones, shape (F or 1, K, K): row the tone that is read."""
        return None

    def channel_matrix(self, term: Term, channels: NDArray[np.int64]) -> ComplexArray | None:
        """Mixing of the channels, shape (S, S): row the channel that is read."""
        return None

    def channel_gain(
        self, term: Term, channels: NDArray[np.int64], time: Array
    ) -> ComplexArray | None:
        """Gain of each channel by time, shape (F, S), before the channels mix."""
        return None

    def offset(
        self, term: Term, channels: NDArray[np.int64], emitters: int
    ) -> ComplexArray | None:
        """Phasors that are added, shape (S, K), T."""
        return None

    def compress(
        self, term: Term, channels: NDArray[np.int64], flux: ComplexArray
    ) -> ComplexArray:
        """What the channels make of fluxes of shape (F, S, K)."""
        return flux

    # --- records -----------------------------------------------------------------------------
    def record(self, term: Term, covariance: Array) -> EffectRecord:
        """The term in the contract's parameters; ``covariance`` (q, q) belongs to theta."""
        raise NotImplementedError

    def term(self, record: EffectRecord) -> Term:
        """The term that a record stands for; raises `ModelFileError` on missing parameters."""
        raise NotImplementedError


def needed(record: EffectRecord, key: str) -> Any:
    """A record's parameter; raises `ModelFileError` when it is missing."""
    try:
        return record.parameters[key]
    except KeyError:
        raise ModelFileError(f'model: the effect {record.name} lacks {key!r}') from None


def sigmas(covariance: Array) -> Array:
    """Standard deviations from a covariance."""
    return np.asarray(np.sqrt(np.maximum(np.diag(covariance), 0.0)))


def unit_matrix(size: int) -> ComplexArray:
    """Identity, complex."""
    return np.eye(size, dtype=complex)


def orthogonal_pair(axis: Array) -> Array:
    """Two unit vectors, shape (2, 3), that make a right-handed frame with a unit axis."""
    start = np.eye(3)[int(np.argmin(np.abs(axis)))]
    first = np.cross(axis, start)
    first /= np.linalg.norm(first)
    return np.stack([np.cross(first, axis), first])
