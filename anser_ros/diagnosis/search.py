"""Which effects hold: added one at a time while they pay on held-out blocks, then thinned out.

Every candidate is first scored by its linear columns (a score test beside the effects in force).
The best ones are fitted in full, and the best of these is taken, or a simpler one that is as good.
What others explain away is removed at the end.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from anser_ros.diagnosis.confirm import doubtful
from anser_ros.diagnosis.fit import Fit, fit_terms, misfit
from anser_ros.diagnosis.fluctuating import fluctuation_of, is_of, left_over
from anser_ros.diagnosis.moving_start import moving_starts
from anser_ros.diagnosis.problem import Problem
from anser_ros.diagnosis.refine import METALS, settled
from anser_ros.diagnosis.resting import moves_or_rests
from anser_ros.diagnosis.scoring import Score, Scorer
from anser_ros.diagnosis.structure import noise_scale
from anser_ros.effects.effect import Term
from anser_ros.effects.fluctuation import Fluctuation
from anser_ros.effects.metal_remainder import REMAINDER
from anser_ros.effects.registry import all_effects

Array = NDArray[np.float64]
Progress = Callable[[str], None]

PROMISING = 0.5
"""A candidate whose probe promises less than this share of the best fitted gain is not fitted."""
REMNANT = 0.01
"""Further metal with less than this share of the first metal's gain is what its model left."""
MOST_DOUBTFUL = 2
"""With so many effects in force that are not the same in all parts of the data, something else is
the cause, and further effects would only stand in for it."""
PLAIN_TO_SEE = 5.0
"""An effect whose parameters stand so many times above what it must gain is not tried without."""
MOST_METALS = 2
OPEN, OPEN_FINALISTS = 40, 3
"""Parameters that a fluctuation counts for: more than a constant effect, less than shaped metal;
and how many of them are tried in full."""
STEADY = 0.8
"""Share of a fluctuation's gain from which a constant, or a curve, of the same coil or channel is
tried first: freedom in every frame also takes off what is another effect's."""
OTHERS = 2.0
"""What a fluctuation takes off others, over what values alike would lose."""
LEAST_OF_EXCESS = 0.4
"""Share of what is left to explain that a fluctuation, or metal at another place in each block of
time, must explain."""
NOTHING_LEFT = 1.04
"""Misfit over the noise's up to which nothing but noise is left."""
TOLD_APART = 0.05
"""A candidate of whose power the fluctuations in force leave less can't be told from them."""
APART = 0.12
"""Distance (m) from metal in force within which further metal is the same body's."""


@dataclass(frozen=True)
class SearchSettings:
    """How the search goes.

    Attributes
    ----------
    folds : int
        Of the cross-validation over time blocks.
    most_effects : int
    finalists : int
        Candidates that are fitted in full a round.
    least_gain, gain_per_parameter : float
        What an effect must take off the held-out sum of squares, in units of the misfit that it
        leaves; a clean session's best of 700 candidates takes off about 15.
    iterations : int
    """

    folds: int = 4
    most_effects: int = 6
    finalists: int = 7
    least_gain: float = 40.0
    gain_per_parameter: float = 6.0
    least_share: float = 0.002
    least_share_beside_metal: float = 0.01
    iterations: int = 8


@dataclass(frozen=True)
class Candidate:
    """A row of the table of candidates: gain by the score test and, for finalists, by the fit."""

    term: Term
    parameters: int
    gain: float
    fitted_gain: float | None = None


@dataclass
class Search:
    """What the search found and tried.

    Attributes
    ----------
    fit : Fit
        The effects that were kept, fitted on the problem that was searched.
    rounds : list of list of Candidate
        All candidates' scores, a list a round.
    removed : list of Term
        Effects that others explained away.
    rivals : dict
        Label of an effect to the candidates that explained as much as it did.
    metal_gain : float
        What the strongest metal took off.
    """

    fit: Fit
    rounds: list[list[Candidate]] = field(default_factory=list)
    removed: list[Term] = field(default_factory=list)
    rivals: dict[str, list[Candidate]] = field(default_factory=dict)
    metal_gain: float = 0.0


def search_effects(
    problem: Problem,
    blocks: NDArray[np.int64],
    start: Sequence[Term] = (),
    settings: SearchSettings | None = None,
    progress: Progress | None = None,
) -> Search:
    """Find the effects that explain a problem.

    Parameters
    ----------
    problem : Problem
    blocks : ndarray
        Time blocks that take part.
    start : sequence of Term
        Effects that are known already (polarities, for example).
    settings : SearchSettings, optional
    progress : callable, optional
        Told in words what has been found.
    """
    how = settings or SearchSettings()
    say = progress or (lambda text: None)
    search = Search(fit_terms(problem, start, blocks, how.iterations))
    for _ in range(how.most_effects):
        found = _round(problem, blocks, search, how)
        if found is None:
            break
        search.fit = found
        newest = [t for t in found.terms if t.effect is not REMAINDER][-1]
        say(f'{newest.label}: misfit {misfit(found):.4g}')
        _thin_out(problem, blocks, search, how)
        noise = noise_scale(search.fit.state) ** 2
        if len(doubtful(problem, search.fit, noise)) >= MOST_DOUBTFUL:
            break
    return search


def complexity(term: Term) -> int:
    """Parameters that are paid for when explanations are compared."""
    return OPEN if isinstance(term.effect, Fluctuation) else int(term.theta.size)


def at_floor(fit: Fit) -> bool:
    """Whether a fit leaves nothing but noise."""
    return misfit(fit) < NOTHING_LEFT * max(noise_scale(fit.state) ** 2, 1.0)


def worth(gain: float, parameters: int, fit: Fit, how: SearchSettings) -> bool:
    """Whether a gain pays for its parameters, with this fit left."""
    left = max(misfit(fit), 1.0)
    metal = any(term.effect.name in METALS for term in fit.terms)
    share = how.least_share_beside_metal if metal else how.least_share
    least = how.least_gain + how.gain_per_parameter * parameters + share * fit.state.count
    return gain > least * left


def _round(
    problem: Problem, blocks: NDArray[np.int64], search: Search, how: SearchSettings
) -> Fit | None:
    """The fit with one effect more, or None when none pays."""
    before = search.fit
    scorer = Scorer(before.state, blocks, how.folds)
    scored = _scored(problem, scorer)
    table = [Candidate(t, s.solution.size, scorer.held_out - s.held_out) for t, s in scored]
    open_ones = _fluctuating(problem, before, how)
    table += [Candidate(t, complexity(t), g) for g, t in open_ones]
    starts = _finalists(scored, scorer, how) + moving_starts(problem, scored, scorer, blocks)
    fitted: list[tuple[float, Fit]] = []
    for expected, term in sorted(starts + open_ones, key=lambda pair: -pair[0]):
        if fitted and expected < PROMISING * max(g for g, _ in fitted):
            continue
        if any(at_floor(f) and complexity(term) > complexity(f.terms[-1]) for _, f in fitted):
            continue
        fit = fit_terms(problem, [*before.terms, term], blocks, how.iterations)
        gain = scorer.held_out - fit.held_out(how.folds) - _taken_from_others(fit)
        fitted.append((gain, fit))
        table.append(Candidate(fit.terms[-1], complexity(term), gain, gain))
    search.rounds.append(sorted(table, key=lambda c: -c.gain))
    if not fitted:
        return None
    gain, best = choose(fitted, how)
    term = best.terms[-1]
    if not worth(gain, complexity(term), best, how):
        return None
    if term.effect.name in METALS and gain < REMNANT * search.metal_gain:
        return None
    if term.effect.name in METALS:
        search.metal_gain = max(search.metal_gain, gain)
    search.rivals[term.label] = [
        Candidate(f.terms[-1], f.terms[-1].theta.size, g, g)
        for g, f in fitted
        if f is not best and g > gain - 10 * max(misfit(best), 1.0) - 0.02 * abs(gain)
    ]
    if term.effect.name == 'moving_metal':
        return moves_or_rests(
            problem, blocks, best, fitted, lambda s: _scored(problem, s), gain, how.folds,
            how.iterations,
        )  # fmt: skip
    if any(t.effect.name in METALS for t in best.terms):
        return settled(problem, best.terms, blocks, how.folds, how.iterations)
    return best


def _taken_from_others(fit: Fit) -> float:
    """What a new fluctuation's freedom takes off that is some other effect's, still unexplained.

    Along each of its columns a frame loses one value's share of whatever stays.
    """
    spread = fit.terms[-1].site.get('_spread')
    if spread is None:
        return 0.0
    frames = int(fit.terms[-1].site.get('_frames', 0))
    return OTHERS * frames * len(spread) * max(misfit(fit) - 1.0, 0.0)


def choose(fitted: Sequence[tuple[float, Fit]], how: SearchSettings) -> tuple[float, Fit]:
    """The best fit, or a simpler one that is as good within what its parameters could gain.

    Where several leave nothing but noise, the simplest is the explanation.
    """
    gain, best = max(fitted, key=lambda pair: pair[0])
    steady = [
        (g, f) for g, f in fitted if g > STEADY * gain and is_of(best.terms[-1], f.terms[-1])
    ]
    if steady:
        gain, best = max(steady, key=lambda pair: pair[0])
    most = complexity(best.terms[-1])
    simpler = [
        (g, f)
        for g, f in fitted
        if complexity(f.terms[-1]) < most
        and gain - g < (10 + 4 * (most - complexity(f.terms[-1]))) * max(misfit(best), 1.0)
    ]
    simpler += [
        (g, f)
        for g, f in fitted
        if isinstance(f.terms[-1].effect, Fluctuation)
        and complexity(f.terms[-1]) < most
        and at_floor(f)
    ]
    if not simpler:
        return gain, best
    return min(simpler, key=lambda pair: (complexity(pair[1].terms[-1]), -pair[0]))


def _fluctuating(problem: Problem, before: Fit, how: SearchSettings) -> list[tuple[float, Term]]:
    """The fluctuations that explain most of what is there to explain."""
    excess = before.state.sum_of_squares - before.state.count
    found = []
    for effect in all_effects().values():
        if not isinstance(effect, Fluctuation):
            continue
        for term in effect.candidates(problem.scene):
            if any(_same(term, other) for other in before.terms):
                continue
            likeliest = fluctuation_of(before.state, term)
            least = max(how.least_gain, LEAST_OF_EXCESS * excess)
            if likeliest is not None and likeliest[0] > least:
                found.append(likeliest)
    return sorted(found, key=lambda pair: -pair[0])[:OPEN_FINALISTS]


def _scored(problem: Problem, scorer: Scorer) -> list[tuple[Term, Score]]:
    """All candidates that are not in force already, best first."""
    taken, ours = scorer.state.terms, problem.scene.tool_channels
    metals = sum(term.effect.name in METALS for term in taken)
    metal, moving = metals > 0, any(term.effect.name == 'moving_metal' for term in taken)
    out = []
    for effect in all_effects().values():
        for term in effect.candidates(problem.scene):
            if any(_same(term, other) for other in taken):
                continue
            if metal and term.site.get('channel', ours[0]) not in ours:
                # Beside metal a reference's survey error looks like a fault of its channel.
                continue
            if effect.name in METALS and (moving or metals >= MOST_METALS):
                continue
            if left_over(scorer.state, term) < TOLD_APART:
                continue
            score = scorer.score(term)
            if score is not None:
                out.append((term, score))
    return sorted(out, key=lambda pair: pair[1].held_out)


def _same(term: Term, other: Term) -> bool:
    """Whether a candidate is what another term stands for already."""
    if isinstance(other.effect, Fluctuation) and term.effect.name == other.effect.of.name:
        return _site(term) == _site(other)
    if term.effect is not other.effect:
        return False
    if term.effect.name == 'static_metal':
        return bool(np.linalg.norm(term.theta[:3] - other.theta[:3]) < APART)
    if term.effect.name == 'conductive_plate':
        return True
    if term.effect.name == 'saturation':
        return bool(term.site['channel'] == other.site['channel'])
    return _site(term) == _site(other)


def _site(term: Term) -> str:
    return repr(sorted((k, v) for k, v in term.site.items() if k[0] != '_'))


def _finalists(
    scored: Sequence[tuple[Term, Score]], scorer: Scorer, how: SearchSettings
) -> list[tuple[float, Term]]:
    """Expected gain and start values of the best candidates, at most two of a name."""
    out: list[tuple[float, Term]] = []
    count: dict[str, int] = {}
    for term, score in scored:
        gain = scorer.held_out - score.held_out
        name = term.effect.name
        if len(out) >= how.finalists or gain < how.least_gain:
            break
        if count.get(name, 0) >= 2:
            continue
        count[name] = count.get(name, 0) + 1
        out += [(gain, start) for start in term.effect.started(term, score.solution)]
    return out


def _wald(fit: Fit, index: int) -> float:
    """What the sum of squares would grow by without a term, the others refitted; linear."""
    sizes = np.cumsum([0] + [t.theta.size for t in fit.terms])
    rows = slice(sizes[index], sizes[index + 1])
    term = fit.terms[index]
    covariance = fit.sums.solve(fit.prior)[1][rows, rows]
    use = np.flatnonzero(term.effect.prior(term) > 1e-9)
    # What tells how much of an effect there is; the place of nothing says nothing.
    use = np.intersect1d(use, term.effect.amounts(term))
    theta, part = term.theta[use], covariance[np.ix_(use, use)]
    return float(theta @ np.linalg.pinv(part, rcond=1e-10, hermitian=True) @ theta)


def _thin_out(
    problem: Problem, blocks: NDArray[np.int64], search: Search, how: SearchSettings
) -> None:
    """Remove effects that the others explain away."""
    while len(search.fit.terms) > 1:
        terms = search.fit.terms
        full = search.fit.held_out(how.folds)
        newest = [t for t in terms if t.effect is not REMAINDER][-1]
        for index, term in enumerate(terms):
            fixed = term.theta.size == 0 and not isinstance(term.effect, Fluctuation)
            if term is newest or term.effect is REMAINDER or fixed:
                continue
            if term.theta.size and worth(
                _wald(search.fit, index) / PLAIN_TO_SEE, term.theta.size, search.fit, how
            ):
                continue
            rest = [t for t in terms if t is not term]
            without = settled(problem, rest, blocks, how.folds, how.iterations)
            gain = without.held_out(how.folds) - full
            if not worth(gain, complexity(term), search.fit, how):
                search.removed.append(term)
                search.fit = without
                break
        else:
            return
