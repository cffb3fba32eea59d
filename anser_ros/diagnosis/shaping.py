"""Shapes a richer body for metal that moves, and a freer path where that is worth it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from anser_ros.diagnosis.decisions import PER_PARAMETER
from anser_ros.diagnosis.fit import Fit, Fitter
from anser_ros.diagnosis.problem import evaluate
from anser_ros.diagnosis.rich_modes import Known, rich_modes, thinned
from anser_ros.diagnosis.scoring import joined
from anser_ros.diagnosis.structure import noise_scale
from anser_ros.effects.body_term import BodyTerm, Richness
from anser_ros.effects.term import Term
from anser_ros.effects.view import View
from anser_ros.metal.body import COMPACT, SPACINGS, body_sizes
from anser_ros.parallel import in_order

Array = NDArray[np.float64]

TRIALS = 3
"""Iterations after which kinds of bodies are compared; the best one is fitted on. All begin at
places that have been fitted, and each iteration costs as much as the one before."""
EVERY_OTHER = 2
"""Every so many frames are used to compare kinds of bodies: it takes half the time."""


@dataclass(frozen=True)
class Shaping:
    """Shapes metal that moves in a fit."""

    fitter: Fitter
    richness: Richness  # how many modes and knots it may have

    def shaped(self, fit: Fit, index: int) -> Fit:
        """Return the fit with one moving metal shaped; the same fit for any other effect."""
        body = _body(fit.terms[index])
        if body is None or body.richness == self.richness:
            return fit
        return self.with_freer_course(self._bodied(fit, index, body), index)

    def with_freer_course(self, fit: Fit, index: int) -> Fit:
        """Return the fit with a freer path, as long as its parameters are worth it."""
        for knots in self.richness.knots:
            body = _body(fit.terms[index])
            if body is None or fit.misfit < self.richness.left * noise_scale(fit.state) ** 2:
                break
            freer = body.freer(knots)
            if freer is None:
                continue
            other = self.fitter.fit(_with(fit.terms, index, freer))
            price = PER_PARAMETER * (freer.placed - body.placed) * max(other.misfit, 1.0)
            if fit.held_out() - other.held_out() < price:
                break
            fit = other
        return fit

    def _bodied(self, fit: Fit, index: int, first: BodyTerm) -> Fit:
        """The fit with a richer body.

        A simple body fitted in place of an extended one may have converged to a wrong place, so
        its start is tried too.
        """
        if first.richness is not None:
            return self.shaped_as(fit, index, first, [first.kind]) or fit
        half = self.fitter.problem.in_blocks(self.fitter.blocks, EVERY_OTHER)
        trial = replace(self, fitter=replace(self.fitter, problem=half, iterations=TRIALS))
        starts, families = [trial.fitter.fit(fit.terms, 0)], [[COMPACT], [*SPACINGS]]
        restarted = first.restarted()
        if restarted is not None:
            linear = trial.fitter.fit(_with(fit.terms, index, restarted.hold()), 1)
            starts.append(trial.fitter.fit([t.free() for t in linear.terms], 0))

        def shape(pair: tuple[Fit, list[str]]) -> Fit | None:
            start, kinds = pair
            body = _body(start.terms[index])
            return None if body is None else trial.shaped_as(start, index, body, kinds)

        found = in_order(shape, product(starts, families))
        shaped = [fit for fit in found if fit is not None]
        if not shaped:
            return fit
        best = min(shaped, key=Fit.held_out)
        body = _body(best.terms[index])
        assert body is not None
        best = self.fitter.fit(best.terms, 0)
        return self.shaped_as(best, index, body, [body.kind]) or best

    def shaped_as(self, fit: Fit, index: int, body: BodyTerm, kinds: Sequence[str]) -> Fit | None:
        """Return the fit with the best of some kinds of bodies; None if no body is better."""
        fitter = self.fitter
        bare = _with(fit.terms, index, body.with_theta(_without_amounts(body)))
        few = thinned(evaluate(fitter.problem, bare), fitter.blocks)
        known = self._known(fit, index, body)
        best: tuple[float, str, Array] | None = None
        for kind in kinds:

            def unit(view: View, modes: Array, kind: str = kind) -> NDArray[np.inexact]:
                return body.with_body(kind, modes, np.ones(modes.shape[1])).unit(view)

            most, sizes = self.richness.modes, body_sizes(kind)
            found = rich_modes(few, known, unit, sizes, fitter.blocks, most)
            if found is not None and (best is None or found[0] < best[0]):
                best = (found[0], kind, found[1])
        if best is None:
            return None
        rich = body.shaped(best[1], best[2], self.richness)
        start = fitter.fit(_with(fit.terms, index, rich.hold()), 1)
        return fitter.fit(_with(start.terms, index, start.terms[index].free()))

    def _known(self, fit: Fit, index: int, body: BodyTerm) -> Known:
        """Columns of all terms, of the metal that moves only those of its course."""
        few = thinned(fit.state, self.fitter.blocks)
        groups, priors = [], []
        for i, term in enumerate(fit.terms):
            columns, prior = few.design(term), term.effect.prior(term)
            if i == index:
                columns = [None if c is None else c[..., : body.placed] for c in columns]
                prior = prior[: body.placed]
            groups.append(columns)
            priors.append(prior)
        return joined(groups), np.concatenate(priors)


def _body(term: Term) -> BodyTerm | None:
    return term.effect.body(term)


def _without_amounts(term: Term) -> Array:
    theta = term.theta.copy()
    theta[term.effect.amounts(term)] = 0.0
    return theta


def _with(terms: Sequence[Term], index: int, term: Term) -> tuple[Term, ...]:
    return tuple(term if i == index else t for i, t in enumerate(terms))
