"""Models the residual of a simple metal body or sheet: finer couplings, errors in illumination.

Not an effect of its own (no registry holds it): it belongs to the metal that it refines, so that
the corrected field is as good as the data allow while the metal's own parameters stay few.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.effect import (
    Array,
    ComplexArray,
    Effect,
    Family,
    Remedy,
    Term,
    both_phases,
    complex_of,
)
from anser_ros.effects.view import View
from anser_ros.field.dipoles import Dipoles
from anser_ros.field.model import EffectRecord
from anser_ros.metal.scattering import Shapes

GAIN, ASIDE_M, UP_M = 3e-3, 0.2e-3, 0.4e-3
"""How well an emitter's field is known where metal is and nothing was measured: as if the emitter
were so much stronger, or so far away. The far side of the board says least about its height."""
STEP_M = 0.5e-3
"""Shift (m) of an emitter in the differences that tell what its place does to metal."""


@dataclass(frozen=True, eq=False)
class Couplings:
    """Combines couplings into fixed modes, each with a complex amplitude."""

    shapes: Shapes
    centre: Array  # (3,), m
    modes: Array  # (shapes.size, m), of the size that each is expected to have

    @property
    def count(self) -> int:
        """Return the number of parameters: real, then imaginary parts."""
        return 2 * int(self.modes.shape[1])

    def unit(self, view: View) -> NDArray[np.inexact]:
        """Return the flux of each mode, (F, S, K, m)."""
        shapes = self.shapes
        ears = shapes.received(self.centre, view.centres, view.axes, view.sensors.length)
        drive = shapes.driven(view.illumination.field(self.centre + shapes.offsets))
        return shapes.mode_flux(ears, drive, self.modes, view.omega)

    def columns(self, view: View) -> ComplexArray:
        """Return the flux that a unit of each parameter adds."""
        return both_phases(self.unit(view))

    def sources(self, theta: Array, illumination: Dipoles, omega: Array) -> Dipoles:
        """Return the dipoles that all modes make together."""
        couplings = self.modes @ complex_of(theta)
        return self.shapes.sources(self.centre, couplings, illumination, omega)


@dataclass(frozen=True, eq=False)
class IlluminationChange:
    """Changes each emitter's strength and place (x, y, z) as they act on metal."""

    metal: Sequence[Term]  # At rest; what answers to the emitters
    emitters: int

    @property
    def count(self) -> int:
        """Return four parameters, a strength and a place, for every emitter."""
        return 4 * self.emitters

    def _answers(self, illumination: Dipoles, omega: Array) -> list[Dipoles]:
        """What the metal adds when all emitters are a standard deviation off in one way."""
        places, out = illumination.positions, []
        for way, size in zip(np.eye(4), (GAIN, ASIDE_M, ASIDE_M, UP_M), strict=True):
            if way[0]:
                light = replace(illumination, moments=GAIN * illumination.moments)
            else:
                moments = illumination.moments * (size / STEP_M)
                light = replace(
                    illumination, positions=places + STEP_M * way[1:], moments=moments
                ).joined(replace(illumination, moments=-moments))
            answer = Dipoles.none(self.emitters)
            for term in self.metal:
                added = term.effect.sources(term, light, light, omega)
                answer = answer if added is None else answer.joined(added)
            out.append(answer)
        return out

    def columns(self, view: View) -> ComplexArray:
        """Return the flux that a unit of each parameter adds."""
        out = view.columns(self.count)
        every = np.arange(self.emitters)
        for way, answer in enumerate(self._answers(view.illumination, view.omega)):
            flux = view.along(answer.flux(*view.flat))
            out[:, :, every, way * self.emitters + every] = flux
        return out

    def sources(self, theta: Array, illumination: Dipoles, omega: Array) -> Dipoles:
        """Return the dipoles of all errors of the light together."""
        shares = theta.reshape(4, self.emitters)
        out = Dipoles.none(self.emitters)
        for share, answer in zip(shares, self._answers(illumination, omega), strict=True):
            out = out.joined(replace(answer, moments=answer.moments * share))
        return out


RemainderPart = Couplings | IlluminationChange
"""A linear part of a metal's response, with ``count`` parameters of unit prior size."""


@dataclass(frozen=True, kw_only=True)
class RemainderTerm(Term):
    """Holds a leftover of one metal; theta is the leftover's parameters."""

    parent: tuple[str, str]  # `Term.name_and_site` of the metal
    leftover: RemainderPart


class MetalRemainder(Effect[RemainderTerm]):
    """Describes the residual of metal at rest by `Couplings` or an `IlluminationChange`."""

    name = 'metal_remainder'
    summary = 'the residual that a simple metal body leaves'
    remedy = Remedy.FIELD
    family = Family.REMAINDER

    def of(self, parent: Term, leftover: RemainderPart) -> RemainderTerm:
        """Return a leftover of a metal that is at rest, with parameters of zero."""
        return RemainderTerm(
            self, {'of': parent.effect.name}, np.zeros(leftover.count),
            parent=parent.name_and_site, leftover=leftover,
        )  # fmt: skip

    def belongs(self, term: RemainderTerm, other: Term) -> bool:
        """Return whether ``other`` is the metal that this leftover belongs to."""
        return term.parent == other.name_and_site

    def columns(self, term: RemainderTerm, view: View) -> ComplexArray | None:
        """Return the leftover's own columns: it is linear in its parameters."""
        return term.leftover.columns(view)

    def sources(
        self, term: RemainderTerm, base: Dipoles, illumination: Dipoles, omega: Array
    ) -> Dipoles | None:
        """Return the dipoles of the leftover, none while all is zero."""
        if not np.any(term.theta):
            return None
        return term.leftover.sources(term.theta, illumination, omega)

    def record(self, term: RemainderTerm, covariance: Array) -> EffectRecord:
        """Record the size only; the parent's record names the metal."""
        rms = float(np.sqrt(np.mean(term.theta**2)))
        return EffectRecord(self.name, {'of': term.site['of'], 'rms': rms})


REMAINDER = MetalRemainder()
