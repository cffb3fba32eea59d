"""Defines what every effect looks like. A term is one effect at one site, with its parameters.

The measurement chain that an effect may change runs in this order:

    optical track -> sensor table -> field -> emitters -> channels -> offset -> compression

An effect overrides the stages at which it acts, and gives the derivative of the predicted flux by
its own parameters. Its forward stages are also what undoes it live
(`anser_ros.effects.correction`). It declares what the search (`anser_ros.diagnosis`) needs to know
of it: its family, its rivals, the cost of its parameters and how it is refined. Nothing outside
this package refers to an effect's name or class, or imports its module, except what
`test/test_effect_names.py` lists with reasons.
"""

import importlib
import pkgutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cache
from types import ModuleType
from typing import Any, ClassVar, Literal, Self, TypedDict, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

import anser_ros.effects
from anser_ros.arrays import Array, ComplexArray, Integers, complex_of
from anser_ros.effects.base import Apparatus, BaseEffect, BaseTerm, View
from anser_ros.effects.base import Remedy as Remedy
from anser_ros.errors import ModelFileError
from anser_ros.field.model import Dipoles, EffectRecord
from anser_ros.metal.body import BODIES, COMPACT, ball_modes
from anser_ros.metal.scattering import Shapes
from anser_ros.physics.pose_track import PoseTrack
from anser_ros.physics.sensor import SensorTable


class Site(TypedDict, total=False):
    """States where an effect acts, by the keys that records and reports show."""

    channel: int
    channels: tuple[int, ...]
    coil: int  # number of an emitter
    coils: tuple[int, ...]  # of crosstalk: the one that leaks, and the one that it leaks into
    read_as: tuple[int, ...]  # for each of the channels or coils, the one whose place it has
    body: str
    mutual: Literal[True]  # the leak is the same both ways
    shape: str  # curve of a saturation
    sees: str  # what a saturating channel sees: one tone, or all together
    of: str  # name of the effect whose remainder it is
    place: tuple[float, ...]  # where resting metal is looked for, m, frame fg
    z: float  # height of a sheet, m, frame fg
    edge: float  # length of its edge, m
    axis: tuple[float, ...]  # unit vector of the optical frame along which its lengths are off


@dataclass(frozen=True)
class Held:
    """Marks a term whose parameters that are not linear stay where they are in a fit."""

    # (q, q), of all its parameters, from when they were last free; None where they never were
    covariance: Array | None = None


@dataclass(frozen=True)
class Term(BaseTerm):
    """Holds an effect at one site (a channel, a coil, a body, ...) with values of its parameters.

    An effect that needs more data than a site defines a subclass with more fields.
    """

    effect: 'Effect[Any]'
    # What tells this candidate from others of the same effect, as reports and records show it
    site: Site = field(default_factory=lambda: Site())
    held: Held | None = None  # None where all parameters are free

    def hold(self, covariance: Array | None = None) -> Self:
        """Return the term, held; ``covariance`` is kept for its record."""
        return replace(self, held=Held(covariance))

    def free(self) -> Self:
        """Return the same term with all parameters free again."""
        return replace(self, held=None)

    def belongs_to(self, other: 'Term') -> bool:
        """Return whether this term is part of another one's explanation and goes with that one."""
        return self.effect.belongs(self, other)

    @property
    def recorded_site(self) -> dict[str, Any]:
        """Return the site as a record has it, with lists in place of tuples."""
        return {key: list(v) if isinstance(v, tuple) else v for key, v in self.site.items()}

    @property
    def channels(self) -> tuple[int, ...]:
        """Return the channels that the site names; none where it is about something else."""
        one = (int(self.site['channel']),) if 'channel' in self.site else ()
        return (*one, *(int(c) for c in self.site.get('channels', ())))


LARGEST = 10.0
"""Prior standard deviation of the amplitudes of a simple body's modes, in units of 1e-4 m^3
(`anser_ros.metal.scattering.UNIT`): a perfectly conducting ball of 54 mm radius has -10."""


@dataclass(frozen=True)
class Richness:
    """States how finely metal is shaped."""

    modes: int  # Most modes of a body
    knots: tuple[int, ...]  # Numbers of knots that a free course may have, tried in this order
    left: float  # Misfit over the noise's from which a freer course is tried


@dataclass(frozen=True, kw_only=True)
class BodyTerm(Term):
    """Holds metal of modes: theta is its course, then their amplitudes, real and imaginary."""

    kind: str  # Of body (`anser_ros.metal.body.BODIES`)
    modes: Array  # (c, m), each a combination of the c couplings of the body's shapes
    # (m,), prior standard deviation of each mode's amplitude, in phase and in quadrature
    spread: Array
    # How finely the body was shaped; None for a simple body as it starts
    richness: Richness | None = None

    @property
    def shapes(self) -> Shapes:
        """Return the shapes of the field that the body couples."""
        return BODIES[self.kind]()

    @property
    def placed(self) -> int:
        """Return how many parameters the course has, which come before the amplitudes."""
        return int(self.theta.size) - 2 * int(self.modes.shape[1])

    @property
    def knots(self) -> int:
        """Return knots of a free course; 0 where the course has few parameters of its own kind."""
        return 0

    @property
    def course(self) -> Array:
        """Return the parameters that say where the body is."""
        return self.theta[: self.placed]

    @property
    def couplings(self) -> ComplexArray:
        """Return the complex couplings of the whole body, shape (c,)."""
        return np.asarray(self.modes @ complex_of(self.theta[self.placed :]))

    def unit(self, view: View) -> NDArray[np.inexact]:
        """Return the flux of each mode of unit amplitude in a view, (F, S, K, m), T."""
        raise NotImplementedError

    def with_body(self, kind: str, modes: Array, spread: Array) -> Self:
        """Return the same course with another body, whose amplitudes are still zero."""
        theta = np.concatenate([self.course, np.zeros(2 * modes.shape[1])])
        return replace(self, kind=kind, modes=modes, spread=spread, theta=theta)

    def shaped(self, kind: str, modes: Array, richness: Richness) -> Self:
        """Return the same course, a body of modes of unit prior size, and a ball's if compact."""
        spread = np.ones(modes.shape[1])
        if kind == COMPACT:
            ball = ball_modes()
            modes = np.concatenate([ball, modes], axis=1)
            spread = np.concatenate([np.full(ball.shape[1], LARGEST), spread])
        return replace(self.with_body(kind, modes, spread), richness=richness)

    def freer(self, knots: int) -> Self | None:
        """Return the same body on a freer course near this one; None where no freer one exists."""
        return None

    def restarted(self) -> Self | None:
        """Return the body as it is, where its course started from; None where that isn't known."""
        return None


@dataclass(frozen=True, kw_only=True)
class FluctuationTerm(Term):
    """Holds something constant that fluctuates; theta is empty."""

    # The constant effect at the same site; None for a term from a record
    constant: Term | None = None
    # Standard deviation of each of its parameters from frame to frame; None before it is found
    spread: Array | None = None
    frames: int = 1  # Frames that the spread was found on

    def columns(self, view: View) -> ComplexArray | None:
        """Return columns (F, S, K, q) of unit size along which a frame may move."""
        return None if self.constant is None else self.constant.effect.columns(self.constant, view)

    @property
    def expected(self) -> Array:
        """Return each parameter's standard deviation by the constant effect, shape (q,)."""
        return np.zeros(0) if self.constant is None else self.constant.effect.prior(self.constant)

    @property
    def extremes(self) -> list[Term]:
        """Return the constant effect a deviation up and down, where both are known."""
        if self.constant is None or self.spread is None:
            return []
        return [self.constant.with_theta(sign * self.spread) for sign in (-1.0, 1.0)]


TermT = TypeVar('TermT', bound=Term)
SizedShapes = tuple[Shapes, Sequence[Array]]
"""Shapes of a field that metal couples, and the prior sizes of their couplings to try."""

FROZEN = 1e-12
"""Prior spread of a parameter that a fit must leave where it is, negligible beside any step."""
INEXACT = 0.01
"""Share of an effect's power that its model may miss where the effect is truly there, unless the
effect says otherwise. What leaves more is another effect's stand-in."""


class Family(Enum):
    """Names how the search for effects treats an effect."""

    STEADY = 'a constant, or a curve with few parameters'
    METAL_AT_REST = 'metal that stays where it is; refined by its deviation from a simple body'
    MOVING_METAL = 'metal whose response changes with time; refined by a richer body and path'
    REMAINDER = 'a part of another effect, never named by itself'
    FLUCTUATION = 'a random number per frame, with a spread'
    SEEN = 'seen directly, without a parameter to fit: wiring, noise, outliers'

    @property
    def is_metal(self) -> bool:
        """Return whether it is metal, at rest or moving."""
        return self in (Family.METAL_AT_REST, Family.MOVING_METAL)


@dataclass(frozen=True)
class Resting:
    """States where metal at rest is, and what it may be besides its few parameters."""

    centre: Array  # (3,), m, frame fg
    # Shapes about the centre whose couplings tell the place; the one that predicts best is fitted
    # together with the metal
    near: Sequence[SizedShapes]
    # Shapes of a body as large as its distance, tried where much is left; none where the metal has
    # no such shapes
    extended: Sequence[SizedShapes] = ()


class Effect(BaseEffect[TermT]):
    """Changes nothing; it is the base of all effects on fluxes.

    What every fit needs of an effect (name, prior, cost, record) is that of `BaseEffect`.
    """

    # where the record is the site and theta in other units: how many of theta's values stand under
    # each key, in their order, and the factor that they are multiplied by
    recorded: ClassVar[Mapping[str, tuple[int, float]]] = {}
    # what the values of each channel are, of an effect that every channel has in its own size
    parts: ClassVar[tuple[str, ...]] = ()
    family: ClassVar[Family] = Family.STEADY
    # share of its power that its model may miss where it is truly there (`INEXACT`); infinite
    # where its shape is never known
    inexact: ClassVar[float] = INEXACT
    # whether it takes another course in every session, so that a recorded course holds only for
    # the session that it was found on
    drifts: ClassVar[bool] = False
    # whether nothing but the reference sensors can follow it live
    followed: ClassVar[bool] = False
    # whether several of it at once are as likely as one, and no stand-in for what they share
    gregarious: ClassVar[bool] = False
    # whether it is how a part is installed: installed anew, parts are a rival of metal at rest
    installed: ClassVar[bool] = False
    # whether it is how a frame or a body stands, all of it
    is_stand: ClassVar[bool] = False
    # whether its record is how the optical frame lies, as `rotation_deg` and `translation_m`
    is_frame: ClassVar[bool] = False
    # relative error of what it changes at a reference, beyond the survey's, where the field's
    # gradient close to an emitter is known less well than the field
    gradient_error: ClassVar[float] = 0.0
    # the effect at rest that this one is in each short stretch of time; where that fits best in
    # each stretch is where this one starts (`along`)
    still: ClassVar['Effect[Any] | None'] = None

    # --- search ------------------------------------------------------------------------------
    def candidates(self, apparatus: Apparatus) -> Sequence[TermT]:
        """Return the effect at every site where it may sit, with parameters of zero."""
        return ()

    def columns(self, term: TermT, view: View) -> ComplexArray | None:
        """Return the derivative of the view's flux by the parameters, (F, S, K, q), or None."""
        return None

    def amounts(self, term: TermT) -> Integers:
        """Return the indices of the parameters that are all zero when there is no effect."""
        return np.arange(term.theta.size)

    def probe(self, term: TermT, view: View) -> ComplexArray | None:
        """Return linear columns that tell quickly whether the effect is there, or `columns`."""
        return self.columns(term, view)

    def directions(self, term: TermT, view: View) -> ComplexArray | None:
        """Return columns (F, S, K, q), a standard deviation long, for each frame to move along."""
        return None

    def started(self, term: TermT, solution: Array) -> Sequence[TermT]:
        """Return start values for the full fit from the solution of the probe."""
        return (self.bounded(term.with_theta(solution)),)

    def along(
        self, time: Array, course: Array, solution: Array, apparatus: Apparatus
    ) -> Sequence[TermT]:
        """Return start values from where ``still`` fits best in each of B stretches of time.

        ``time`` (B,): middle of each stretch, s; ``course`` (B, 3): best place of ``still`` in
        each, m, frame fg; ``solution``: of its probe in the stretch where it explains most.
        """
        return ()

    # --- comparison --------------------------------------------------------------------------
    def rivals(self, term: TermT, other: Term) -> bool:
        """Return whether a steady term is about the same thing, so that one is superfluous."""
        return False

    def belongs(self, term: TermT, other: Term) -> bool:
        """Return whether a term of this effect is part of another term's explanation."""
        return False

    def freedom(self, term: TermT) -> int:
        """Return how many values a term leaves open in all frames together."""
        return 0

    def silenced(self, term: TermT) -> tuple[int, ...]:
        """Return channels that must take no part in anything where the effect is there."""
        return ()

    # --- refinement: what the term is, for those effects that are refined ------------------------
    def resting(self, term: TermT) -> Resting | None:
        """Return where metal at rest is and what it may be besides; None for any other effect."""
        return None

    def body(self, term: TermT) -> BodyTerm | None:
        """Return the term of metal whose body and course are refined; None for other effects."""
        return None

    def opened(self, term: TermT) -> FluctuationTerm | None:
        """Return the term of an effect whose spread is found; None for any other effect."""
        return None

    # --- record ------------------------------------------------------------------------------
    def record(self, term: TermT, covariance: Array) -> EffectRecord:
        """Return the site, and theta by the keys and units of ``recorded``."""
        site, sigma = term.recorded_site, sigmas(covariance)
        return EffectRecord(self.name, {**site, **self._figures(term.theta)}, self._figures(sigma))

    def _figures(self, values: Array) -> dict[str, Any]:
        out, start = {}, 0
        for key, (width, factor) in self.recorded.items():
            if part := (factor * values[start : start + width]).tolist():
                out[key] = part if width > 1 else part[0]
            start += width
        return out

    def term(self, record: EffectRecord) -> TermT:
        """Return the term of a record; raises `ModelFileError` on missing parameters."""
        parts = [
            np.asarray(record.needed(key), dtype=np.float64).reshape(width) / factor
            for key, (width, factor) in self.recorded.items()
        ]
        return cast(TermT, Term(self, self.site_of(record), np.concatenate(parts)))

    def site_of(self, record: EffectRecord) -> Site:
        """Return what a record says of the site; raises `ModelFileError` where it lacks a key."""
        keys = [key for key in self.units if key in READ_SITE]
        return cast(Site, {key: READ_SITE[key](record.needed(key)) for key in keys})

    # --- forward -----------------------------------------------------------------------------
    @property
    def moving(self) -> bool:
        """Return whether its field changes with time (`moving_flux`), unlike `sources`."""
        return self.family is Family.MOVING_METAL

    def optical(self, term: TermT, track: PoseTrack) -> PoseTrack:
        """Return the true track of the body from the optical one."""
        return track

    def table(self, term: TermT, sensors: SensorTable) -> SensorTable:
        """Return the sensors as they truly are, from the surveyed ones."""
        return sensors

    def light(self, term: TermT, illumination: Dipoles) -> Dipoles:
        """Return the emitters' own field as metal sees it, from the one that is known."""
        return illumination

    def sources(self, term: TermT, base: Dipoles, light: Dipoles, omega: Array) -> Dipoles | None:
        """Return dipoles that the effect adds; ``base`` makes the field where sensors are."""
        return None

    def moving_flux(self, term: TermT, view: View) -> ComplexArray:
        """Return what a ``moving`` effect adds to a view before the emitters' stage, (F, S, K)."""
        return np.zeros_like(view.flux)

    def emitter_matrix(self, term: TermT, time: Array, omega: Array) -> ComplexArray | None:
        """Return the mixing of the emitters' tones, (F or 1, K, K): row the tone that is read."""
        return None

    def channel_matrix(self, term: TermT, channels: Integers) -> ComplexArray | None:
        """Return the mixing of the channels, shape (S, S): row the channel that is read."""
        return None

    def response(self, term: TermT, channels: Integers, omega: Array) -> ComplexArray | None:
        """Return the factor of each channel at each tone, (S, K), where they differ by both."""
        return None

    def gain_changes(self, term: TermT, sensors: SensorTable) -> Array | None:
        """Return relative changes of gains since, one standard deviation each, shape (G, S)."""
        return None

    def offset(self, term: TermT, channels: Integers, emitters: int) -> ComplexArray | None:
        """Return phasors that are added, shape (S, K), T."""
        return None

    def compress(self, term: TermT, channels: Integers, flux: ComplexArray) -> ComplexArray:
        """Return what the channels make of fluxes of shape (F, S, K)."""
        return flux


def whole_numbers(values: Sequence[Any]) -> tuple[int, ...]:
    """Return the numbers of channels or coils as they are in a record."""
    return tuple(int(number) for number in values)


READ_SITE: Mapping[str, Callable[[Any], Any]] = {
    'channel': int, 'coil': int, 'body': str,
    'channels': whole_numbers, 'coils': whole_numbers, 'read_as': whole_numbers,
}  # fmt: skip
"""How the keys of a site are read from a record."""


def sigmas(covariance: Array) -> Array:
    """Return the standard deviations that a covariance matrix holds."""
    return np.asarray(np.sqrt(np.maximum(np.diag(covariance), 0.0)))


@cache
def all_effects() -> dict[str, Effect[Any]]:
    """Return every effect by its name, in alphabetical order."""
    return effects_in(anser_ros.effects)


def effects_in(package: ModuleType) -> dict[str, Any]:
    """Return the effects that the modules of a package define, by name in alphabetical order."""
    found: dict[str, Any] = {}
    for info in pkgutil.iter_modules(package.__path__):
        module = importlib.import_module(f'{package.__name__}.{info.name}')
        for effect in getattr(module, 'EFFECTS', ()):
            if effect.name in found:
                raise ValueError(f'two effects are called {effect.name!r}')
            found[effect.name] = effect
    return dict(sorted(found.items()))


def effect_named(name: str) -> Effect[Any]:
    """Return the effect with a name; raises `ModelFileError` when there is none."""
    try:
        return all_effects()[name]
    except KeyError:
        raise ModelFileError(f'model: no effect is called {name!r}') from None
