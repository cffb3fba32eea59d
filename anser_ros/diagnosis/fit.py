"""Fits the parameters of all active effects on fluxes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.diagnosis.engine import JointFit, descended
from anser_ros.diagnosis.problem import Problem, State, evaluate
from anser_ros.effects.effect import Family
from anser_ros.effects.term import Term

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Fit(JointFit[State]):
    """Holds the terms of fluxes at their joint optimum."""

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
        return super().covariance_of(index)


@dataclass(frozen=True)
class Fitter:
    """States what effects are fitted on, and how."""

    problem: Problem
    blocks: NDArray[np.int64]  # of time, those that take part
    iterations: int  # most steps of a fit

    def fit(self, terms: Sequence[Term], iterations: int | None = None) -> Fit:
        """Fit all parameters of some terms together, from their values."""
        steps = self.iterations if iterations is None else iterations
        return Fit(*descended(evaluate(self.problem, terms), self.blocks, steps))
