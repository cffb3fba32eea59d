"""Finds how much a parameter fluctuates from frame to frame, and what that explains.

Each frame's parameters are a draw from a normal distribution about zero. Its spread is found by
expectation-maximisation; the gain is that of -2 log marginal likelihood, which includes the cost
of this freedom, and can be compared with the reduction of the held-out sum of squares by a
constant effect.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.diagnosis.problem import Problem, State, evaluate
from anser_ros.diagnosis.whitening import parts
from anser_ros.effects.effect import Family
from anser_ros.effects.term import Term
from anser_ros.effects.view import View

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

SCALES = np.geomspace(1e-3, 1.0, 7)
"""Spreads that are tried first, as multiples of what the constant effect expects; the estimation
starts at the best of them."""
EXPECTATION_ROUNDS = 25
"""Rounds of expectation-maximisation. It starts at the best of seven spreads, so it has less than
a factor of two to go."""


def _opened(
    state: State, columns: Callable[[View], ComplexArray | None]
) -> tuple[Array, Array] | None:
    """Each frame's normal equations along a fluctuation's columns, (F, q, q) and (F, q)."""
    normal, right = [], []
    for part in state.parts:
        raw = columns(part.view)
        if raw is not None:
            white = part.whitener(parts(raw))
            normal.append(white.transpose(0, 2, 1) @ white)
            right.append(np.einsum('fnq,fn->fq', white, part.white))
    if not any(np.any(one) for one in normal):
        return None
    return np.concatenate(normal), np.concatenate(right)


def _gain_of(normal: Array, right: Array, spread: Array) -> float:
    """What -2 log marginal likelihood falls by with this spread."""
    inner = np.eye(spread.size) + normal * spread[:, None] * spread[None, :]
    b = right * spread
    taken = np.einsum('fq,fq->', b, np.linalg.solve(inner, b[..., None])[..., 0])
    return float(taken - np.linalg.slogdet(inner)[1].sum())


def fluctuation_of(state: State, term: Term) -> tuple[float, Term] | None:
    """Return the gain of a fluctuation at its likeliest spread, and the term with it.

    None for other effects, and if no spread improves the fit.
    """
    free = term.effect.opened(term)
    found = None if free is None else _opened(state, free.columns)
    if free is None or found is None:
        return None
    (normal, right), unit = found, free.expected
    gains = [_gain_of(normal, right, scale * unit) for scale in SCALES]
    if max(gains) <= 0.0:
        return None
    spread = SCALES[int(np.argmax(gains))] * unit
    for _ in range(EXPECTATION_ROUNDS):
        inverse = np.linalg.inv(normal + np.diag(1 / spread**2))
        mean = np.einsum('fpq,fq->fp', inverse, right)
        variance = np.mean(mean**2 + np.einsum('fqq->fq', inverse), axis=0)
        spread = np.maximum(np.sqrt(variance), 1e-6 * unit)
    return _gain_of(normal, right, spread), replace(free, spread=spread, frames=len(right))


def refit_spreads(problem: Problem, terms: Sequence[Term]) -> tuple[Term, ...]:
    """Return the terms with the spread of each fluctuation fitted again, given the others."""
    out = list(terms)
    for i, term in enumerate(out):
        if term.effect.family is Family.FLUCTUATION:
            rest = [t for t in out if t is not term]
            found = fluctuation_of(evaluate(problem, rest), term)
            out[i] = term if found is None else found[1]
    return tuple(out)


def left_over(state: State, term: Term) -> float:
    """Return the share of a candidate's power that the active fluctuations leave it, or 1."""
    if not any(t.effect.family is Family.FLUCTUATION for t in state.terms):
        return 1.0
    now, before = 0.0, 0.0
    for part in state.parts:
        raw = term.effect.probe(term, part.view)
        if raw is None:
            continue
        columns = parts(raw)
        known = 0 if part.view.is_reference else 6
        now += float(np.sum(part.whitener(columns) ** 2))
        before += float(np.sum(part.whitener.first(known)(columns) ** 2))
    return now / before if before > 0 else 1.0
