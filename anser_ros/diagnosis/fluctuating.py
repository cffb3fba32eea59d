"""Finds how much a parameter fluctuates from frame to frame, and what that explains.

Each frame's parameters are a draw from a normal distribution about zero. Its spread is found by
expectation-maximisation; the gain is that of -2 log marginal likelihood, which includes the cost
of this freedom, and can be compared with the reduction of the held-out sum of squares by a
constant effect.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.diagnosis.problem import Problem, State, evaluate
from anser_ros.diagnosis.whitening import parts
from anser_ros.effects.effect import Family
from anser_ros.effects.term import Term

Array = NDArray[np.float64]

SCALES = np.geomspace(1e-3, 1.0, 7)
"""Spreads that are tried first, as multiples of what the constant effect expects: from a
thousandth to all of it, a factor of 3.2 apart. Coarser or fewer leave expectation-maximisation,
which starts at the best, farther to go; more cost time."""
EXPECTATION_ROUNDS = 25
"""Rounds of expectation-maximisation. It starts at the best of seven spreads, so it has less than
a factor of two to go."""


@dataclass(frozen=True)
class Open:
    """Holds the normal equations of each frame: shapes (F, q, q) and (F, q)."""

    normal: Array
    right: Array


def opened(state: State, term: Term) -> Open | None:
    """Return each frame's normal equations along a fluctuation's columns; None for others."""
    free, normal, right = term.effect.opened(term), [], []
    if free is None:
        return None
    for part in state.parts:
        raw = free.columns(part.view)
        if raw is None:
            continue
        white = part.whitener(parts(raw))
        normal.append(white.transpose(0, 2, 1) @ white)
        right.append(np.einsum('fnq,fn->fq', white, part.white))
    if not normal:
        return None
    found = Open(np.concatenate(normal), np.concatenate(right))
    return found if np.any(found.normal) else None


def gain_of(found: Open, spread: Array) -> float:
    """Return what -2 log marginal likelihood falls by with this spread."""
    inner = np.eye(spread.size) + found.normal * spread[:, None] * spread[None, :]
    b = found.right * spread
    taken = np.einsum('fq,fq->', b, np.linalg.solve(inner, b[..., None])[..., 0])
    return float(taken - np.linalg.slogdet(inner)[1].sum())


def fluctuation_of(state: State, term: Term) -> tuple[float, Term] | None:
    """Return the gain of a fluctuation at its likeliest spread, and the term with it.

    None for other effects, and if no spread improves the fit.
    """
    free, found = term.effect.opened(term), opened(state, term)
    if free is None or found is None:
        return None
    unit = free.expected
    gains = [gain_of(found, scale * unit) for scale in SCALES]
    if max(gains) <= 0.0:
        return None
    spread = SCALES[int(np.argmax(gains))] * unit
    for _ in range(EXPECTATION_ROUNDS):
        inverse = np.linalg.inv(found.normal + np.diag(1 / spread**2))
        mean = np.einsum('fpq,fq->fp', inverse, found.right)
        variance = np.mean(mean**2 + np.einsum('fqq->fq', inverse), axis=0)
        spread = np.maximum(np.sqrt(variance), 1e-6 * unit)
    return gain_of(found, spread), replace(free, spread=spread, frames=found.right.shape[0])


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
    """Return the share of a candidate's power that the fluctuations in force leave it, or 1."""
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
