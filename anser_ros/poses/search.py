"""Searches which effects a session of poses shows: each must improve held-out blocks.

The currencies and prices are those of `anser_ros.diagnosis.decisions`: gains in the whitened sum
of squares, cross-validated over blocks of time, and for effects that depend on place also over
blocks of space, because a map looks too good on neighbours in time.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.blocks import FOLDS
from anser_ros.diagnosis.decisions import AS_GOOD_PER_PARAMETER, LEAST_GAIN
from anser_ros.effects.term import Term
from anser_ros.errors import DiagnosisError
from anser_ros.poses.effect import Role, effect_of, is_of
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
from anser_ros.poses.problem import PoseNoise, PosePart
from anser_ros.poses.registry import pose_effects
from anser_ros.poses.sequence import PoseSession
from anser_ros.poses.start import FEWEST_HAND_EYE_POSES

Array = NDArray[np.float64]

POSES_A_PARAMETER = 6
"""Poses that a parameter needs: neighbours in time are hardly new. More leave metal unnamed on a
hundred poses that a slow tracker gives in a minute; blocks judge what fewer would do."""
MOST_EFFECTS = 6  # effects in force after which the search ends: more would be stand-ins
FULL_FITS = 3  # candidates fitted in full in each round, which takes most of the time
NOISE_ROUNDS = 3  # times that noise and what stands out, which depend on each other, are found
STAMP_GAIN = 25.0
"""Minus twice the log likelihood that an error of the stamps must take off, a sensor, to be
believed; chance takes off one."""
PART_OF_MAP = 2 / 3
"""Share of what a map gains below which a scale is a part of it: a map contains the scale, and so
gains as much where there is nothing else. Smaller calls a bent space a scale; larger takes the
noise that a map follows for a bend."""


@dataclass(frozen=True)
class PoseEvidence:
    """Holds what speaks for a term that is in force.

    Attributes
    ----------
    gain : float
        What it takes off the cross-validated sum of squares, in units of the misfit.
    share : float
        The same over the sum of squares without it.
    position_rmse_without_m, position_rmse_with_m : float
        Of the poses that were fitted.
    """

    gain: float
    share: float
    position_rmse_without_m: float
    position_rmse_with_m: float


@dataclass(frozen=True)
class PoseSearch:
    """Holds what a search came to.

    Attributes
    ----------
    fit : PoseFit
        The two frames and all effects in force.
    evidence : tuple of PoseEvidence or None, one per term
        None for the frames.
    refused : tuple of (str, str)
        Candidates that promised something, and why they are not named.
    knows_levers : bool
        Whether the motion determines any lever arm.
    """

    fit: PoseFit
    evidence: tuple[PoseEvidence | None, ...]
    refused: tuple[tuple[str, str], ...]
    knows_levers: bool


def with_noise(fit: PoseFit, with_stamps: bool = True) -> PoseFit:
    """Return the fit with the noise that it shows, and without poses that stand out from that.

    Errors of the stamps are part of the noise where they are believed, if ``with_stamps``.
    """
    problem = fit.state.problem
    for _ in range(NOISE_ROUNDS):
        out = unexplained_poses(fit)
        weight = tuple(np.where(mask, 0.0, 1.0) for mask in out)
        cut = replace(problem, weight=weight)
        parts = cut.state(fit.terms).parts
        noise = tuple((likely_noise(p) if with_stamps else noise_of(p, False))[0] for p in parts)
        every = tuple(np.ones(mask.size) for mask in out)
        judged = replace(problem, weight=every, noise=noise)
        state = judged.state(fit.terms)
        fit = replace(fit, state=state)
    out = unexplained_poses(fit)
    weight = tuple(np.where(mask, 0.0, 1.0) for mask in out)
    return fit_poses(replace(fit.state.problem, weight=weight), fit.terms)


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

    Raises
    ------
    DiagnosisError
        When too few poses agree with the reference.
    """
    tell = say or (lambda text: None)
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
    refused: list[tuple[str, str]] = []
    for _ in range(MOST_EFFECTS):
        tell(f'search besides {len(effects_of(fit))} effects')
        better = _best_addition(fit, refused, is_known)
        if better is None:
            break
        fit = with_noise(better, is_known)
    fit, evidence, dropped = _settled(_one_map(fit), is_known)
    return PoseSearch(fit, evidence, (*refused, *dropped), is_known)


def frame_terms(terms: Sequence[Term]) -> list[Term]:
    """Return the terms of the two unknown frames, without the effects."""
    return [term for term in terms if effect_of(term).role.is_frame]


def effects_of(fit: PoseFit) -> list[Term]:
    """Return the terms that are effects, without the two frames."""
    return [term for term in fit.terms if not effect_of(term).role.is_frame]


def _best_addition(
    fit: PoseFit, refused: list[tuple[str, str]], knows_levers: bool
) -> PoseFit | None:
    """The fit with the candidate that is worth most, or None; a lag is looked for at the end."""
    setting = fit.state.problem.setting
    promising: list[tuple[float, Term]] = []
    for effect in pose_effects().values():
        for term in _beside_scale(effect.sites(setting), fit.terms):
            if is_of(term, Role.FILTER) or _is_covered(term, fit.terms):
                continue
            if not knows_levers and (not effect.role.is_clock or effect.sensor_of(term)):
                continue
            if 6 * POSES_A_PARAMETER * term.theta.size > fit.state.count:
                continue
            gain = _probe(fit, term)
            if gain > LEAST_GAIN:
                promising.append((gain - AS_GOOD_PER_PARAMETER * term.complexity, term))
    promising.sort(key=lambda pair: -pair[0])
    # Of each effect the best is tried, so that many shapes of one do not crowd out the others.
    kinds = {(t.effect.name, effect_of(t).is_scale(t)): t for _, t in reversed(promising)}
    chosen = list(kinds.values())
    accepted: list[tuple[float, PoseFit]] = []
    for term in [*chosen, *(t for _, t in promising[:FULL_FITS] if t not in chosen)]:
        found = _accepted(fit, term, refused)
        if found is not None:
            accepted.append(found)
    best = _simplest(accepted) if accepted else None
    if best is not None and effect_of(best.terms[-1]).role.is_clock:
        return best
    if not knows_levers:
        return best
    # A filter rounds off turning points, which looks like a scale or a map.
    lagging, filtered = with_lag(fit, refused)
    if best is not None and filtered is not None and filtered.held_out() < best.held_out():
        term = best.terms[-1]
        both = fit_poses(fit.state.problem, [*filtered.terms, term])
        if gain_of(filtered, both, term) > price(term, filtered.held_out(), filtered):
            return best
        refused.append((best.terms[-1].label, 'a filter explains as much'))
        return lagging
    return best or lagging


def _beside_scale(sites: Sequence[Term], force: Sequence[Term]) -> list[Term]:
    """What is left of some terms beside a scale in force."""
    if not any(is_of(term, Role.SCALE) for term in force):
        return list(sites)
    return [left for t in sites if (left := effect_of(t).beside_scale(t)) is not None]


def _simplest(accepted: list[tuple[float, PoseFit]]) -> PoseFit:
    """The one that gains most; a map only when no effect with few numbers is left.

    A scale that gains much less than a map is a part of that, unless several sensors vouch for it,
    which see the same one (`is_one_scale`) at different places.
    """
    ends = [(gain, fit.terms[-1]) for gain, fit in accepted]
    maps = [gain for gain, t in ends if is_of(t, Role.MAP)]
    is_alone = len(accepted[0][1].state.parts) == 1
    least = PART_OF_MAP * max(maps, default=0.0) if is_alone else 0.0
    plain = [
        pair
        for pair, (gain, term) in zip(accepted, ends, strict=True)
        if not is_of(term, Role.MAP) and (gain >= least or not is_of(term, Role.SCALE))
    ]
    return max(plain or accepted, key=lambda pair: pair[0])[1]


def _accepted(
    fit: PoseFit, term: Term, refused: list[tuple[str, str]]
) -> tuple[float, PoseFit] | None:
    """What a candidate gains when fitted in full, and that fit, if it pays for itself."""
    rest = [t for t in fit.terms if not term.effect.covers(term, t)]
    trial = fit_poses(fit.state.problem, [*rest, term])
    gain = gain_of(fit, trial, term)
    need = price(term, fit.held_out(), fit)
    if gain < need:
        refused.append((term.label, f'gain {gain:.0f} of {need:.0f}'))
        return None
    why_not = doubt(trial, len(trial.terms) - 1)
    if why_not:
        refused.append((term.label, why_not))
        return None
    if is_of(term, Role.SCALE) and not is_one_scale(trial):
        refused.append((term.label, 'sensors of one reference see different scales'))
        return None
    return gain - AS_GOOD_PER_PARAMETER * term.complexity, trial


def _probe(fit: PoseFit, term: Term) -> float:
    """Gain that a term promises, linear about the fit."""
    effect = effect_of(term)
    prior = np.concatenate([fit.prior, effect.prior(term)])
    state = fit.state.problem.state([*fit.terms, term])
    gains = []
    for in_space in (False, True) if effect.blocks_in_space else (False,):
        left = state.sums(in_space=in_space).held_out(prior, FOLDS)
        gains.append((fit.held_out(in_space) - left) / fit.misfit)
    return min(gains)


def _is_covered(term: Term, force: Sequence[Term]) -> bool:
    """Whether a term in force stands for a candidate already."""
    return any(one.effect.covers(one, term) for one in force)


def _one_map(fit: PoseFit) -> PoseFit:
    """A whole map instead of a scale and what is bent besides, where it explains as much."""
    pairs = [(t, whole) for t in fit.terms if (whole := effect_of(t).whole(t)) is not None]
    bent = [t for t, _ in pairs]
    rest = [t for t in fit.terms if t not in bent and not is_of(t, Role.SCALE)]
    if not bent or len(rest) + len(bent) == len(fit.terms):
        return fit
    problem = fit.state.problem
    trial = fit_poses(problem, [*rest, pairs[0][1]])
    return trial if trial.held_out(True) < (1 + LEAST_EXPLAINED) * fit.held_out(True) else fit


def _settled(
    fit: PoseFit, with_stamps: bool
) -> tuple[PoseFit, tuple[PoseEvidence | None, ...], list[tuple[str, str]]]:
    """Drop effects that are no longer worth their parameters, given the others; evidence for those
    that stay."""
    dropped: list[tuple[str, str]] = []
    while True:
        evidence: list[PoseEvidence | None] = []
        weakest: tuple[float, Term, PoseFit] | None = None
        for index, term in enumerate(fit.terms):
            if effect_of(term).role.is_frame:
                evidence.append(None)
                continue
            rest = [t for t in fit.terms if t is not term]
            without = fit_poses(fit.state.problem, rest)
            if any(is_of(t, Role.FILTER) for t in rest):
                without = finest_lag(without)
            gain = gain_of(without, fit, term)
            left = without.held_out()
            need = price(term, left, without)
            # Beside others the parameters may have become what no instrument has.
            share = min(gain / need, 0.0) if doubt(fit, index) else gain / need
            if share < 1 and (weakest is None or share < weakest[0]):
                weakest = share, term, without
            evidence.append(
                PoseEvidence(
                    gain, gain * fit.misfit / left, without.state.rms()[0], fit.state.rms()[0]
                )
            )
        if weakest is None:
            return fit, tuple(evidence), dropped
        share, term, without = weakest
        dropped.append((term.label, f'{share:.2f} of the gain that it must have'))
        fit = with_noise(without, with_stamps)
