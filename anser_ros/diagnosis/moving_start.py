"""Start values for metal that moves: where it fits best in each stretch of time."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from anser_ros.diagnosis.problem import Problem
from anser_ros.diagnosis.scoring import BlockSums, Score, Scorer
from anser_ros.effects.effect import Term
from anser_ros.effects.metal_path import FreePath, StraightPath
from anser_ros.effects.moving_metal import MovingMetal
from anser_ros.effects.registry import all_effects

Array = NDArray[np.float64]

FREER = 1.05
"""Places that differ from block to block must explain so much more than one place."""
LEAST_MORE = 100.0
LEAST_OF_EXCESS = 0.4
"""Share of what is left to explain that metal at another place in each block must explain."""
SHORT_WAY = 0.02
KNOTS = 9
ROUGHNESS = 3.0
"""Weight of the distance between neighbouring blocks' places, in gains a grid step."""


def moving_starts(
    problem: Problem,
    scored: Sequence[tuple[Term, Score]],
    scorer: Scorer,
    blocks: NDArray[np.int64],
) -> list[tuple[float, Term]]:
    """Expected gain and starts for moving metal; none where one place explains as much."""
    effect = all_effects().get('moving_metal')
    places = [(t, s) for t, s in scored if t.effect.name == 'static_metal']
    if not isinstance(effect, MovingMetal) or not places:
        return []
    still = min(s.held_out for _, s in places)
    gains = np.array([[_gain(s.own, [i]) for i in range(blocks.size)] for _, s in places])
    alone = float(gains.max(axis=0).sum())
    excess = scorer.state.sum_of_squares - scorer.state.count
    if alone < max(FREER * (scorer.held_out - still) + LEAST_MORE, LEAST_OF_EXCESS * excess):
        return []
    points = np.array([t.theta[:3] for t, _ in places])
    course = points[_smoothest(points, gains)]
    best = int(np.argmax([gains[:, i].max() for i in range(blocks.size)]))
    sums = places[int(np.argmax(gains[:, best]))][1].own
    alpha = sums.part(np.array([best])).solve(np.full(2, 1e6))[0]
    duration = problem.apparatus.duration
    start, end = (
        course[: max(2, blocks.size // 8)].mean(0),
        course[-max(2, blocks.size // 8) :].mean(0),
    )
    time = (blocks + 0.5) * duration / (blocks.max() + 1)
    path, knots = FreePath.through(np.linspace(0.0, duration, KNOTS), time, course)
    free = effect.starting(path, knots, duration, alpha)
    if np.linalg.norm(end - start) < SHORT_WAY:
        start = start + np.array([0.0, 0.0, -0.05])
    times = (0.2 * duration, 0.8 * duration)
    straight = np.concatenate([start, end, times, [0.5]])
    return [
        (alone, effect.starting(StraightPath(), straight, duration, alpha)),
        (alone, free),
    ]


def _smoothest(points: Array, gains: Array) -> NDArray[np.int64]:
    """Place (by index) in each block: much gain, little way (Viterbi's algorithm)."""
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    step = np.median(np.where(apart > 0, apart, np.inf).min(axis=1))
    price = 0.05 * gains.max() * (apart / step) ** 2
    best, back = gains[:, 0], []
    for block in range(1, gains.shape[1]):
        total = best[None, :] - price
        back.append(np.argmax(total, axis=1))
        best = total.max(axis=1) + gains[:, block]
    way = [int(np.argmax(best))]
    for origin in reversed(back):
        way.append(int(origin[way[-1]]))
    return np.array(way[::-1])


def _gain(sums: BlockSums, rows: Sequence[int]) -> float:
    part = sums.part(np.array(rows))
    estimate, _ = part.solve(np.full(part.size, 1e6))
    return float(part.right.sum(axis=0) @ estimate)
