"""Defines a term: one effect at one site, with values of its parameters."""

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal, Self, TypedDict

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.base import BaseTerm

if TYPE_CHECKING:
    from anser_ros.effects.effect import Effect

Array = NDArray[np.float64]


class Site(TypedDict, total=False):
    """States where an effect acts, by the keys that it needs, in the words of records and reports.

    It is a plain mapping, as it is printed, compared and written; the type checker knows each key
    and the type of its value.
    """

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
        """Return the same term, held; ``covariance`` is kept for its record."""
        return replace(self, held=Held(covariance))

    def free(self) -> Self:
        """Return the same term with all parameters free again."""
        return replace(self, held=None)

    def belongs_to(self, other: 'Term') -> bool:
        """Return whether this term is part of another one's explanation and goes with that one."""
        return self.effect.belongs(self, other)

    @property
    def channels(self) -> tuple[int, ...]:
        """Return the channels that the site names; none where it is about something else."""
        one = (int(self.site['channel']),) if 'channel' in self.site else ()
        return (*one, *(int(c) for c in self.site.get('channels', ())))
