"""Searches which effects a session of poses shows: each must improve held-out blocks.

The currencies and prices are those of `anser_ros.diagnosis.decisions`: gains in the whitened sum
of squares, cross-validated over blocks of time, and for effects that depend on place also over
blocks of space, because a map looks too good on neighbours in time.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from anser_ros.apps.poses.effect import PoseTerm, Role, pose_effects
from anser_ros.apps.poses.fit import (
    LARGEST_STAMP_S,
    PoseFit,
    fit_poses,
    is_one_scale,
    knows_levers,
    most_poses,
    noise_of,
    weights_of,
    with_time_constants,
)
from anser_ros.apps.poses.problem import PoseNoise, PosePart, PoseProblem, PoseState, stamp_step
from anser_ros.apps.poses.sequence import PoseSession
from anser_ros.apps.poses.start import FEWEST_HAND_EYE_POSES
from anser_ros.diagnosis.decisions import AS_GOOD_PER_PARAMETER, LEAST_GAIN, PER_PARAMETER
from anser_ros.diagnosis.engine import ForwardSelection, Scorer, is_covered
from anser_ros.errors import DiagnosisError

LEAST_EXPLAINED = 0.015
"""Share of the squares to explain on unseen blocks: any smooth course takes a trace of errors."""
MAP_SHARE, LARGE_SHARE = 0.55, 0.3
"""Share of the squared error of positions that a map must explain: most, or less where it moves
poses by `LARGE_M`. Chosen on recordings with and without metal."""
LARGE_M = 1.5e-3
"""Error, m, that no tracker has of itself: data sheets say 0.5 to 1.4 mm."""
SCALE_SHARE, SCALE_M = 0.1, 0.8e-3
"""The same of what follows hardly anything, such as one sensor's scale: more below `SCALE_M`."""
LEAST_MAP_M = 0.5e-3
"""Least that a map moves poses and takes off their errors, m rms: no tracker claims less."""
LEAST_TOLD = 0.05
"""Least share of an effect's square that frames do not make up for: 0.7 where orientation errors
are, at most 0.03 where a body hardly turns, and they moved lever arms by 2 to 46 mm."""
LEAST_OWN_SIGMAS = 5.0
"""Sigmas, of noise, by which a scale differs from one, or a sensor's clock from others: chance, 1
in 250."""
LEAST_SIGMAS = 3.0
"""The same of a clock that all sensors share: chance, 1 in 370."""
LEAST_FAKED = 2.3
"""Sigmas, with what distortions fake, by which a scale differs from one: chance, 1 in 30."""


def gain_of(before: PoseFit, after: PoseFit, term: PoseTerm) -> float:
    """Return what a term takes off the cross-validated sum of squares, in units of the misfit.

    Blocks of space decide as well on an effect that depends on place.
    """
    effect = term.effect
    ways = (False, True) if effect.blocks_in_space else (False,)
    return min((before.held_out(w) - after.held_out(w)) / after.misfit for w in ways)


def price(term: PoseTerm, total: float, fit: PoseFit) -> float:
    """Return the gain, in units of the misfit, that a term needs; ``total`` is the squared sum."""
    # Only the errors of its own sensor, and of positions where it is a map, can be explained.
    rows = slice(3) if term.role is Role.MAP else slice(6)
    parts = [p for p in fit.state.parts if term.acts_on(p.view.sensor)]
    own = float(sum(np.sum(p.white[:, rows] ** 2) for p in parts))
    share = _map_share(term, parts) if term.role is Role.MAP else LEAST_EXPLAINED
    total *= own / max(fit.state.sum_of_squares, 1e-300)
    return max(LEAST_GAIN + PER_PARAMETER * max(term.complexity, 1), share * total / fit.misfit)


def _map_share(term: PoseTerm, parts: Sequence[PosePart]) -> float:
    """Share of the squared error of its sensors' positions that a map must explain.

    What errors of the stamps make is no error of places, and follows no map.
    """
    squares = [p.noise.position_m**2 * np.sum(p.white[p.used, :3] ** 2, axis=1) for p in parts]
    error = float(np.mean(np.concatenate(squares)))
    is_stiff = term.effect.is_scale(term) or term.effect.is_stiff
    least, size = (SCALE_SHARE, SCALE_M) if is_stiff else (LARGE_SHARE, LARGE_M)
    return float(np.clip(size**2 / max(error, 1e-18), least, MAP_SHARE))


def doubt(fit: PoseFit, index: int) -> str:
    """Return why the parameters of a term are not believed; empty where they are."""
    term, covariance = fit.terms[index], fit.covariance_of(index)
    effect = term.effect
    record = effect.record(term, covariance)
    if not effect.possible(record):
        return 'implausible parameters'
    seen = effect.seen_at(record, term, covariance, [part.view for part in fit.state.parts])
    if term.role is Role.MAP and float(seen.parameters['rms_m']) < LEAST_MAP_M:
        return f'moves poses by less than {1e3 * LEAST_MAP_M:g} mm'
    if float(seen.parameters.get('told_share', 1.0)) < LEAST_TOLD:
        return 'lever arms and the registration do nearly the same'
    noise = float(np.sqrt(fit.noise_covariance[fit.rows(index), fit.rows(index)][0, 0]))
    own_clock = effect.role.is_clock and term.sensor is not None
    if effect.role is Role.RATE and _is_beat(fit, term):
        return 'no more than the beat of a poll'
    is_told = effect.role.is_clock or effect.is_scale(term)
    least = LEAST_OWN_SIGMAS if effect.is_scale(term) or own_clock else LEAST_SIGMAS
    sigma = max(least * noise, LEAST_FAKED * float(np.sqrt(covariance[0, 0])))
    if is_told and abs(float(term.theta[0])) < sigma:
        return f'less than {least:g} of its standard deviations'
    return ''


def _is_beat(fit: PoseFit, term: PoseTerm) -> bool:
    """Whether a clock gains no more over the session than the step of its poll.

    Stamps on a grid are off by a sawtooth, which is slow where the rates of tracker and poll are
    nearly in a simple ratio: then it is a course of the clock by up to a step.
    """
    problem = fit.state.problem
    step = max(stamp_step(poses.time) for poses in problem.sensors)
    return 1e-3 * abs(float(term.theta[0])) * problem.setting.duration < step


CHANCE_SIGMAS = 3.0
"""Standard deviations of what chance adds to the noise that a smoother reference takes off."""
HALF = 0.5
"""Share of the gain that it must have from which a time constant, off by a fourth root of two or
less, is fitted: it then has nine tenths of what it can gain."""
LAG_STEPS = (1.4, 1.4, 1.2, 1.1, 1.05)  # factors of a time constant by which it is neared


def with_lag(
    fit: PoseFit, refused: list[tuple[str, str]], rival: PoseFit
) -> tuple[PoseFit | None, PoseFit | None]:
    """Return the fit with a low pass, where neither a delay nor a smooth reference does as well.

    Also the best fit with a low pass or a smooth reference, whether it pays or not. One that
    cannot do as well as a rival is not looked at closely.
    """
    if any(term.role is Role.FILTER for term in fit.terms):
        return None, None
    trials = [
        fit_poses(fit.state.problem, [*fit.terms, term], 1)
        for effect in pose_effects().values()
        if effect.role is Role.FILTER
        for term in effect.sites(fit.state.problem.setting)
    ]
    trial = min(trials, key=lambda t: t.state.sum_of_squares)
    term, total = trial.terms[-1], fit.held_out()
    need = price(term, total, fit)
    gain = max(need * fit.misfit, fit.state.sum_of_squares - rival.state.sum_of_squares)
    if fit.state.sum_of_squares - trial.state.sum_of_squares < HALF * gain:
        return None, trial if trial.held_out() < total else None
    trial = finest_lag(trial)
    term = trial.terms[-1]
    noisy = _is_smoothing(fit, trial)
    widths = [term.with_theta(factor * term.theta) for factor in (0.5, 1.0, 2.0) if noisy]
    rivals = [fit_poses(fit.state.problem, [*fit.terms, t.effect.rival(t)], 3) for t in widths]
    best = min([fit, *rivals], key=lambda f: f.held_out())
    gain = gain_of(best, trial, term)
    left = min(trial, best, key=lambda one: one.held_out())
    if gain < need:
        if gain_of(fit, trial, term) > need:
            refused.append((term.label, 'a smoother reference explains as much'))
        return None, left
    if not _all_gain(best, trial):
        refused.append((term.label, 'not all sensors of the tracker show it'))
        return None, left
    return trial, left


def _is_smoothing(before: PoseFit, after: PoseFit) -> bool:
    """Whether a filter takes off no more than a smoother reference can.

    That is the noise of its poses, and of its stamps where those of the tracker have errors.
    """
    path, taken, noise, left, count = before.state.problem.path, 0.0, 0.0, 0.0, 0
    for old, new in zip(before.state.parts, after.state.parts, strict=True):
        both = old.used & new.used
        squares = [float(np.sum(part.residual[both, :3] ** 2)) for part in (old, new)]
        taken += squares[0] - squares[1]
        left += squares[1]
        count += 3 * int(np.count_nonzero(both))
        noise += 3 * np.count_nonzero(both) * path.jitter(old.view.lever) ** 2
        noise += float(np.sum((old.noise.stamp_s * old.view.velocity[both, :3]) ** 2))
    return taken < noise + CHANCE_SIGMAS * 2 * float(np.sqrt(noise * left / max(count, 1)))


def _all_gain(before: PoseFit, after: PoseFit) -> bool:
    """Whether an effect of the tracker itself takes off errors of each of its sensors."""
    pairs = zip(before.state.parts, after.state.parts, strict=True)
    gains = [float(np.sum(old.white**2) - np.sum(new.white**2)) for old, new in pairs]
    return min(gains) > LEAST_GAIN * after.misfit


def finest_lag(fit: PoseFit) -> PoseFit:
    """Return the fit at the best time constant: by ever smaller steps, and then by its slopes."""
    best = fit
    for factor in LAG_STEPS:
        for direction in (factor, 1 / factor):
            terms = [
                t.with_theta(direction * t.theta) if t.role is Role.FILTER else t
                for t in best.terms
            ]
            trial = fit_poses(best.state.problem, terms, 3)
            if trial.state.sum_of_squares < best.state.sum_of_squares:
                best = trial
                break
    return with_time_constants(best)


POSES_A_PARAMETER = 6
"""Poses that a parameter needs: more leave metal unnamed in a minute of a slow tracker."""
FULL_FITS = 3  # candidates fitted in full in each round, which takes most of the time
NOISE_ROUNDS = 3  # times that noise and what stands out, which depend on each other, are found
STAMP_GAIN = 25.0
"""Minus twice the log likelihood that an error of a sensor's stamps takes off; chance: one."""


class PoseEvidence(NamedTuple):
    """States the evidence for an active term, of the poses that were fitted."""

    held_out_gain: float  # what it takes off the cross-validated squares, in units of the misfit
    held_out_share: float  # the same over the sum of squares without it
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
    problem = replace(fit.state.problem, weight=weights_of(fit.state))
    for _ in range(NOISE_ROUNDS):
        parts = problem.state(fit.terms).parts
        noise = tuple(likely_noise(p) if with_stamps else noise_of(p, False)[0] for p in parts)
        problem = judged(problem, fit, noise)
    return fit_poses(problem, fit.terms)


def judged(
    problem: PoseProblem, fit: PoseFit, noise: tuple[PoseNoise, ...] | None = None
) -> PoseProblem:
    """Return a problem with a noise, a fit's by default, less poses that stand out from it."""
    every = tuple(np.ones(s.size) for s in problem.sensors)
    noisy = replace(problem, weight=every, noise=noise or fit.state.problem.noise)
    return replace(noisy, weight=weights_of(noisy.state(fit.terms)))


def likely_noise(part: PosePart) -> PoseNoise:
    """Return a sensor's noise, with an error of the stamps where that is believed."""
    plain, without = noise_of(part, with_stamps=False)
    full, cost = noise_of(part, with_stamps=True)
    believed = without - cost > STAMP_GAIN and full.stamp_s < LARGEST_STAMP_S
    return full if believed else plain


def search_effects(
    start: PoseFit, session: PoseSession, say: Callable[[str], None], is_wanted: bool = True
) -> PoseSearch:
    """Add effects one by one, the best first, while each pays for itself; drop what does not.

    Where it is not wanted the frames alone are fitted, and only the clocks are tried where the
    motion determines no lever arm. Raises `DiagnosisError` when too few poses agree.
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
    how = _PoseSelection(is_known, say)
    if not is_wanted:
        fit = with_noise(fit_poses(fit.state.problem, frame_terms(fit.terms)), is_known)
        return PoseSearch(fit, (None,) * len(fit.terms), (), is_known)
    fit = how.thinned(how.grown(fit))
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
        trials = [self._accepted(fit, term) for term in _finalists(fit, self._knows_levers)]
        accepted = [trial for trial in trials if trial is not None]
        # A map only when no effect with few numbers is left: a scale is a part of any.
        plain = [pair for pair in accepted if pair[1].terms[-1].role is not Role.MAP]
        best = max(plain or accepted, key=lambda pair: pair[0])[1] if accepted else None
        if not self._knows_levers or (best is not None and best.terms[-1].role.is_clock):
            return best
        # A filter rounds off turning points, which looks like a scale or a map.
        lagging, filtered = with_lag(fit, self.refused, fit if best is None else best)
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
        if term.role is Role.SCALE:
            whole = [t.effect.beside_scale(t, False) for t in without.terms]
            without = fit_poses(fit.state.problem, whole)
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
    is_scaled = any(term.role is Role.SCALE for term in fit.terms)
    for effect in pose_effects().values():
        for site in effect.sites(state.problem.setting):
            term = effect.beside_scale(site) if is_scaled else site
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
