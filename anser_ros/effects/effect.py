"""Defines what every effect looks like: one interface, and one file for each effect.

The measurement chain that an effect may change runs in this order::

    optical track -> sensor table -> field -> emitters -> channels -> offset -> compression

An effect overrides the stages at which it acts, and gives the derivative of the predicted flux by
its own parameters. Its forward stages are also what undoes it live
(`anser_ros.effects.correction`). It also declares what the search for effects needs to know of it
(`anser_ros.diagnosis`): its family, its rivals, the cost of its parameters, how it is refined, and
what errors of a reference sensor's survey add to it. Nothing outside this package refers to an
effect's name or class, or imports its module, except what `test/test_effect_names.py` lists with
reasons: the stages of the diagnosis that see an effect without the search and so make its term
themselves, and code that speaks of effects without these classes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.apparatus import Apparatus
from anser_ros.effects.base import BaseEffect
from anser_ros.effects.base import Remedy as Remedy
from anser_ros.effects.body_term import BodyTerm, FluctuationTerm
from anser_ros.effects.term import Term
from anser_ros.effects.view import View
from anser_ros.errors import ModelFileError
from anser_ros.field.dipoles import Dipoles
from anser_ros.field.model import EffectRecord
from anser_ros.metal.scattering import Shapes
from anser_ros.physics.pose_track import PoseTrack
from anser_ros.physics.sensor import SensorTable

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
TermT = TypeVar('TermT', bound=Term)
SizedShapes = tuple[Shapes, Sequence[Array]]
"""Shapes of a field that metal couples, and the prior sizes of their couplings to try."""

FROZEN = 1e-12
"""Prior spread of a parameter that a fit must leave where it is, in the parameter's own unit. It
only has to be negligible compared with any step of a fit; zero would make the prior's weight
infinite."""
INEXACT = 0.01
"""Share of an effect's power that its model may miss where the effect is truly there, unless the
effect says otherwise. Gains, tilts and shifts are modelled to better than this; what leaves more
on the values that it changes is another effect's stand-in."""


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

    What every fit needs of an effect (prior, cost, record) is that of `BaseEffect`.

    Attributes
    ----------
    name : str
        As `docs/interfaces.md` lists it, or a new descriptive one.
    summary : str
        One clause for the report.
    units : mapping
        Unit of each parameter of the record.
    parts : tuple of str
        What the values of each channel are, of an effect that every channel has in its own size.
    plausible : mapping
        Range that a parameter of the record may reasonably have.
    remedy : Remedy
    family : Family
    inexact : float
        Share of its power that its model may miss where it is truly there (`INEXACT`); infinite
        where its shape is never known.
    drifts : bool
        Whether it takes another course in every session, so that a recorded course holds only
        for the session that it was found on.
    followed : bool
        Whether nothing but the reference sensors can follow it live.
    gradient_error : float
        Relative error of what it changes at a reference, beyond the survey's, where the field's
        gradient close to an emitter is known less well than the field.
    still : Effect or None
        The effect at rest that this one is in each short stretch of time; where that fits best in
        each stretch is where this one starts (`along`).
    """

    parts: ClassVar[tuple[str, ...]] = ()
    family: ClassVar[Family] = Family.STEADY
    inexact: ClassVar[float] = INEXACT
    drifts: ClassVar[bool] = False
    followed: ClassVar[bool] = False
    gradient_error: ClassVar[float] = 0.0
    still: ClassVar['Effect[Any] | None'] = None

    # --- search ------------------------------------------------------------------------------
    def candidates(self, apparatus: Apparatus) -> Sequence[TermT]:
        """Return the effect at every site where it may sit, with parameters of zero."""
        return ()

    def columns(self, term: TermT, view: View) -> ComplexArray | None:
        """Return the derivative of the view's flux by the parameters, (F, S, K, q), or None."""
        return None

    def amounts(self, term: TermT) -> NDArray[np.int64]:
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
        return (term.with_theta(solution),)

    def along(
        self, time: Array, course: Array, solution: Array, apparatus: Apparatus
    ) -> Sequence[TermT]:
        """Return start values from where ``still`` fits best in each stretch of time.

        Parameters
        ----------
        time : ndarray, shape (B,)
            Middle of each stretch, s.
        course : ndarray, shape (B, 3)
            Best place of ``still`` in each stretch, m, frame fg.
        solution : ndarray
            Of the probe of ``still`` in the stretch where it explains most.
        apparatus : Apparatus
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

    def sources(
        self, term: TermT, base: Dipoles, illumination: Dipoles, omega: Array
    ) -> Dipoles | None:
        """Return dipoles that the effect adds; ``base`` makes the field where sensors are."""
        return None

    def moving_flux(self, term: TermT, view: View) -> ComplexArray:
        """Return what a ``moving`` effect adds to a view before the emitters' stage, (F, S, K)."""
        return np.zeros_like(view.flux)

    def emitter_matrix(self, term: TermT, time: Array, omega: Array) -> ComplexArray | None:
        """Return the mixing of the emitters' tones, shape (F or 1, K, K): row the tone that is
        read.
        """
        return None

    def channel_matrix(self, term: TermT, channels: NDArray[np.int64]) -> ComplexArray | None:
        """Return the mixing of the channels, shape (S, S): row the channel that is read."""
        return None

    def gain_changes(self, term: TermT, sensors: SensorTable) -> Array | None:
        """Return relative changes of gains since, one standard deviation each, shape (G, S)."""
        return None

    def offset(
        self, term: TermT, channels: NDArray[np.int64], emitters: int
    ) -> ComplexArray | None:
        """Return phasors that are added, shape (S, K), T."""
        return None

    def compress(
        self, term: TermT, channels: NDArray[np.int64], flux: ComplexArray
    ) -> ComplexArray:
        """Return what the channels make of fluxes of shape (F, S, K)."""
        return flux


def needed(record: EffectRecord, key: str) -> Any:
    """Return a record's parameter; raises `ModelFileError` when it is missing."""
    try:
        return record.parameters[key]
    except KeyError:
        raise ModelFileError(f'model: the effect {record.name} lacks {key!r}') from None


def whole_numbers(record: EffectRecord, key: str) -> tuple[int, ...]:
    """Return the channels or coils of a record; raises `ModelFileError` when they are missing."""
    return tuple(int(number) for number in needed(record, key))


def recorded_site(term: Term) -> dict[str, Any]:
    """Return a term's site as its record has it, with lists in place of tuples."""
    return {key: list(v) if isinstance(v, tuple) else v for key, v in term.site.items()}


def sigmas(covariance: Array) -> Array:
    """Return the standard deviations that a covariance matrix holds."""
    return np.asarray(np.sqrt(np.maximum(np.diag(covariance), 0.0)))


def unit_matrix(size: int) -> ComplexArray:
    """Return the identity of this size as a complex matrix."""
    return np.eye(size, dtype=complex)
