"""Fits the parameters of all effects in force by Gauss-Newton."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.diagnosis.problem import Problem, State, evaluate
from anser_ros.diagnosis.scoring import BlockSums, block_sums, joined
from anser_ros.effects.effect import Family
from anser_ros.effects.term import Term

Array = NDArray[np.float64]

ATTEMPTS = 6
"""Dampings that are tried for a step that lowers the sum of squares; each is ten or a hundred
times the one before, so the last steps are far too small to help."""
SETTLED = 1e-5
"""Share of the sum of squares by which a step must lower it for the fit to go on. Larger ends fits
that still creep; smaller costs steps that change parameters by far less than their uncertainty.
Its choice is not recorded."""


@dataclass(frozen=True)
class Fit:
    """Holds terms at their joint optimum.

    Attributes
    ----------
    state : State
    covariance : ndarray, shape (q, q)
        Of all terms' parameters, in their order.
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
        """Return all terms with their fitted parameters."""
        return self.state.terms

    @property
    def effects(self) -> tuple[Term, ...]:
        """Return the terms that explain something of their own, without others' parts."""
        return tuple(t for t in self.terms if t.effect.family is not Family.REMAINDER)

    @property
    def newest(self) -> Term:
        """Return the term of the effect that was added last."""
        return self.effects[-1]

    def covariance_of(self, index: int) -> Array:
        """Return the covariance of one term; where it is held, what it had when it was free."""
        held = self.terms[index].held
        if held is not None and held.covariance is not None:
            return held.covariance
        sizes = np.cumsum([0] + [t.theta.size for t in self.terms])
        rows = slice(sizes[index], sizes[index + 1])
        return self.covariance[rows, rows]

    def held_out(self, folds: int) -> float:
        """Return the cross-validated squares, linear about the optimum, plus what freedom cost."""
        return self.sums.held_out(self.prior, folds) + self.state.penalty


@dataclass(frozen=True)
class Fitter:
    """States what effects are fitted on, and how.

    Attributes
    ----------
    problem : Problem
    blocks : ndarray of int
        The time blocks that take part.
    folds : int
        Parts of the cross-validation over those blocks.
    iterations : int
        Most steps of a fit.
    """

    problem: Problem
    blocks: NDArray[np.int64]
    folds: int
    iterations: int

    def fit(self, terms: Sequence[Term], iterations: int | None = None) -> Fit:
        """Fit some terms jointly; see `fit_terms`."""
        steps = self.iterations if iterations is None else iterations
        return fit_terms(self.problem, terms, self.blocks, steps)

    def held_out(self, fit: Fit) -> float:
        """Return the cross-validated sum of squares of a fit, and what its freedom cost."""
        return fit.held_out(self.folds)


def fit_terms(
    problem: Problem,
    terms: Sequence[Term],
    block_numbers: NDArray[np.int64],
    iterations: int,
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
    covariance = _covariance(state, sums, prior) if prior.size else np.zeros((0, 0))
    return Fit(state, covariance, sums, prior)


def _covariance(state: State, sums: BlockSums, prior: Array) -> Array:
    """Covariance of all parameters, honest about errors that are alike within a block of time.

    The formal one is scaled by the misfit; where the blocks' scores scatter more than it predicts
    (White's sandwich with blocks as clusters), a parameter's variance is raised accordingly.
    """
    formal = sums.solve(prior)[1]
    blocks = max(sums.squares.size, 2)
    scores = sums.right @ formal
    robust = np.sum(scores**2, axis=0) * blocks / (blocks - 1)
    variance = np.diag(formal) * max(state.sum_of_squares / max(state.count, 1), 1.0)
    scale = np.sqrt(np.maximum(variance, robust) / np.maximum(np.diag(formal), 1e-300))
    return np.asarray(formal * scale[:, None] * scale[None, :])


def misfit(fit: Fit) -> float:
    """Return the mean square of the whitened residuals; one where only noise is left."""
    return fit.state.sum_of_squares / max(fit.state.count, 1)


def stepped(terms: Sequence[Term], step: Array) -> list[Term]:
    """Return terms with a step added to all their parameters."""
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
