"""Searches which effects hold: added one by one while they pay on held-out blocks, then thinned
out.

Every candidate is first scored by its linear columns (a score test beside the effects in force).
The best ones are fitted in full, and the best of these is taken, or a simpler one that is as good.
Effects that others have made superfluous are removed at the end. The numbers by which this is
decided are in `anser_ros.diagnosis.decisions`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from anser_ros.diagnosis import decisions
from anser_ros.diagnosis.choice import at_floor, choose, taken_from_others
from anser_ros.diagnosis.confirm import doubtful
from anser_ros.diagnosis.fit import Fit, Fitter, misfit
from anser_ros.diagnosis.fluctuating import fluctuation_of, left_over
from anser_ros.diagnosis.moving_start import moving_starts
from anser_ros.diagnosis.problem import Problem
from anser_ros.diagnosis.refine import settled
from anser_ros.diagnosis.resting import moves_or_rests
from anser_ros.diagnosis.scoring import Score, Scorer
from anser_ros.diagnosis.structure import noise_scale
from anser_ros.effects.effect import Family
from anser_ros.effects.registry import all_effects
from anser_ros.effects.term import Term
from anser_ros.parallel import in_order, slices

Array = NDArray[np.float64]
Progress = Callable[[str], None]

CANDIDATES_A_THREAD = 16
"""Candidates that one thread scores, some 100 ms of work."""


@dataclass(frozen=True)
class SearchSettings:
    """States how the search goes.

    Attributes
    ----------
    most_effects : int
        Effects that are looked for; a session with more than this many is not understood.
    finalists : int
        Candidates that are fitted in full in a round, which is what a round's time goes into.
    iterations : int
        Most steps of a fit; most settle in fewer.
    """

    most_effects: int = 6
    finalists: int = 7
    iterations: int = 8

    def fitter(self, problem: Problem, blocks: NDArray[np.int64]) -> Fitter:
        """Return what fits effects on some blocks of a problem with these settings."""
        return Fitter(problem, blocks, self.iterations)


@dataclass(frozen=True)
class Candidate:
    """Holds a row of the candidates' table: gain by the score test, and by the finalists' fit."""

    term: Term
    parameters: int
    gain: float
    fitted_gain: float | None = None


@dataclass
class Search:
    """Holds what the search found and tried.

    Attributes
    ----------
    fit : Fit
        The effects that were kept, fitted on the problem that was searched.
    rounds : list of list of Candidate
        All candidates' scores, a list per round.
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
    blocks : ndarray of int
        Time blocks that take part.
    start : sequence of Term
        Effects that are known already (polarities, for example).
    settings : SearchSettings, optional
    progress : callable, optional
        Called with words on what has been found.
    """
    how = settings or SearchSettings()
    say = progress or (lambda text: None)
    fitter = how.fitter(problem, blocks)
    search = Search(fitter.fit(start))
    for _ in range(how.most_effects):
        found = _Round(fitter, search, how).best()
        if found is None:
            break
        search.fit = found
        say(f'{found.newest.label}: misfit {misfit(found):.4g}')
        _replace(fitter, search)
        _thin_out(fitter, search)
        noise = noise_scale(search.fit.state) ** 2
        if len(doubtful(problem, search.fit, noise)) >= decisions.MOST_DOUBTFUL:
            break
    return search


def is_worthwhile(gain: float, parameters: int, fit: Fit) -> bool:
    """Return whether a gain is worth its parameters, by what this fit leaves."""
    left = max(misfit(fit), 1.0)
    metal = any(term.effect.family.is_metal for term in fit.terms)
    share = decisions.LEAST_GAIN_SHARE_BESIDE_METAL if metal else decisions.LEAST_GAIN_SHARE
    least = decisions.LEAST_GAIN + decisions.PER_PARAMETER * parameters + share * fit.state.count
    return gain > least * left


def _may_be_the_model_s(gain: float, fit: Fit) -> bool:
    """Return whether metal at rest explains no more than what the model may have of its own."""
    if fit.newest.effect.family is not Family.METAL_AT_REST:
        return False
    own = fit.state.problem.spread.model_share * fit.state.count
    return gain < decisions.OWN_METAL * own * max(misfit(fit), 1.0)


class _Round:
    """One round of the search: the best effect to add to those in force."""

    def __init__(self, fitter: Fitter, search: Search, how: SearchSettings) -> None:
        self._fitter, self._search, self._how = fitter, search, how
        self._before = search.fit
        self._scorer = Scorer(self._before.state, fitter.blocks)

    def best(self) -> Fit | None:
        """Return the fit with one effect more, or None when none pays."""
        search, held_out = self._search, self._scorer.held_out
        fitted = self._fitted()
        if not fitted:
            return None
        gain, best = choose(fitted)
        metal = _metal_beside(best, gain, fitted)
        if metal is not None:
            # A freedom in every frame is no match for metal before that has its shape.
            shaped = self._moves_or_rests(metal[1], fitted, metal[0])
            if held_out - self._fitter.held_out(shaped) > gain:
                search.metal_gain = max(search.metal_gain, metal[0])
                return shaped
        term = best.newest
        if not is_worthwhile(gain, term.complexity, best):
            return None
        if term.effect.family.is_metal:
            if gain < decisions.REMNANT * search.metal_gain or _may_be_the_model_s(gain, best):
                return None
            search.metal_gain = max(search.metal_gain, gain)
        search.rivals[term.label] = _rivals(gain, best, fitted)
        if term.effect.family is Family.MOVING_METAL:
            return self._moves_or_rests(best, fitted, gain)
        search.close[term.label] = [
            f.newest
            for g, f in fitted
            if f is not best
            and g > decisions.STEADY * gain
            and f.newest.effect.family is Family.STEADY
        ]
        if any(t.effect.family.is_metal for t in best.terms):
            return settled(self._fitter, best.terms)
        return best

    def _fitted(self) -> list[tuple[float, Fit]]:
        """Gain and fit of the finalists; all candidates go into the table of the round."""
        fitter, scorer, before = self._fitter, self._scorer, self._before
        scored = _scored(fitter.problem, scorer)
        table = [Candidate(t, s.solution.size, scorer.held_out - s.held_out) for t, s in scored]
        fluctuations = _fluctuating(fitter.problem, before)
        table += [Candidate(t, t.complexity, g) for g, t in fluctuations]
        starts = _finalists(scored, scorer, self._how)
        starts += moving_starts(fitter.problem, scored, scorer, fitter.blocks)
        fitted: list[tuple[float, Fit]] = []
        for expected, term in sorted(starts + fluctuations, key=lambda pair: -pair[0]):
            if fitted and expected < decisions.LEAST_PROBE_GAIN * max(g for g, _ in fitted):
                continue
            if any(at_floor(f) and term.complexity > f.newest.complexity for _, f in fitted):
                continue
            fit = fitter.fit([*before.terms, term])
            gain = scorer.held_out - fitter.held_out(fit) - taken_from_others(fit)
            fitted.append((gain, fit))
            table.append(Candidate(fit.newest, term.complexity, gain, gain))
        self._search.rounds.append(sorted(table, key=lambda c: -c.gain))
        return fitted

    def _moves_or_rests(
        self, moving: Fit, fitted: Sequence[tuple[float, Fit]], explained: float
    ) -> Fit:
        def candidates(scorer: Scorer) -> list[tuple[Term, Score]]:
            return _scored(self._fitter.problem, scorer)

        return moves_or_rests(self._fitter, moving, fitted, candidates, explained)


def _rivals(gain: float, best: Fit, fitted: Sequence[tuple[float, Fit]]) -> list[Candidate]:
    """What explained as much as the effect that was taken."""
    least = gain - decisions.AS_GOOD * max(misfit(best), 1.0) - decisions.ALIKE * abs(gain)
    return [
        Candidate(f.newest, f.newest.theta.size, g, g)
        for g, f in fitted
        if f is not best and g > least
    ]


def _metal_beside(
    best: Fit, gain: float, fitted: Sequence[tuple[float, Fit]]
) -> tuple[float, Fit] | None:
    """Moving metal that explains nearly as much as a fluctuation that leaves something."""
    if best.newest.effect.family is not Family.FLUCTUATION or at_floor(best):
        return None
    metals = [
        (g, f)
        for g, f in fitted
        if f.newest.effect.family is Family.MOVING_METAL and g > decisions.LEAST_PROBE_GAIN * gain
    ]
    return max(metals, key=lambda pair: pair[0], default=None)


def _fluctuating(problem: Problem, before: Fit) -> list[tuple[float, Term]]:
    """The fluctuations that explain most of what is there to explain."""
    count = before.state.count
    excess = before.state.sum_of_squares - count
    least = max(
        decisions.LEAST_GAIN, decisions.LEAST_OF_EXCESS * excess, decisions.LEAST_OF_NOISE * count
    )
    found = []
    for effect in all_effects().values():
        if effect.family is not Family.FLUCTUATION:
            continue
        for term in effect.candidates(problem.apparatus):
            if any(_covered(term, other) for other in before.terms):
                continue
            likeliest = fluctuation_of(before.state, term)
            if likeliest is not None and likeliest[0] > least:
                found.append(likeliest)
    return sorted(found, key=lambda pair: -pair[0])[: decisions.OPEN_FINALISTS]


def _scored(problem: Problem, scorer: Scorer) -> list[tuple[Term, Score]]:
    """All candidates that are not in force already, best first."""
    taken, ours = scorer.state.terms, problem.apparatus.tool_channels
    metals = sum(term.effect.family.is_metal for term in taken)
    moving = any(term.effect.family is Family.MOVING_METAL for term in taken)
    candidates = []
    for effect in all_effects().values():
        if effect.family.is_metal and (moving or metals >= decisions.MOST_METALS):
            continue
        for term in effect.candidates(problem.apparatus):
            if any(_covered(term, other) for other in taken):
                continue
            if metals and not all(channel in ours for channel in term.channels):
                # Beside metal a reference's survey error looks like a fault of its channel.
                continue
            candidates.append(term)

    def score(few: slice) -> list[Score | None]:
        return [
            None
            if left_over(scorer.state, term) < decisions.DISTINGUISHABLE
            else scorer.score(term)
            for term in candidates[few]
        ]

    parts = in_order(score, slices(len(candidates), CANDIDATES_A_THREAD))
    pairs = zip(candidates, chain.from_iterable(parts), strict=True)
    scored = [(term, found) for term, found in pairs if found is not None]
    return sorted(scored, key=lambda pair: pair[1].held_out)


def _covered(candidate: Term, other: Term) -> bool:
    """Whether a term in force stands for a candidate already."""
    return other.effect.covers(other, candidate)


def _finalists(
    scored: Sequence[tuple[Term, Score]], scorer: Scorer, how: SearchSettings
) -> list[tuple[float, Term]]:
    """Expected gain and start values of the best candidates, few of each effect."""
    out: list[tuple[float, Term]] = []
    count: dict[str, int] = {}
    for term, score in scored:
        gain = scorer.held_out - score.held_out
        name = term.effect.name
        if len(out) >= how.finalists or gain < decisions.LEAST_GAIN:
            break
        if count.get(name, 0) >= decisions.SITES_PER_EFFECT:
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
    # Only its amount tells whether an effect is there; the place of no amount is arbitrary.
    use = np.intersect1d(use, term.effect.amounts(term))
    theta, part = term.theta[use], covariance[np.ix_(use, use)]
    return float(theta @ np.linalg.pinv(part, rcond=1e-10, hermitian=True) @ theta)


def _replace(fitter: Fitter, search: Search) -> None:
    """Take a simpler effect for an earlier one where, beside the newest, it is as good.

    An effect that was taken while much was unexplained may have been chosen because its parameters
    absorbed part of another effect.
    """
    for term in search.fit.terms[:-1]:
        if term.effect.family is not Family.STEADY:
            continue
        for other in search.close.get(term.label, []):
            spared = term.complexity - other.complexity
            if spared < 0 or any(_covered(other, t) for t in search.fit.terms):
                continue
            terms = [other if t.label == term.label else t for t in search.fit.terms]
            fit = settled(fitter, terms)
            loss = fitter.held_out(fit) - fitter.held_out(search.fit)
            if loss < decisions.as_good(spared) * max(misfit(fit), 1.0):
                search.removed.append(term)
                search.close[other.label] = search.close[term.label]
                search.fit = fit
                break


def _thin_out(fitter: Fitter, search: Search) -> None:
    """Remove effects that the others explain away."""
    while len(search.fit.terms) > 1:
        full = fitter.held_out(search.fit)
        for index, term in enumerate(search.fit.terms):
            fixed = term.effect.family in (Family.REMAINDER, Family.SEEN)
            if fixed or term is search.fit.newest or _is_plain(search.fit, index):
                continue
            rest = [t for t in search.fit.terms if t is not term]
            without = settled(fitter, rest)
            gain = fitter.held_out(without) - full
            if not is_worthwhile(gain, term.complexity, search.fit):
                search.removed.append(term)
                search.fit = without
                break
        else:
            return


def _is_plain(fit: Fit, index: int) -> bool:
    """Whether the parameters of a term show by themselves that it is needed."""
    size = fit.terms[index].theta.size
    return size > 0 and is_worthwhile(_wald(fit, index) / decisions.CLEAR_GAIN, size, fit)
