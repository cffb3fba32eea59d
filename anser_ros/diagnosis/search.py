"""Which effects hold: added one at a time while they pay on held-out blocks, then thinned out.

Every candidate is first scored by its linear columns (a score test beside the effects in force).
The best ones are fitted in full, and the best of these is taken, or a simpler one that is as good.
What others explain away is removed at the end.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from anser_ros.diagnosis.choice import (
    OPEN,
    STEADY,
    at_floor,
    choose,
    complexity,
    taken_from_others,
)
from anser_ros.diagnosis.confirm import doubtful
from anser_ros.diagnosis.fit import Fit, fit_terms, misfit
from anser_ros.diagnosis.fluctuating import fluctuation_of, left_over
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
OPEN_FINALISTS = 3
"""Fluctuations that are tried in full a round."""
LEAST_OF_EXCESS = 0.4
"""Share of what is left to explain that a fluctuation, or metal at another place in each block of
time, must explain."""
LEAST_OF_NOISE = 0.05
"""Share of the noise's power that a fluctuation must explain: a field model's own error is alike
in neighbouring frames and channels, and any freedom takes some of it."""
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
    close : dict
        Label of an effect to steady candidates that explained nearly as much when it was taken.
    metal_gain : float
        What the strongest metal took off.
    """

    fit: Fit
    rounds: list[list[Candidate]] = field(default_factory=list)
    removed: list[Term] = field(default_factory=list)
    rivals: dict[str, list[Candidate]] = field(default_factory=dict)
    close: dict[str, list[Term]] = field(default_factory=dict)
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
        _replace(problem, blocks, search, how)
        _thin_out(problem, blocks, search, how)
        noise = noise_scale(search.fit.state) ** 2
        if len(doubtful(problem, search.fit, noise)) >= MOST_DOUBTFUL:
            break
    return search


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
        gain = scorer.held_out - fit.held_out(how.folds) - taken_from_others(fit)
        fitted.append((gain, fit))
        table.append(Candidate(fit.terms[-1], complexity(term), gain, gain))
    search.rounds.append(sorted(table, key=lambda c: -c.gain))
    if not fitted:
        return None
    gain, best = choose(fitted)

    def shaped(start: Fit, explained: float) -> Fit:
        return moves_or_rests(
            problem, blocks, start, fitted, lambda s: _scored(problem, s), explained, how.folds,
            how.iterations,
        )  # fmt: skip

    metal = _metal_beside(best, gain, fitted)
    if metal is not None:
        # What bends with dozens of parameters is no match for metal before that has its shape.
        settled_metal = shaped(metal[1], metal[0])
        if scorer.held_out - settled_metal.held_out(how.folds) > gain:
            search.metal_gain = max(search.metal_gain, metal[0])
            return settled_metal
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
        return shaped(best, gain)
    search.close[term.label] = [
        f.terms[-1]
        for g, f in fitted
        if f is not best and g > STEADY * gain and _steady(f.terms[-1])
    ]
    if any(t.effect.name in METALS for t in best.terms):
        return settled(problem, best.terms, blocks, how.folds, how.iterations)
    return best


def _metal_beside(
    best: Fit, gain: float, fitted: Sequence[tuple[float, Fit]]
) -> tuple[float, Fit] | None:
    """Moving metal that explains nearly as much as a curve with many parameters."""
    newest = best.terms[-1]
    if newest.effect.name in METALS or complexity(newest) < OPEN or at_floor(best):
        return None
    metals = [
        (g, f)
        for g, f in fitted
        if f.terms[-1].effect.name == 'moving_metal' and g > PROMISING * gain
    ]
    return max(metals, key=lambda pair: pair[0], default=None)


def _fluctuating(problem: Problem, before: Fit, how: SearchSettings) -> list[tuple[float, Term]]:
    """The fluctuations that explain most of what is there to explain."""
    excess = before.state.sum_of_squares - before.state.count
    least = max(how.least_gain, LEAST_OF_EXCESS * excess, LEAST_OF_NOISE * before.state.count)
    found = []
    for effect in all_effects().values():
        if not isinstance(effect, Fluctuation):
            continue
        for term in effect.candidates(problem.apparatus):
            if any(_same(term, other) for other in before.terms):
                continue
            likeliest = fluctuation_of(before.state, term)
            if likeliest is not None and likeliest[0] > least:
                found.append(likeliest)
    return sorted(found, key=lambda pair: -pair[0])[:OPEN_FINALISTS]


def _scored(problem: Problem, scorer: Scorer) -> list[tuple[Term, Score]]:
    """All candidates that are not in force already, best first."""
    taken, ours = scorer.state.terms, problem.apparatus.tool_channels
    metals = sum(term.effect.name in METALS for term in taken)
    metal, moving = metals > 0, any(term.effect.name == 'moving_metal' for term in taken)
    out = []
    for effect in all_effects().values():
        for term in effect.candidates(problem.apparatus):
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


def _steady(term: Term) -> bool:
    return term.effect.name not in METALS and not isinstance(term.effect, Fluctuation)


def _replace(
    problem: Problem, blocks: NDArray[np.int64], search: Search, how: SearchSettings
) -> None:
    """Take a simpler effect for an earlier one where, beside the newest, it is as good.

    What was taken while much was unexplained may have won by parameters that took up another's.
    """
    for term in search.fit.terms[:-1]:
        if not _steady(term):
            continue
        for other in search.close.get(term.label, []):
            spared = complexity(term) - complexity(other)
            if spared < 0 or any(_same(other, t) for t in search.fit.terms):
                continue
            terms = [other if t.label == term.label else t for t in search.fit.terms]
            fit = settled(problem, terms, blocks, how.folds, how.iterations)
            loss = fit.held_out(how.folds) - search.fit.held_out(how.folds)
            if loss < (10 * (spared > 0) + 4 * spared) * max(misfit(fit), 1.0):
                search.removed.append(term)
                search.close[other.label] = search.close[term.label]
                search.fit = fit
                break


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
