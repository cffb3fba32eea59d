"""Searches which effects a session of poses shows: each must improve held-out blocks.

The currencies and prices are those of `anser_ros.diagnosis.decisions`: gains in the whitened sum
of squares, cross-validated over blocks of time, and for effects that depend on place also over
blocks of space, because a map looks too good on neighbours in time.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from anser_ros.diagnosis.decisions import AS_GOOD_PER_PARAMETER, LEAST_GAIN
from anser_ros.diagnosis.engine import ForwardSelection, Scorer, is_covered
from anser_ros.errors import DiagnosisError
from anser_ros.poses.effect import PoseTerm, Role
from anser_ros.poses.fit import (
    LARGEST_STAMP_S,
    PoseFit,
    fit_poses,
    noise_of,
    unexplained_poses,
)
from anser_ros.poses.lag_search import finest_lag, with_lag
from anser_ros.poses.lever_arms import knows_levers, most_poses
from anser_ros.poses.one_scale import is_one_scale
from anser_ros.poses.prices import LEAST_EXPLAINED, doubt, gain_of, price
from anser_ros.poses.problem import PoseNoise, PosePart, PoseState
from anser_ros.poses.registry import pose_effects
from anser_ros.poses.sequence import PoseSession
from anser_ros.poses.start import FEWEST_HAND_EYE_POSES

Array = NDArray[np.float64]

POSES_A_PARAMETER = 6
"""Poses that a parameter needs: neighbours in time are hardly new. More leave metal unnamed on a
hundred poses that a slow tracker gives in a minute; blocks judge what fewer would do."""
FULL_FITS = 3  # candidates fitted in full in each round, which takes most of the time
NOISE_ROUNDS = 3  # times that noise and what stands out, which depend on each other, are found
STAMP_GAIN = 25.0
"""Minus twice the log likelihood that an error of the stamps must take off, a sensor, to be
believed; chance takes off one."""
PART_OF_MAP = 2 / 3
"""Share of what a map gains below which a scale is a part of it: a map contains the scale, and
gains as much where there is nothing else."""


class PoseEvidence(NamedTuple):
    """States what speaks for an active term, of the poses that were fitted."""

    gain: float  # what it takes off the cross-validated sum of squares, in units of the misfit
    share: float  # the same over the sum of squares without it
    position_rmse_without_m: float
    position_rmse_with_m: float


@dataclass(frozen=True)
class PoseSearch:
    """Holds what a search came to."""

    fit: PoseFit  # the two frames and all active effects
    evidence: tuple[PoseEvidence | None, ...]  # one a term, None for the frames
    refused: tuple[tuple[str, str], ...]  # candidates that promised something, and why not named
    knows_levers: bool  # whether the motion determines any lever arm


def with_noise(fit: PoseFit, with_stamps: bool = True) -> PoseFit:
    """Return the fit with the noise that it shows, and without poses that stand out from that.

    Errors of the stamps are part of the noise where they are believed, if ``with_stamps``.
    """
    problem, state = fit.state.problem, fit.state
    for _ in range(NOISE_ROUNDS):
        cut = replace(problem, weight=_weights(state))
        parts = cut.state(fit.terms).parts
        noise = tuple((likely_noise(p) if with_stamps else noise_of(p, False))[0] for p in parts)
        every = tuple(np.ones(weight.size) for weight in cut.weight)
        problem = replace(problem, weight=every, noise=noise)
        state = problem.state(fit.terms)
    return fit_poses(replace(problem, weight=_weights(state)), fit.terms)


def _weights(state: PoseState) -> tuple[Array, ...]:
    """Weights of the poses of a state, none of those that stand out."""
    return tuple(np.where(mask, 0.0, 1.0) for mask in unexplained_poses(state))


def likely_noise(part: PosePart) -> tuple[PoseNoise, float]:
    """Return a sensor's noise, with a stamps' error if that is believed, and what that gains."""
    plain, without = noise_of(part, with_stamps=False)
    full, cost = noise_of(part, with_stamps=True)
    gain = without - cost
    believed = gain > STAMP_GAIN and full.stamp_s < LARGEST_STAMP_S
    return (full, gain) if believed else (plain, 0.0)


def search_effects(
    start: PoseFit, session: PoseSession, say: Callable[[str], None] | None = None
) -> PoseSearch:
    """Add effects one by one, the best first, while each pays for itself; drop what does not.

    Where the motion determines no lever arm, turns that go with the place or the velocity, times a
    lever arm of any length, look like any of them. Only the clocks are tried there.

    Raises `DiagnosisError` when too few poses agree with the reference.
    """
    fit = with_noise(start)
    agreeing = fit.state.count // 6
    if agreeing < FEWEST_HAND_EYE_POSES:
        raise DiagnosisError(
            f'{session.path}: {agreeing} poses agree with the reference; hand-eye needs '
            f'{FEWEST_HAND_EYE_POSES}'
        )
    is_known = knows_levers(fit, most_poses(session))
    if not is_known:
        fit = with_noise(start, False)
    how = _PoseSelection(is_known, say or (lambda text: None))
    fit = how.thinned(_one_map(how.grown(fit)))
    return PoseSearch(fit, tuple(how.evidence), tuple(how.refused), is_known)


def frame_terms(terms: Sequence[PoseTerm]) -> list[PoseTerm]:
    """Return the terms of the two unknown frames, without the effects."""
    return [term for term in terms if term.role.is_frame]


class _PoseSelection(ForwardSelection[PoseFit]):
    """Selects the effects of a session of poses."""

    def __init__(self, knows_levers: bool, say: Callable[[str], None]) -> None:
        self._knows_levers, self._say = knows_levers, say
        self.refused: list[tuple[str, str]] = []
        self.evidence: list[PoseEvidence | None] = []

    def addition(self, fit: PoseFit) -> PoseFit | None:
        """Return the fit with the candidate that is worth most, or None; a lag comes last."""
        self._say(f'search besides {len(fit.terms) - len(frame_terms(fit.terms))} effects')
        accepted: list[tuple[float, PoseFit]] = []
        for term in _finalists(fit, self._knows_levers):
            found = self._accepted(fit, term)
            if found is not None:
                accepted.append(found)
        best = _simplest(accepted) if accepted else None
        if not self._knows_levers or (best is not None and best.terms[-1].role.is_clock):
            return best
        # A filter rounds off turning points, which looks like a scale or a map.
        lagging, filtered = with_lag(fit, self.refused)
        if best is not None and filtered is not None and filtered.held_out() < best.held_out():
            term = best.terms[-1]
            both = fit_poses(fit.state.problem, [*filtered.terms, term])
            if gain_of(filtered, both, term) > price(term, filtered.held_out(), filtered):
                return best
            self.refused.append((term.label, 'a filter explains as much'))
            return lagging
        return best or lagging

    def taken(self, fit: PoseFit) -> PoseFit:
        """Return a fit with the noise that it shows."""
        return with_noise(fit, self._knows_levers)

    def superfluous(self, fit: PoseFit) -> PoseFit | None:
        """Return the fit without the effect that is worth least for its parameters beside the
        others, or None where all are worth theirs; the evidence for them is kept.
        """
        self.evidence = []
        weakest: tuple[float, PoseTerm, PoseFit] | None = None
        for index, term in enumerate(fit.terms):
            if term.role.is_frame:
                self.evidence.append(None)
                continue
            rest = [t for t in fit.terms if t is not term]
            without = fit_poses(fit.state.problem, rest)
            if any(t.role is Role.FILTER for t in rest):
                without = finest_lag(without)
            gain, left = gain_of(without, fit, term), without.held_out()
            share = gain / price(term, left, without)
            # Beside others the parameters may have become what no instrument has.
            share = min(share, 0.0) if doubt(fit, index) else share
            if share < 1 and (weakest is None or share < weakest[0]):
                weakest = share, term, without
            distances = without.state.rms()[0], fit.state.rms()[0]
            self.evidence.append(PoseEvidence(gain, gain * fit.misfit / left, *distances))
        if weakest is None:
            return None
        share, term, without = weakest
        self.refused.append((term.label, f'{share:.2f} of the gain that it must have'))
        return with_noise(without, self._knows_levers)

    def _accepted(self, fit: PoseFit, term: PoseTerm) -> tuple[float, PoseFit] | None:
        """What a candidate gains when fitted in full, and that fit, if it pays for itself."""
        rest = [t for t in fit.terms if not term.effect.covers(term, t)]
        trial = fit_poses(fit.state.problem, [*rest, term])
        gain = gain_of(fit, trial, term)
        need = price(term, fit.held_out(), fit)
        why_not = f'gain {gain:.0f} of {need:.0f}' if gain < need else ''
        why_not = why_not or doubt(trial, len(trial.terms) - 1)
        if not why_not and term.role is Role.SCALE and not is_one_scale(trial):
            why_not = 'sensors of one reference see different scales'
        if why_not:
            self.refused.append((term.label, why_not))
            return None
        return gain - AS_GOOD_PER_PARAMETER * term.complexity, trial


def _finalists(fit: PoseFit, knows_levers: bool) -> list[PoseTerm]:
    """Candidates that promise most, linear about the fit: of each effect the best, and of all."""
    state = fit.state
    scorers = [Scorer(s, s.numbers) for s in (state, state.in_space)]
    promising: list[tuple[float, PoseTerm]] = []
    for effect in pose_effects().values():
        for term in _beside_scale(effect.sites(state.problem.setting), fit.terms):
            if term.role is Role.FILTER or is_covered(term, fit.terms):
                continue
            if not knows_levers and (not term.role.is_clock or term.sensor):
                continue
            if 6 * POSES_A_PARAMETER * term.theta.size > state.count:
                continue
            gain = min(
                _promise(scorer, term) / fit.misfit
                for scorer in scorers[: 1 + effect.blocks_in_space]
            )
            if gain > LEAST_GAIN:
                promising.append((gain - AS_GOOD_PER_PARAMETER * term.complexity, term))
    promising.sort(key=lambda pair: -pair[0])
    # Many shapes of one effect must not crowd out the others.
    kinds = {(t.effect.name, t.effect.is_scale(t)): t for _, t in reversed(promising)}
    chosen = list(kinds.values())
    return [*chosen, *(t for _, t in promising[:FULL_FITS] if t not in chosen)]


def _promise(scorer: Scorer[PoseState], term: PoseTerm) -> float:
    """What a term takes off the cross-validated sum of squares, linear about the state."""
    score = scorer.score(term, term.effect.prior(term))
    return 0.0 if score is None else scorer.held_out - score.held_out


def _beside_scale(sites: Sequence[PoseTerm], active: Sequence[PoseTerm]) -> list[PoseTerm]:
    """What is left of some terms beside an active scale."""
    if not any(term.role is Role.SCALE for term in active):
        return list(sites)
    return [left for t in sites if (left := t.effect.beside_scale(t)) is not None]


def _simplest(accepted: list[tuple[float, PoseFit]]) -> PoseFit:
    """The one that gains most; a map only when no effect with few numbers is left.

    A scale that gains much less than a map is a part of that, unless several sensors vouch for it,
    which see the same one (`is_one_scale`) at different places.
    """
    ends = [(gain, fit.terms[-1]) for gain, fit in accepted]
    maps = [gain for gain, t in ends if t.role is Role.MAP]
    is_alone = len(accepted[0][1].state.parts) == 1
    least = PART_OF_MAP * max(maps, default=0.0) if is_alone else 0.0
    plain = [
        pair
        for pair, (gain, term) in zip(accepted, ends, strict=True)
        if term.role is not Role.MAP and (gain >= least or term.role is not Role.SCALE)
    ]
    return max(plain or accepted, key=lambda pair: pair[0])[1]


def _one_map(fit: PoseFit) -> PoseFit:
    """A whole map instead of a scale and what is bent besides, where it explains as much."""
    pairs = [(t, whole) for t in fit.terms if (whole := t.effect.whole(t)) is not None]
    bent = [t for t, _ in pairs]
    rest = [t for t in fit.terms if t not in bent and t.role is not Role.SCALE]
    if not bent or len(rest) + len(bent) == len(fit.terms):
        return fit
    problem = fit.state.problem
    trial = fit_poses(problem, [*rest, pairs[0][1]])
    return trial if trial.held_out(True) < (1 + LEAST_EXPLAINED) * fit.held_out(True) else fit
