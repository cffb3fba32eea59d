"""Gauss-Newton on the parameters of all effects in force."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.diagnosis.problem import Problem, State, evaluate
from anser_ros.diagnosis.scoring import BlockSums, block_sums, joined
from anser_ros.effects.effect import Term

Array = NDArray[np.float64]

ATTEMPTS = 6
SETTLED = 1e-4
"""A step that lowers the sum of squares by less than this share ends the fit."""


@dataclass(frozen=True)
class Fit:
    """Terms at their joint optimum.

    Attributes
    ----------
    state : State
    covariance : ndarray, shape (q, q)
        Of all terms' parameters, in their order; scaled by the misfit where that is above one.
    sums : BlockSums
        Normal equations at the optimum.
    prior : ndarray, shape (q,)
    """

    state: State
    covariance: Array
    sums: BlockSums
    prior: Array

    @property
    def terms(self) -> tuple[Term, ...]:
        """The terms with their parameters."""
        return self.state.terms

    def covariance_of(self, index: int) -> Array:
        """Block of one term; where it was held, what it had when it was free."""
        kept = self.terms[index].site.get('_covariance')
        if kept is not None:
            return np.asarray(kept)
        sizes = np.cumsum([0] + [t.theta.size for t in self.terms])
        rows = slice(sizes[index], sizes[index + 1])
        return self.covariance[rows, rows]

    def held_out(self, folds: int) -> float:
        """Cross-validated sum of squares, linear about the optimum."""
        return self.sums.held_out(self.prior, folds)


def fit_terms(
    problem: Problem,
    terms: Sequence[Term],
    block_numbers: NDArray[np.int64],
    iterations: int = 8,
) -> Fit:
    """Fit all parameters of all terms together.

    Parameters
    ----------
    problem : Problem
    terms : sequence of Term
        Start values.
    block_numbers : ndarray
        The time blocks, for the sums that are kept.
    iterations : int
        At most.
    """
    state = evaluate(problem, terms)
    sums, prior = _sums(state, block_numbers)
    damping = 0.0
    for _ in range(iterations):
        if prior.size == 0:
            break
        better, damping = _better(problem, state, sums, prior, damping)
        if better is None:
            break
        gain = state.sum_of_squares - better.sum_of_squares
        settled = gain < SETTLED * state.sum_of_squares
        state = better
        sums, prior = _sums(state, block_numbers)
        if settled:
            break
    covariance = sums.solve(prior)[1] if prior.size else np.zeros((0, 0))
    misfit = state.sum_of_squares / max(state.count, 1)
    return Fit(state, covariance * max(misfit, 1.0), sums, prior)


def stepped(terms: Sequence[Term], step: Array) -> list[Term]:
    """Terms with a step added to all their parameters."""
    out, start = [], 0
    for term in terms:
        part = step[start : start + term.theta.size]
        start += term.theta.size
        out.append(term.effect.bounded(term.with_theta(term.theta + part)))
    return out


def _better(
    problem: Problem, state: State, sums: BlockSums, prior: Array, damping: float
) -> tuple[State | None, float]:
    """A state with a lower sum of squares, and the damping (Marquardt's) that found it."""
    for attempt in range(ATTEMPTS):
        step = sums.step(prior, damping)
        trial = evaluate(problem, stepped(state.terms, step))
        if trial.sum_of_squares < state.sum_of_squares:
            return trial, damping / 30 if damping > 1e-6 else 0.0
        damping = max(1e-5, 10 ** (attempt % 2 + 1) * damping)
    return None, damping


def _sums(state: State, block_numbers: NDArray[np.int64]) -> tuple[BlockSums, Array]:
    columns = joined([state.design(term) for term in state.terms]) if state.terms else None
    if columns is None:
        columns = [None] * len(state.parts)
    prior = [term.effect.prior(term) for term in state.terms]
    stacked = np.concatenate(prior) if prior else np.zeros(0)
    return block_sums(state, columns, block_numbers), stacked
