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
"""What a way of one step of the grid between two blocks costs, as a share of the largest gain of a
place in a block; it grows with the square of the way. Without it a place follows noise."""
NO_PRIOR = 1e6
"""Prior spread (1e-4 m^3) of a scatterer's answer in a block: a hundred cubic metres, no bound."""


Place = tuple[Array, BlockSums, float]


def moving_starts(
    problem: Problem,
    scored: Sequence[tuple[Term, Score]],
    scorer: Scorer[State],
    blocks: NDArray[np.int64],
) -> list[tuple[float, Term]]:
    """Return expected gain and start values of effects that are another one at a place for each
    block.

    None if one place for the whole session explains as much.

    ``scored``: all candidates, from ``scorer``; ``blocks``: the time blocks that take part.
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
    places, gains = _places(scored)
    if not places:
        return []
    one_place = scorer.held_out - min(held_out for _, _, held_out in places)
    alone = float(gains.max(axis=0).sum())
    excess = scorer.state.sum_of_squares - scorer.state.count
    if alone < max(LEAST_PATH_GAIN * one_place + LEAST_MOTION_GAIN, LEAST_OF_EXCESS * excess):
        return []
    course, solution = _course(places, gains)
    time = (blocks + 0.5) * problem.apparatus.duration / (blocks.max() + 1)
    starts = effect.along(time, course, solution, problem.apparatus)
    return [(alone, start) for start in starts]


def course_of(scored: Sequence[tuple[Term, Score]]) -> tuple[Array, Array] | None:
    """Return where metal at rest fits best in each block (B, 3), m, frame fg, and the solution of
    the probe in the block where it explains most; None without such metal.
    """
    places, gains = _places(scored)
    return _course(places, gains) if places else None


def _places(scored: Sequence[tuple[Term, Score]]) -> tuple[list[Place], Array]:
    """Places of metal at rest, and what each explains in each block, shape (places, blocks)."""
    places = [
        (rest.centre, score.own, score.held_out)
        for term, score in scored
        if (rest := term.effect.resting(term)) is not None
    ]
    gains = [own.explained_alone(np.full(own.size, NO_PRIOR)) for _, own, _ in places]
    return places, np.array(gains)


def _course(places: Sequence[Place], gains: Array) -> tuple[Array, Array]:
    """The smoothest course, and the solution of the block in which a place explains most."""
    points = np.array([centre for centre, _, _ in places])
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
