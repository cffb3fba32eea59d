"""Start values for metal that moves: where it fits best in each stretch of time."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from anser_ros.diagnosis.decisions import LEAST_MOTION_GAIN, LEAST_OF_EXCESS, LEAST_PATH_GAIN
from anser_ros.diagnosis.engine import Score, Scorer
from anser_ros.diagnosis.problem import Problem, State
from anser_ros.diagnosis.scoring import BlockSums
from anser_ros.effects.effect import Effect
from anser_ros.effects.registry import all_effects
from anser_ros.effects.term import Term

Array = NDArray[np.float64]

STEP_PRICE = 0.05
"""What a way of one step of the grid of places between two blocks costs, as a share of the largest
gain of a place in a block; it grows with the square of the way. Without it a place jumps wherever
noise favours another one, with much more it stays at one place."""
NO_PRIOR = 1e6
"""Prior spread (1e-4 m^3) of a scatterer's answer in a block: a hundred cubic metres, no bound."""


def moving_starts(
    problem: Problem,
    scored: Sequence[tuple[Term, Score]],
    scorer: Scorer[State],
    blocks: NDArray[np.int64],
) -> list[tuple[float, Term]]:
    """Return expected gain and start values of effects that are another one at a place for each
    block.

    None if one place for the whole session explains as much.

    Parameters
    ----------
    problem : Problem
    scored : sequence of (Term, Score)
        All candidates, from ``scorer``.
    scorer : Scorer
    blocks : ndarray of int
        The time blocks that take part.
    """
    found = []
    for effect in all_effects().values():
        if effect.still is not None:
            places = [(t, s) for t, s in scored if t.effect is effect.still]
            found += _starts(effect, places, problem, scorer, blocks)
    return found


def _starts(
    effect: Effect[Term],
    scored: Sequence[tuple[Term, Score]],
    problem: Problem,
    scorer: Scorer[State],
    blocks: NDArray[np.int64],
) -> list[tuple[float, Term]]:
    """Starts of one effect along the places of the effect that it is at rest."""
    places = [
        (rest.centre, score.own, score.held_out)
        for term, score in scored
        if (rest := term.effect.resting(term)) is not None
    ]
    if not places:
        return []
    one_place = scorer.held_out - min(held_out for _, _, held_out in places)
    # What a place explains in each block, shape (places, blocks).
    gains = np.array([s.explained_alone(np.full(s.size, NO_PRIOR)) for _, s, _ in places])
    alone = float(gains.max(axis=0).sum())
    excess = scorer.state.sum_of_squares - scorer.state.count
    if alone < max(LEAST_PATH_GAIN * one_place + LEAST_MOTION_GAIN, LEAST_OF_EXCESS * excess):
        return []
    course, solution = _course([(centre, own) for centre, own, _ in places], gains)
    time = (blocks + 0.5) * problem.apparatus.duration / (blocks.max() + 1)
    starts = effect.along(time, course, solution, problem.apparatus)
    return [(alone, start) for start in starts]


def course_of(
    effect: Effect[Term], scored: Sequence[tuple[Term, Score]]
) -> tuple[Array, Array] | None:
    """Return where metal at rest fits best in each block.

    Parameters
    ----------
    effect : Effect
        Metal at rest.
    scored : sequence of (Term, Score)
        Candidates, those of other effects among them.

    Returns
    -------
    course : ndarray, shape (B, 3)
        m, frame fg.
    solution : ndarray
        Of the probe in the block where it explains most.
    """
    places = [
        (rest.centre, score.own)
        for term, score in scored
        if term.effect is effect and (rest := term.effect.resting(term)) is not None
    ]
    if not places:
        return None
    gains = np.array([s.explained_alone(np.full(s.size, NO_PRIOR)) for _, s in places])
    return _course(places, gains)


def _course(places: Sequence[tuple[Array, BlockSums]], gains: Array) -> tuple[Array, Array]:
    """The smoothest course, and the solution of the block in which a place explains most."""
    points = np.array([centre for centre, _ in places])
    best = int(np.argmax(gains.max(axis=0)))
    sums = places[int(np.argmax(gains[:, best]))][1]
    return points[_smoothest(points, gains)], _estimate(sums.part(np.array([best])))


def _smoothest(points: Array, gains: Array) -> NDArray[np.int64]:
    """Place (by index) in each block: much gain, little way (Viterbi's algorithm)."""
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    step = np.median(np.where(apart > 0, apart, np.inf).min(axis=1))
    price = STEP_PRICE * gains.max() * (apart / step) ** 2
    best, back = gains[:, 0], []
    for block in range(1, gains.shape[1]):
        total = best[None, :] - price
        back.append(np.argmax(total, axis=1))
        best = total.max(axis=1) + gains[:, block]
    way = [int(np.argmax(best))]
    for origin in reversed(back):
        way.append(int(origin[way[-1]]))
    return np.array(way[::-1])


def _estimate(sums: BlockSums) -> Array:
    return sums.solve(np.full(sums.size, NO_PRIOR))[0]
