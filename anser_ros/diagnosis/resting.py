"""Whether metal that seems to move rests, and something else changes with time."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from anser_ros.diagnosis.fit import Fit, fit_terms, misfit
from anser_ros.diagnosis.problem import Problem
from anser_ros.diagnosis.refine import AT_REST, METALS, settled
from anser_ros.diagnosis.scoring import Score, Scorer
from anser_ros.effects.effect import Term

TRIED = 3
FAR_LESS = 0.25
"""Metal at rest that explains less than this share by itself is no rival."""
LEAST_SHARE, LEAST = 0.02, 100.0
"""Metal moves when that explains so much more, as a share of all that it explains, and in units of
the misfit."""


def moves_or_rests(
    problem: Problem,
    blocks: NDArray[np.int64],
    moving: Fit,
    fitted: Sequence[tuple[float, Fit]],
    candidates: Callable[[Scorer], Sequence[tuple[Term, Score]]],
    explained: float,
    folds: int,
    iterations: int,
) -> Fit:
    """Metal that moves, or metal at rest where it explains as much, alone or beside one effect.

    Parameters
    ----------
    problem, blocks, folds, iterations : as in `anser_ros.diagnosis.search`
    moving : Fit
        With metal that moves for its newest effect.
    fitted : sequence of (float, Fit)
        All fits of the round; those with metal at rest for their newest effect are the rivals.
    candidates : callable
        All other effects with their scores, best first, from a scorer.
    explained : float
        What the metal that moves takes off the held-out sum of squares.

    Returns
    -------
    Fit
        Settled (`anser_ros.diagnosis.refine`).
    """
    shaped = settled(problem, moving.terms, blocks, folds, iterations)
    resting = [(g, f) for g, f in fitted if f.terms[-1].effect.name in AT_REST]
    gain, rest = max(resting, key=lambda pair: pair[0], default=(0.0, moving))
    if gain < FAR_LESS * explained:
        return shaped
    rest = settled(problem, rest.terms, blocks, folds, iterations)
    limit = _limit(shaped, explained, folds)
    if rest.held_out(folds) < limit:
        return rest
    scorer = Scorer(rest.state, blocks, folds)
    tried: set[str] = set()
    for term, score in candidates(scorer):
        if term.effect.name in METALS or term.effect.name in tried:
            continue
        if len(tried) == TRIED or score.held_out > 2.0 * limit + 0.5 * scorer.held_out:
            break
        tried.add(term.effect.name)
        for start in term.effect.started(term, score.solution):
            both = fit_terms(problem, [*rest.terms, start], blocks, iterations)
            if both.held_out(folds) > limit:
                continue
            # What is there besides helps metal that moves as much: like is compared with like.
            beside = fit_terms(problem, [*shaped.terms, start], blocks, iterations)
            if both.held_out(folds) < _limit(beside, explained, folds):
                return rest
    return shaped


def _limit(moving: Fit, explained: float, folds: int) -> float:
    """Held-out sum of squares up to which metal at rest explains as much."""
    more = LEAST_SHARE * explained + LEAST * max(misfit(moving), 1.0)
    return moving.held_out(folds) + more
