"""Starts explanations with freedom in time, chooses among several, and tests what was chosen.

Spreads of fluctuations; places of metal that moves, block by block; which fitted explanation is
taken; whether metal that seems to move rests; and whether an effect is the same in all parts of
the data, as a real one must be: it is fitted again in parts of the time, emitter by emitter and by
sensor, and the power that those fits remove besides is compared with its own.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from anser_ros.arrays import Array, ComplexArray, Integers
from anser_ros.diagnosis import decisions
from anser_ros.diagnosis.engine import BlockSums, Score, Scorer
from anser_ros.diagnosis.fit import Fit, Fitter, settled
from anser_ros.diagnosis.problem import Part, Problem, State, evaluate, parts
from anser_ros.diagnosis.screening import known_variance, model_share, noise_scale
from anser_ros.effects.base import View
from anser_ros.effects.effect import INEXACT, Family, FluctuationTerm, Term, all_effects
from anser_ros.parallel import in_order

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
            white = part.whitener.columns([raw], [raw.shape[-1]])
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
    problem: Problem, scored: Sequence[tuple[Term, Score]], scorer: Scorer[State], blocks: Integers
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


def _smoothest(points: Array, gains: Array) -> Integers:
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

    If several leave nothing but noise, the simplest is chosen. Metal, whose shape is free, is not
    taken where something simpler explains nearly as much.
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
    most, is_metal = best.newest.complexity, best.newest.effect.family.is_metal

    def is_as_good(own: float, fit: Fit) -> bool:
        spared, family = most - fit.newest.complexity, fit.newest.effect.family
        less = gain - own < decisions.as_good(spared) * max(best.misfit, 1.0)
        plain = is_metal and not family.is_metal and own > (1.0 - decisions.ALIKE) * gain
        return spared > 0 and (less or plain or (family is Family.FLUCTUATION and at_floor(fit)))

    simpler = [pair for pair in fitted if is_as_good(*pair)]
    if not simpler:
        return gain, best
    return min(simpler, key=lambda pair: (pair[1].newest.complexity, -pair[0]))


def moves_or_rests(
    fitter: Fitter,
    moving: Fit,
    fitted: Sequence[tuple[float, Fit]],
    others: Callable[[Scorer[State]], Sequence[tuple[Term, Score]]],
    explained: float,
) -> Fit:
    """Return metal that moves, or at rest where that explains as much, alone or with one effect.

    ``moving``: with metal that moves for its newest effect; ``fitted``: all fits of the round;
    those with metal at rest for their newest effect are the rivals; ``others``: all effects but
    metal with their scores, best first, from a scorer; ``explained``: what the metal that moves
    takes off the held-out sum of squares.

    Returns a settled fit (`anser_ros.diagnosis.fit`).
    """
    resting = [(g, f) for g, f in fitted if f.newest.effect.family is Family.METAL_AT_REST]
    gain, rest = max(resting, key=lambda pair: pair[0], default=(0.0, moving))
    if gain < decisions.NO_RIVAL * explained:
        return settled(fitter, moving.terms)
    shaped, rest = in_order(lambda fit: settled(fitter, fit.terms), [moving, rest])
    limit = _limit(shaped, explained)
    if rest.held_out() < limit:
        return rest
    scorer = Scorer(rest.state, fitter.blocks)
    tried: set[str] = set()
    for term, score in others(scorer):
        if term.effect.name in tried:
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
            if both.held_out() < _limit(beside, explained):
                return rest
    return shaped


def _limit(moving: Fit, explained: float) -> float:
    """Held-out sum of squares up to which metal at rest explains as much."""
    more = decisions.ALIKE * explained + decisions.LEAST_MOTION_GAIN * max(moving.misfit, 1.0)
    return moving.held_out() + more


@dataclass(frozen=True)
class Confirmation:
    """Holds what speaks for an effect."""

    power: float  # what it takes off the sum of squares
    # What refits in parts of the data take off besides, as a share of that power and of what the
    # model states as its own error, which differs from one part to the next.
    variation: float
    share_of_rest: float  # its power over the power that stays unexplained
    # Share of its power that stays on the channels and emitters that it changes, beyond what stays
    # everywhere. Metal is exempt: its shape is never known.
    remainder: float = 0.0
    inexact: float = INEXACT  # largest remainder that the effect may leave
    alike: int = 1  # effects of the same name, or on the same single channel, whichever are more
    plausible: bool = True  # whether all parameters are in the effect's range
    # Whether it takes something off the tools' residuals, where it acts on tools.
    helps: bool = True

    @property
    def reason(self) -> str:
        """Return why it may not be named, in words; empty where it may."""
        if not self.plausible:
            return 'its parameters are outside their plausible range'
        if not self.helps:
            return 'only the references support it, and the tools contradict it'
        if self.variation >= decisions.LARGEST_VARIATION:
            return 'its parameters differ from one part of the data to the next'
        if self.remainder >= self.inexact:
            return 'too much stays unexplained where it acts'
        if self.alike >= decisions.MANY:
            return 'several effects of its kind together imitate a cause that they share'
        if self.share_of_rest <= decisions.LEAST_OF_THE_REST:
            return 'much more stays unexplained than it explains'
        return ''


def _checked(problem: Problem, fit: Fit, term: Term, noise: float) -> Confirmation:
    """Check one term of a fit; ``noise`` is the variance of the whitened noise."""
    rest = [t for t in fit.terms if t is not term and not t.belongs_to(term)]
    without = evaluate(problem, rest)
    power = without.sum_of_squares - fit.state.sum_of_squares
    left = max(fit.state.sum_of_squares - noise * fit.state.count, 0.0)
    left_tools = left if fit.misfit > decisions.SOMETHING_LEFT * noise else 0.0
    columns, own = fit.state.design(term), model_share(fit.state) * fit.state.count
    remainder = 0.0
    if np.isfinite(term.effect.inexact):
        remainder = _stays(fit.state, columns, noise, max(1.0, decisions.MODEL_ERROR * noise))
    return Confirmation(
        power, _varying(fit.state, columns, noise) / max(power + own, 1e-300),
        power / max(left_tools, 1e-300), remainder / max(power, 1e-300),
        inexact=term.effect.inexact, alike=_crowd(fit, term), plausible=_plausible(term),
        helps=_helps(without, fit.state, columns),
    )  # fmt: skip


def _helps(without: State, with_it: State, columns: Sequence[Array | None]) -> bool:
    gain, acts = 0.0, False
    for before, after, column in zip(without.parts, with_it.parts, columns, strict=True):
        if column is not None and not after.view.is_reference:
            acts = True
            gain += float(np.sum(before.white**2) - np.sum(after.white**2))
    return gain > 0.0 or not acts


def _crowd(fit: Fit, term: Term) -> int:
    """Effects of a fit with the same name, or about the same channel."""
    alike = 1 if term.effect.gregarious else sum(t.effect is term.effect for t in fit.effects)
    about = [sum(c in _singled(t) for t in fit.effects) for c in _singled(term)]
    return max([alike, *about])


def _singled(term: Term) -> set[int]:
    """Channels that a term is about, where they are one or two."""
    return set(term.channels) if len(term.channels) <= 2 else set()


def _plausible(term: Term) -> bool:
    """Whether a term's record has values in its effect's ranges."""
    return term.effect.possible(term.effect.record(term, np.zeros((term.theta.size,) * 2)))


def _stays(state: State, columns: Sequence[Array | None], noise: float, expected: float) -> float:
    """Power beyond the noise in the cells that a term changes, less what cells have in common.

    A cell is one channel's readings of one emitter; ``expected`` is the variance below which the
    residual of an effect on all cells is ignored.
    """
    own, rest, counts = [], [], []
    for part, column in zip(state.parts, columns, strict=True):
        if part.view.is_reference:
            continue
        sensors, emitters = part.view.flux.shape[1:]
        shape = (-1, 2, sensors, emitters)
        excess = part.white**2 - noise * (part.whitener.weight > 0)
        left = excess.reshape(shape).sum(axis=(0, 1))
        changed = np.zeros((sensors, emitters), dtype=bool)
        if column is not None:
            size = np.abs(column).sum(axis=2).reshape(shape).sum(axis=(0, 1))
            # The pose's marginalisation spreads a trace of every change over all channels.
            changed = size > decisions.CHANGED * size.max()
        good = (part.whitener.weight > 0).reshape(shape).sum(axis=(0, 1))
        own.append(left[changed])
        rest.append(left[~changed])
        counts.append(good[changed])
        spread = noise * np.sqrt(4.0 * part.white.shape[0])
    acted, others, values = (np.concatenate(found) for found in (own, rest, counts))
    if acted.size == 0:
        return 0.0
    if others.size < acted.size:
        # An effect on everything: what single channels keep is not its fault, nor is what the
        # field model may be wrong by, which is in the expected spread but not in the noise.
        model = max(expected - noise, 0.0) * float(np.median(values))
        stays = max(float(np.median(acted)) - model, 0.0) * acted.size
    else:
        stays = float(acted.sum() - np.median(others) * acted.size)
    return stays if stays > decisions.LEAST_POWER_SIGMAS * spread * np.sqrt(acted.size) else 0.0


def _checked_open(problem: Problem, fit: Fit, term: FluctuationTerm, noise: float) -> Confirmation:
    """Check a fluctuation: its likelihood speaks for it, unless much stays where it acts."""
    without = evaluate(problem, [t for t in fit.terms if t is not term])
    power = max(without.sum_of_squares - fit.state.sum_of_squares, 1e-300)
    columns = []
    for part in fit.state.parts:
        raw = term.effect.directions(term, part.view)
        columns.append(None if raw is None else parts(raw) * part.whitener.weight[..., None])
    stays = _stays(fit.state, columns, noise, noise) / power
    inexact, plausible = term.effect.inexact, all(map(_plausible, term.extremes))
    return Confirmation(power, 0.0, np.inf, stays, inexact, _crowd(fit, term), plausible)


def doubtful(problem: Problem, fit: Fit) -> list[tuple[Confirmation, Term]]:
    """Return a fit's effects that are not confirmed, the one with the least power first."""
    noise, white = known_variance(fit.state), noise_scale(fit.state) ** 2
    fitted = [term for term in fit.effects if term.theta.size]
    free = [one for term in fit.terms if (one := term.effect.opened(term)) is not None]
    checks = [(_checked(problem, fit, term, noise), term) for term in fitted]
    checks += [(_checked_open(problem, fit, term, white), term) for term in free]
    checks += _unsteady(problem, fit)
    bad = [(check, term) for check, term in checks if check.reason]
    return sorted(bad, key=lambda pair: pair[0].power)


def _unsteady(problem: Problem, fit: Fit) -> list[tuple[Confirmation, Term]]:
    """Steady effects of a coil or channel that fluctuates besides, by the share that does."""
    found = []
    for free in fit.terms:
        for term in fit.terms:
            if not free.effect.rivals(free, term):
                continue
            steady = [t for t in fit.terms if t is not free]
            alone = evaluate(problem, steady).sum_of_squares
            none = evaluate(problem, [t for t in steady if t is not term]).sum_of_squares
            power = max(none - alone, 1e-300)
            share = (alone - fit.state.sum_of_squares) / power
            found.append((Confirmation(power, 0.0, np.inf, share), term))
    return found


def _varying(state: State, columns: Sequence[Array | None], noise: float) -> float:
    """Power that refits in parts of the time, or emitter by emitter, or by sensor, take off."""
    used = [
        (part, column)
        for part, column in zip(state.parts, columns, strict=True)
        if column is not None and not part.view.is_reference
    ]
    if not used:
        return 0.0
    numbers = np.unique(np.concatenate([part.blocks for part in state.parts]))
    firsts = [group[0] for group in np.array_split(numbers, decisions.TIME_PARTS) if group.size]
    times = [np.searchsorted(firsts, part.blocks, side='right')[:, None] for part, _ in used]
    cells = [np.indices((2, *p.view.flux.shape[1:])).reshape(3, 1, -1) for p, _ in used]
    kinds = (times, [cell[1] for cell in cells], [cell[2] for cell in cells])
    return max(_refits(used, noise, labels) for labels in kinds)


def _refits(used: Sequence[tuple[Part, Array]], noise: float, labels: Sequence[Integers]) -> float:
    """Power beyond chance that a refit of the values of each label takes off."""
    total = 0.0
    for value in np.unique(np.concatenate([label.ravel() for label in labels])):
        normal, right = 0.0, 0.0
        for (part, column), label in zip(used, labels, strict=True):
            chosen = np.broadcast_to(label == value, part.white.shape)
            flat = column[chosen]
            normal = normal + flat.T @ flat
            right = right + flat.T @ part.white[chosen]
        if np.any(normal):
            total += max(_extra(np.asarray(normal), np.asarray(right), noise), 0.0)
    return total


def _extra(normal: Array, right: Array, noise: float) -> float:
    """Power beyond chance that a refit in one part takes off."""
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal / scale[:, None] / scale[None, :]
    inverse = np.linalg.pinv(scaled, rcond=1e-8, hermitian=True)
    b = right / scale
    return float(b @ inverse @ b - noise * right.size)
