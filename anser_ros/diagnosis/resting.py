"""Tests whether metal that seems to move rests, and something else changes with time."""

from collections.abc import Callable, Sequence

from anser_ros.diagnosis.decisions import (
    ALIKE,
    LEAST_MOTION_GAIN,
    LIMITS_LEFT,
    MOST_EFFECTS_AT_REST,
    NO_RIVAL,
    REST_LEFT,
)
from anser_ros.diagnosis.engine import Score, Scorer
from anser_ros.diagnosis.fit import Fit, Fitter
from anser_ros.diagnosis.problem import State
from anser_ros.diagnosis.refine import settled
from anser_ros.effects.effect import Family
from anser_ros.effects.term import Term


def moves_or_rests(
    fitter: Fitter,
    moving: Fit,
    fitted: Sequence[tuple[float, Fit]],
    candidates: Callable[[Scorer[State]], Sequence[tuple[Term, Score]]],
    explained: float,
) -> Fit:
    """Return metal that moves, or at rest where that explains as much, alone or with one effect.

    ``moving``: with metal that moves for its newest effect; ``fitted``: all fits of the round;
    those with metal at rest for their newest effect are the rivals; ``candidates``: all other
    effects with their scores, best first, from a scorer; ``explained``: what the metal that moves
    takes off the held-out sum of squares.

    Returns Fit: settled (`anser_ros.diagnosis.refine`).
    """
    shaped = settled(fitter, moving.terms)
    resting = [(g, f) for g, f in fitted if f.newest.effect.family is Family.METAL_AT_REST]
    gain, rest = max(resting, key=lambda pair: pair[0], default=(0.0, moving))
    if gain < NO_RIVAL * explained:
        return shaped
    rest = settled(fitter, rest.terms)
    limit = _limit(fitter, shaped, explained)
    if rest.held_out() < limit:
        return rest
    scorer = Scorer(rest.state, fitter.blocks)
    tried: set[str] = set()
    for term, score in candidates(scorer):
        if term.effect.family.is_metal or term.effect.name in tried:
            continue
        # A linear score is only a promise: the fit may still bring down what is within these.
        hopeless = score.held_out > LIMITS_LEFT * limit + REST_LEFT * scorer.held_out
        if hopeless or len(tried) == MOST_EFFECTS_AT_REST:
            break
        tried.add(term.effect.name)
        for start in term.effect.started(term, score.solution):
            both = fitter.fit([*rest.terms, start])
            if both.held_out() > limit:
                continue
            # What is there besides helps metal that moves as much: like is compared with like.
            beside = fitter.fit([*shaped.terms, start])
            if both.held_out() < _limit(fitter, beside, explained):
                return rest
    return shaped


def _limit(fitter: Fitter, moving: Fit, explained: float) -> float:
    """Held-out sum of squares up to which metal at rest explains as much."""
    more = ALIKE * explained + LEAST_MOTION_GAIN * max(moving.misfit, 1.0)
    return moving.held_out() + more
