"""Starts explanations with freedom in time, and chooses among several: the steps of one round.

Spreads of fluctuations; places of metal that moves, block by block; which fitted explanation is
taken; and whether metal that seems to move rests.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.diagnosis import decisions
from anser_ros.diagnosis.engine import BlockSums, Score, Scorer
from anser_ros.diagnosis.fit import Fit, Fitter, settled
from anser_ros.diagnosis.problem import Problem, State, evaluate, parts
from anser_ros.diagnosis.structure import noise_scale
from anser_ros.effects.effect import Family, Term
from anser_ros.effects.registry import all_effects
from anser_ros.effects.view import View

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

SCALES = np.geomspace(1e-3, 1.0, 7)
"""Spreads that are tried first, as multiples of what the constant effect expects; the estimation
starts at the best of them."""
EXPECTATION_ROUNDS = 25
"""Rounds of expectation-maximisation, which has less than a factor of two to go."""


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


STEP_PRICE = 0.05
"""Price of a way of one step of the grid between two blocks, over the largest gain of a place; it
grows with the square of the way. Without it a place follows noise."""
NO_PRIOR = 1e6
"""Prior spread (1e-4 m^3) of a scatterer's answer in a block: a hundred cubic metres, no bound."""


Place = tuple[Array, BlockSums, float]


def moving_starts(
    problem: Problem,
    scored: Sequence[tuple[Term, Score]],
    scorer: Scorer[State],
    blocks: NDArray[np.int64],
) -> list[tuple[float, Term]]:
    """Return expected gain and start values of effects that are another one (`Effect.still`) at a
    place for each block; none where one place for the whole session explains as much.

    ``scored``: all candidates, from ``scorer``; ``blocks``: the time blocks that take part.
    """
    found: list[tuple[float, Term]] = []
    excess = scorer.state.sum_of_squares - scorer.state.count
    time = (blocks + 0.5) * problem.apparatus.duration / (blocks.max() + 1)
    for effect in all_effects().values():
        places, gains = _places([(t, s) for t, s in scored if t.effect is effect.still])
        if not places:
            continue
        one_place = scorer.held_out - min(held_out for _, _, held_out in places)
        alone = float(gains.max(axis=0).sum())
        moves = decisions.LEAST_PATH_GAIN * one_place + decisions.LEAST_MOTION_GAIN
        if alone >= max(moves, decisions.LEAST_OF_EXCESS * excess):
            starts = effect.along(time, *_course(places, gains), problem.apparatus)
            found += [(alone, start) for start in starts]
    return found


def course_of(scored: Sequence[tuple[Term, Score]]) -> tuple[Array, Array] | None:
    """Return where metal at rest fits best in each block (B, 3), m, frame fg, and the probe's
    solution in the block where it explains most; None without such metal.
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
    sums = places[int(np.argmax(gains[:, best]))][1].part(np.array([best]))
    return points[_smoothest(points, gains)], sums.solve(np.full(sums.size, NO_PRIOR))[0]


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


def at_floor(fit: Fit) -> bool:
    """Return whether a fit leaves nothing but noise."""
    return fit.misfit < decisions.NOTHING_LEFT * max(noise_scale(fit.state) ** 2, 1.0)


def taken_from_others(fit: Fit) -> float:
    """Return what a new fluctuation's freedom takes off that is another effect's: for each of its
    columns, every frame loses the share of one value in the remaining residual.
    """
    freedom = fit.newest.effect.freedom(fit.newest)
    return decisions.FROM_OTHERS * freedom * max(fit.misfit - 1.0, 0.0)


def choose(fitted: Sequence[tuple[float, Fit]]) -> tuple[float, Fit]:
    """Return the best fit, or a simpler one that is as good within what its parameters could gain.

    If several leave nothing but noise, the simplest is chosen.
    """
    gain, best = max(fitted, key=lambda pair: pair[0])
    newest = best.newest
    steady = [
        (g, f)
        for g, f in fitted
        if g > decisions.STEADY * gain and newest.effect.rivals(newest, f.newest)
    ]
    if steady:
        gain, best = max(steady, key=lambda pair: pair[0])
    most = best.newest.complexity
    simpler = [
        (g, f)
        for g, f in fitted
        if f.newest.complexity < most
        and gain - g < decisions.as_good(most - f.newest.complexity) * max(best.misfit, 1.0)
    ]
    simpler += [
        (g, f)
        for g, f in fitted
        if f.newest.effect.family is Family.FLUCTUATION
        and f.newest.complexity < most
        and at_floor(f)
    ]
    if not simpler:
        return gain, best
    return min(simpler, key=lambda pair: (pair[1].newest.complexity, -pair[0]))


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

    Returns a settled fit (`anser_ros.diagnosis.fit`).
    """
    shaped = settled(fitter, moving.terms)
    resting = [(g, f) for g, f in fitted if f.newest.effect.family is Family.METAL_AT_REST]
    gain, rest = max(resting, key=lambda pair: pair[0], default=(0.0, moving))
    if gain < decisions.NO_RIVAL * explained:
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
        hopeless = (
            score.held_out > decisions.LIMITS_LEFT * limit + decisions.REST_LEFT * scorer.held_out
        )
        if hopeless or len(tried) == decisions.MOST_EFFECTS_AT_REST:
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
    more = decisions.ALIKE * explained + decisions.LEAST_MOTION_GAIN * max(moving.misfit, 1.0)
    return moving.held_out() + more
