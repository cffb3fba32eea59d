"""Fits the parameters of all effects in force by Gauss-Newton."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from anser_ros.diagnosis.decisions import TIME_FOLDS
from anser_ros.diagnosis.problem import Problem, State, evaluate
from anser_ros.diagnosis.scoring import BlockSums, block_sums, joined
from anser_ros.effects.effect import Family
from anser_ros.effects.term import Term

Array = NDArray[np.float64]

ATTEMPTS = 6
"""Dampings that are tried for a step that lowers the sum of squares; each is ten or a hundred
times the one before, so the last steps are far too small to help."""
SETTLED = 1e-5
"""Share of the sum of squares by which a step must lower it for the fit to go on: one, where 1e5
readings are fitted to their noise, so that the step was by a standard deviation and the next, of a
fit that converges, is by far less. Larger ends fits that still creep; smaller costs steps that
change parameters by less than their uncertainty."""


class _HasSum(Protocol):
    """Something with a sum of squares."""

    @property
    def sum_of_squares(self) -> float: ...


AnyState = TypeVar('AnyState', bound=_HasSum)
"""The state of a fit, of fluxes or of poses."""


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

    def held_out(self) -> float:
        """Return the cross-validated squares, linear about the optimum, plus what freedom cost."""
        return self.sums.held_out(self.prior, TIME_FOLDS) + self.state.penalty


@dataclass(frozen=True)
class Fitter:
    """States what effects are fitted on, and how.

    Attributes
    ----------
    problem : Problem
    blocks : ndarray of int
        The time blocks that take part.
    iterations : int
        Most steps of a fit.
    """

    problem: Problem
    blocks: NDArray[np.int64]
    iterations: int

    def fit(self, terms: Sequence[Term], iterations: int | None = None) -> Fit:
        """Fit some terms jointly; see `fit_terms`."""
        steps = self.iterations if iterations is None else iterations
        return fit_terms(self.problem, terms, self.blocks, steps)

    def held_out(self, fit: Fit) -> float:
        """Return the cross-validated sum of squares of a fit, and what its freedom cost."""
        return fit.held_out()


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
    state, sums, prior = descended(
        evaluate(problem, terms),
        lambda state: _sums(state, block_numbers),
        lambda state, step: evaluate(problem, stepped(state.terms, step)),
        iterations,
    )
    misfit = state.sum_of_squares / max(state.count, 1)
    covariance = sums.covariance(prior, misfit) if prior.size else np.zeros((0, 0))
    return Fit(state, covariance, sums, prior)


def descended(
    state: AnyState,
    sums_of: Callable[[AnyState], tuple[BlockSums, Array]],
    moved: Callable[[AnyState, Array], AnyState],
    iterations: int,
) -> tuple[AnyState, BlockSums, Array]:
    """Lower a sum of squares by damped Gauss-Newton steps until it has settled.

    Parameters
    ----------
    state : State or alike
        Where it starts.
    sums_of, moved : callable
        They return the normal equations with the prior, and the state after a step.
    iterations : int
        Most steps.

    Returns
    -------
    state, sums, prior
        At the end.
    """
    (sums, prior), damping = sums_of(state), 0.0
    for _ in range(iterations if prior.size else 0):
        better, damping = _better(state, sums, prior, moved, damping)
        if better is None:
            break
        gain = state.sum_of_squares - better.sum_of_squares
        settled = gain < SETTLED * state.sum_of_squares
        state = better
        sums, prior = sums_of(state)
        if settled:
            break
    return state, sums, prior


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
    state: AnyState,
    sums: BlockSums,
    prior: Array,
    moved: Callable[[AnyState, Array], AnyState],
    damping: float,
) -> tuple[AnyState | None, float]:
    """A state with a lower sum of squares, and the damping (Marquardt's) that found it."""
    for attempt in range(ATTEMPTS):
        trial = moved(state, sums.step(prior, damping))
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
