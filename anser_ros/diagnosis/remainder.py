"""Finds how metal at rest differs from a simple body, in as much detail as the data determine."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.diagnosis.decisions import SOMETHING_LEFT
from anser_ros.diagnosis.fit import Fit, Fitter
from anser_ros.diagnosis.residuals import tools_misfit
from anser_ros.diagnosis.rich_modes import rich_modes, thinned
from anser_ros.diagnosis.scoring import joined
from anser_ros.diagnosis.structure import noise_scale
from anser_ros.effects.body_term import Richness
from anser_ros.effects.effect import Resting, SizedShapes
from anser_ros.effects.metal_remainder import (
    REMAINDER,
    Couplings,
    IlluminationChange,
    RemainderPart,
)
from anser_ros.effects.term import Term
from anser_ros.effects.view import View
from anser_ros.metal.scattering import Shapes

Array = NDArray[np.float64]

MODE_ROUNDS = 2
"""Times that modes are made about where the metal then is; the second hardly ever moves it."""
NEW_MODES_M = 2e-3
"""A centre that a fit moves farther than this (m) asks for new modes: modes about a centre that is
off by a tenth of a body's radius stand for it as well."""


@dataclass(frozen=True)
class Remainders:
    """Adds what metal at rest leaves to a fit."""

    fitter: Fitter
    richness: Richness  # how many modes it may have

    def added(self, fit: Fit, index: int) -> Fit:
        """Return the fit with what one metal at rest leaves; the same fit for any other effect."""
        plain = fit.terms
        if plain[index].effect.resting(plain[index]) is None:
            return fit
        for _ in range(MODE_ROUNDS):
            term = fit.terms[index]
            before = _resting(term)
            own = self._couplings(fit, term, plain, before.near)
            if own is None:
                return fit
            start = [t if i != index else term for i, t in enumerate(plain)]
            emitters = self.fitter.problem.apparatus.emitters
            light = REMAINDER.of(term, IlluminationChange([term, own], emitters))
            fit = self.fitter.fit([*start, own, light])
            if np.linalg.norm(_resting(fit.terms[index]).centre - before.centre) < NEW_MODES_M:
                break
        return self._extended(fit, index)

    def _extended(self, fit: Fit, index: int) -> Fit:
        """The fit with a body as large as its distance, where much is left."""
        term = fit.terms[index]
        extended = _resting(term).extended
        if not extended or tools_misfit(fit.state) <= SOMETHING_LEFT * noise_scale(fit.state) ** 2:
            return fit
        more = self._couplings(fit, term, fit.terms, extended)
        if more is None:
            return fit
        held = term.hold(fit.covariance_of(index))
        terms = [held if i == index else t for i, t in enumerate(fit.terms)]
        return self.fitter.fit([*terms, more])

    def _couplings(
        self, fit: Fit, term: Term, beside: Sequence[Term], shapes: Sequence[SizedShapes]
    ) -> Term | None:
        """The couplings about metal at rest that predict best, given the other terms."""
        fitter, few = self.fitter, thinned(fit.state, self.fitter.blocks)
        centre = _resting(term).centre
        known = (
            joined([few.design(t) for t in beside]),
            np.concatenate([t.effect.prior(t) for t in beside]),
        )
        best: tuple[float, RemainderPart] | None = None
        for kind, sizes in shapes:

            def unit(view: View, modes: Array, kind: Shapes = kind) -> NDArray[np.inexact]:
                return Couplings(kind, centre, modes).unit(view)

            most = self.richness.modes
            found = rich_modes(few, known, unit, sizes, fitter.blocks, most)
            if found is not None and (best is None or found[0] < best[0]):
                best = (found[0], Couplings(kind, centre, found[1]))
        return None if best is None else REMAINDER.of(term, best[1])


def _resting(term: Term) -> Resting:
    """Where a term of metal at rest is."""
    found = term.effect.resting(term)
    assert found is not None, f'{term.label} is not metal at rest'
    return found
