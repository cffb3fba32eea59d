"""Searches which effects hold: added one by one while they pay on held-out blocks, then thinned.

Every candidate is first scored by its linear columns (a score test beside the active effects).
The best ones are fitted in full, and the best of these is taken, or a simpler one that is as good.
Effects that others have made superfluous are removed (`anser_ros.diagnosis.decisions`).
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain

import numpy as np

from anser_ros.arrays import Integers
from anser_ros.diagnosis import choice, decisions
from anser_ros.diagnosis.engine import ForwardSelection, Score, Scorer, is_covered
from anser_ros.diagnosis.fit import Fit, Fitter, settled
from anser_ros.diagnosis.problem import Problem, State
from anser_ros.diagnosis.screening import model_share
from anser_ros.effects.effect import Family, Term, all_effects
from anser_ros.parallel import in_order, sharing, slices

Progress = Callable[[str], None]

CANDIDATES_A_THREAD = 16
"""Candidates that one thread scores, some 100 ms of work."""


@dataclass(frozen=True)
class SearchSettings:
    """States how the search goes."""

    most_effects: int = 6  # a session with more than this many is not understood
    finalists: int = 7  # candidates fitted in full in a round, which a round's time goes into
    iterations: int = 8  # most steps of a fit; most settle in fewer


@dataclass(frozen=True)
class Candidate:
    """Holds a row of the candidates' table: gain by the score test, and by the finalists' fit."""

    term: Term
    parameters: int
    gain: float
    fitted_gain: float | None = None


@dataclass
class Search:
    """Holds what the search found and tried."""

    fit: Fit  # the effects that were kept, fitted on the problem that was searched
    rounds: list[list[Candidate]] = field(default_factory=list)  # all scores, a list per round
    removed: list[Term] = field(default_factory=list)  # effects that others explained away
    # By the label of an effect: candidates that explained as much as it did, and steady ones that
    # explained nearly as much when it was taken.
    rivals: dict[str, list[Candidate]] = field(default_factory=dict)
    close: dict[str, list[Term]] = field(default_factory=dict)
    passed: dict[str, Term] = field(default_factory=dict)  # the fluctuation that it went before
    metal_gain: float = 0.0  # what the strongest metal took off


def is_worthwhile(gain: float, parameters: int, fit: Fit) -> bool:
    """Return whether a gain is worth its parameters, by what this fit leaves."""
    metal = any(term.effect.family.is_metal for term in fit.terms)
    share = decisions.LEAST_GAIN_SHARE_BESIDE_METAL if metal else decisions.LEAST_GAIN_SHARE
    least = decisions.LEAST_GAIN + decisions.PER_PARAMETER * parameters + share * fit.state.count
    return gain > least * max(fit.misfit, 1.0)


def _may_be_the_model_s(gain: float, fit: Fit) -> bool:
    """Whether an effect explains no more than what the model may have of its own."""
    own = model_share(fit.state) * fit.state.count
    if fit.newest.effect.family is Family.METAL_AT_REST:
        return gain < decisions.OWN_METAL * max(fit.misfit, 1.0) * own
    return gain < decisions.OWN_SHARE * own


class FluxSelection(ForwardSelection[Fit]):
    """Selects the effects of a session of fluxes.

    ``beside`` returns the problem without what stands out beside some effects.
    """

    def __init__(
        self, beside: Callable[[Sequence[Term]], Problem], blocks: Integers, how: SearchSettings,
        start: Sequence[Term], progress: Progress | None,
    ) -> None:  # fmt: skip
        self._beside, self._how, self.most = beside, how, how.most_effects
        self._fitter = Fitter(beside(start), blocks, how.iterations)
        self.search = Search(self._fitter.fit(start))
        self._say = progress or (lambda text: None)
        self._most_metals = decisions.MOST_METALS

    def addition(self, fit: Fit) -> Fit | None:
        """Return the fit with one effect more, or None when none pays."""
        search, scorer = self.search, Scorer(fit.state, self._fitter.blocks)
        fitted = self._fitted(fit, scorer)
        if not fitted:
            return None
        gain, best = choice.choose(fitted)
        metal = _metal_beside(best, gain, fitted)
        if metal is not None:
            # A freedom in every frame is no match for metal before that has its shape.
            shaped = choice.moves_or_rests(self._fitter, metal[1], fitted, self._scored, metal[0])
            if scorer.held_out - shaped.held_out() > gain:
                search.metal_gain = max(search.metal_gain, metal[0])
                return shaped
        term = best.newest
        is_own = _may_be_the_model_s(gain, best)
        rivalled = term.effect.family.is_metal and fit.misfit > decisions.COMPLETE
        if not is_worthwhile(gain, term.complexity, best) or (is_own and not rivalled):
            return None
        if term.effect.family.is_metal:
            if gain < decisions.REMNANT * search.metal_gain:
                return None
            if term.effect.family is Family.MOVING_METAL:
                best = choice.moves_or_rests(self._fitter, best, fitted, self._scored, gain)
            if is_own or self._is_installed_anew(fit, best, gain):
                self._most_metals = 0
                return self._stood_anew(fit, gain) or self.addition(fit)
            search.metal_gain = max(search.metal_gain, gain)
        least = gain - decisions.AS_GOOD * max(best.misfit, 1.0) - decisions.ALIKE * abs(gain)
        alike = [(g, f.newest) for g, f in fitted if f is not best and g > least]
        search.rivals[term.label] = [Candidate(t, t.theta.size, g, g) for g, t in alike]
        first = max(fitted, key=lambda pair: pair[0])[1].newest
        free = [c.term for c in search.rounds[-1] if c.term.effect.family is Family.FLUCTUATION]
        for other in reversed([first, *free]):
            if other.effect.rivals(other, term):
                search.passed[term.label] = other
        if term.effect.family is Family.MOVING_METAL:
            return best
        near = [f for g, f in fitted if f is not best and g > decisions.STEADY * gain]
        steady = [f.newest for f in near if f.newest.effect.family is Family.STEADY]
        search.close[term.label] = steady
        if any(t.effect.family.is_metal for t in best.terms):
            return settled(self._fitter, best.terms)
        return best

    def taken(self, fit: Fit) -> Fit:
        """Return the fit with simpler effects, and fewer, where that is as good."""
        self._say(f'{fit.newest.label}: misfit {fit.misfit:.4g}')
        return self.thinned(self._simplified(self._sound(fit)))

    def _sound(self, fit: Fit) -> Fit:
        """The fit on what does not stand out beside its effects, which had hidden it before.

        One wrong pose would be taken for poses that all jitter.
        """
        problem = self._beside(fit.terms)
        if all(map(np.array_equal, problem.good, self._fitter.problem.good)):
            return fit
        self._fitter = replace(self._fitter, problem=problem)
        return self._fitter.fit(fit.terms)

    def is_lost(self, fit: Fit) -> bool:
        """Return whether so many effects are doubtful that something else is the cause."""
        if self._most_metals == 0:  # several parts were set up anew, and some are not named yet
            return False
        return len(choice.doubtful(self._fitter.problem, fit)) >= decisions.MOST_DOUBTFUL

    def superfluous(self, fit: Fit) -> Fit | None:
        """Return the fit without the first effect that the others explain away, but the newest."""
        for index, term in enumerate(fit.terms if len(fit.terms) > 1 else ()):
            fixed = term.effect.family in (Family.REMAINDER, Family.SEEN)
            if fixed or term is fit.newest:
                continue
            # Its parameters may show by themselves that it is needed.
            size = term.theta.size
            if size and is_worthwhile(_wald(fit, index) / decisions.CLEAR_GAIN, size, fit):
                continue
            without = settled(self._fitter, [t for t in fit.terms if t is not term])
            gain = without.held_out() - fit.held_out()
            if not is_worthwhile(gain, term.complexity, fit):
                self.search.removed.append(term)
                return without
        return None

    def _anew(self, before: Fit) -> list[Term]:
        """Return what may stand anew and is not fitted already."""
        apparatus = self._fitter.problem.apparatus
        effects = [effect for effect in all_effects().values() if effect.installed]
        every = [term for effect in effects for term in effect.candidates(apparatus)]
        return [term for term in every if not is_covered(term, before.terms)]

    def _is_installed_anew(self, before: Fit, metal: Fit, gain: float) -> bool:
        """Whether metal at rest stands in for parts of the system that were set up anew.

        Their places, strengths and frame, fitted together, then explain as much. What of them has
        changed is left to the search, and no metal is looked for any more.
        """
        if metal.newest.effect.family is not Family.METAL_AT_REST:
            return False
        anew = self._anew(before)
        alike = decisions.ALIKE * gain + decisions.AS_GOOD * max(metal.misfit, 1.0)
        most = min(metal.held_out() + alike, decisions.AS_LITTLE * metal.held_out())
        fit = self._fitter.fit([*before.terms, *anew])
        return fit.held_out() < most and fit.misfit < decisions.COMPLETE

    def _stood_anew(self, before: Fit, gain: float) -> Fit | None:
        """Frames and bodies that stand elsewhere, all together, where that explains most of it."""
        stands = [term for term in self._anew(before) if term.effect.is_stand]
        fit = self._fitter.fit([*before.terms, *stands])
        explained = before.held_out() - fit.held_out()
        return fit if stands and explained > decisions.STEADY * gain else None

    def _simplified(self, fit: Fit) -> Fit:
        """Take a simpler effect for an earlier one, which may have absorbed part of the newest."""
        search = self.search
        for term in fit.terms[:-1]:
            if term.effect.family is not Family.STEADY:
                continue
            for other in search.close.get(term.label, []):
                spared = term.complexity - other.complexity
                if spared < 0 or is_covered(other, fit.terms):
                    continue
                terms = [other if t.label == term.label else t for t in fit.terms]
                trial = settled(self._fitter, terms)
                loss = trial.held_out() - fit.held_out()
                if loss < decisions.as_good(spared) * max(trial.misfit, 1.0):
                    search.removed.append(term)
                    search.close[other.label] = search.close[term.label]
                    fit = trial
                    break
        return fit

    def _fitted(self, before: Fit, scorer: Scorer[State]) -> list[tuple[float, Fit]]:
        """Gain and fit of the finalists; all candidates go into the table of the round."""
        fitter = self._fitter
        scored = self._scored(scorer, self._most_metals)
        table = [Candidate(t, s.solution.size, scorer.held_out - s.held_out) for t, s in scored]
        fluctuations = _fluctuating(fitter.problem, before)
        table += [Candidate(t, t.complexity, g) for g, t in fluctuations]
        starts = _finalists(scored, scorer, self._how)
        starts += choice.moving_starts(fitter.problem, scored, scorer, fitter.blocks)
        fitted: list[tuple[float, Fit]] = []
        left = sorted(starts + fluctuations, key=lambda pair: -pair[0])
        while left:
            some, left = left[: sharing()], left[sharing() :]
            some = [pair for pair in some if not _is_surpassed(*pair, fitted)]
            fits = in_order(lambda pair: fitter.fit([*before.terms, pair[1]]), some)
            for (expected, term), fit in zip(some, fits, strict=True):
                if _is_surpassed(expected, term, fitted):  # by one that was fitted beside it
                    continue
                newest = fit.newest
                if any(newest.belongs_to(term) for term in before.terms):
                    continue
                if newest.theta.size and not newest.theta[newest.effect.amounts(newest)].any():
                    continue  # at its bound, where it is nothing
                gain = scorer.held_out - fit.held_out() - choice.taken_from_others(fit)
                fitted.append((gain, fit))
                table.append(Candidate(fit.newest, term.complexity, gain, gain))
        self.search.rounds.append(sorted(table, key=lambda c: -c.gain))
        return fitted

    def _scored(self, scorer: Scorer[State], most_metals: int = 0) -> list[tuple[Term, Score]]:
        """All candidates that are not active already, without metal if not so many, best first."""
        candidates = _candidates(self._fitter.problem, scorer.state.terms, most_metals)

        def scored(few: slice) -> list[tuple[Term, Score]]:
            least = decisions.DISTINGUISHABLE
            left = [
                term for term in candidates[few] if choice.left_over(scorer.state, term) >= least
            ]
            pairs = [(term, scorer.score(term)) for term in left]
            return [(term, score) for term, score in pairs if score is not None]

        parts = in_order(scored, slices(len(candidates), CANDIDATES_A_THREAD))
        return sorted(chain.from_iterable(parts), key=lambda pair: pair[1].held_out)


def _is_surpassed(expected: float, term: Term, fitted: Sequence[tuple[float, Fit]]) -> bool:
    """Whether fits gain far more than expected here, or a simpler one leaves but noise."""
    if fitted and expected < decisions.LEAST_PROBE_GAIN * max(gain for gain, _ in fitted):
        return True
    return any(
        choice.at_floor(fit) and term.complexity > fit.newest.complexity for _, fit in fitted
    )


def _candidates(problem: Problem, taken: Sequence[Term], most_metals: int) -> list[Term]:
    """Candidates beside some active effects, metal if fewer than so many of them are."""
    ours = problem.apparatus.tool_channels
    metals = sum(term.effect.family.is_metal for term in taken)
    moving = any(term.effect.family is Family.MOVING_METAL for term in taken)
    return [
        term
        for effect in all_effects().values()
        if not (effect.family.is_metal and (moving or metals >= most_metals))
        for term in effect.candidates(problem.apparatus)
        # Beside metal a reference's survey error looks like a fault of its channel.
        if not is_covered(term, taken) and (not metals or set(term.channels) <= set(ours))
    ]


def _metal_beside(
    best: Fit, gain: float, fitted: Sequence[tuple[float, Fit]]
) -> tuple[float, Fit] | None:
    """Moving metal that explains nearly as much as a fluctuation that leaves something."""
    if best.newest.effect.family is not Family.FLUCTUATION or choice.at_floor(best):
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
    effects = [e for e in all_effects().values() if e.family is Family.FLUCTUATION]
    terms = [term for effect in effects for term in effect.candidates(problem.apparatus)]
    found = [
        choice.fluctuation_of(before.state, t) for t in terms if not is_covered(t, before.terms)
    ]
    worth = [pair for pair in found if pair is not None and pair[0] > least]
    return sorted(worth, key=lambda pair: -pair[0])[: decisions.OPEN_FINALISTS]


def _finalists(
    scored: Sequence[tuple[Term, Score]], scorer: Scorer[State], how: SearchSettings
) -> list[tuple[float, Term]]:
    """Expected gain and start values of the best candidates, few of each effect."""
    out: list[tuple[float, Term]] = []
    sites: Counter[str] = Counter()
    for term, score in scored:
        gain = scorer.held_out - score.held_out
        if len(out) >= how.finalists or gain < decisions.LEAST_GAIN:
            break
        if sites[term.effect.name] < decisions.SITES_PER_EFFECT:
            sites[term.effect.name] += 1
            out += [(gain, start) for start in term.effect.started(term, score.solution)]
    return out


def _wald(fit: Fit, index: int) -> float:
    """What the sum of squares would grow by without a term, the others refitted; linear."""
    term, rows = fit.terms[index], fit.rows(index)
    covariance = fit.sums.solve(fit.prior)[1][rows, rows]
    use = np.flatnonzero(term.effect.prior(term) > 1e-9)
    # Only its amount tells whether an effect is there; the place of no amount is arbitrary.
    use = np.intersect1d(use, term.effect.amounts(term))
    theta, part = term.theta[use], covariance[np.ix_(use, use)]
    return float(theta @ np.linalg.pinv(part, rcond=1e-10, hermitian=True) @ theta)
