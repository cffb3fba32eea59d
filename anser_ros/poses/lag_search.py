"""Looks for a low pass, whose time constant has no slope at zero and is tried at some values."""

import numpy as np

from anser_ros.diagnosis.decisions import LEAST_GAIN
from anser_ros.poses.effect import Role
from anser_ros.poses.fit import PoseFit, fit_poses, with_time_constants
from anser_ros.poses.prices import gain_of, price
from anser_ros.poses.registry import pose_effects

CHANCE_SIGMAS = 3.0
"""Standard deviations of what chance adds to the noise that a smoother reference takes off."""
LAG_STEPS = (1.4, 1.4, 1.2, 1.1, 1.05)  # factors of a time constant by which it is neared


def with_lag(
    fit: PoseFit, refused: list[tuple[str, str]]
) -> tuple[PoseFit | None, PoseFit | None]:
    """Return the fit with a low pass, where neither a delay nor a smooth reference does as well.

    Also the best fit with a low pass or a smooth reference, whether it pays or not.
    """
    if any(term.role is Role.FILTER for term in fit.terms):
        return None, None
    trials = [
        fit_poses(fit.state.problem, [*fit.terms, term], 3)
        for effect in pose_effects().values()
        if effect.role is Role.FILTER
        for term in effect.sites(fit.state.problem.setting)
    ]
    trial = finest_lag(min(trials, key=lambda t: t.state.sum_of_squares))
    term = trial.terms[-1]
    noisy = _is_smoothing(fit, trial)
    widths = [term.with_theta(factor * term.theta) for factor in (0.5, 1.0, 2.0) if noisy]
    rivals = [fit_poses(fit.state.problem, [*fit.terms, t.effect.rival(t)], 3) for t in widths]
    best = min([fit, *rivals], key=lambda f: f.held_out())
    gain = gain_of(best, trial, term)
    need = price(term, fit.held_out(), fit)
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

    That is the noise of its poses, and what errors of its stamps make of its velocity where those
    of the tracker have errors: one host stamps both. Errors of the tracker that happen to go with
    this noise are taken off with it, or stay.
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
            trial = _slower(best, direction)
            if trial.state.sum_of_squares < best.state.sum_of_squares:
                best = trial
                break
    return with_time_constants(best)


def _slower(fit: PoseFit, factor: float) -> PoseFit:
    """The fit with time constants so many times as long, and all else fitted again."""
    terms = [t.with_theta(factor * t.theta) if t.role is Role.FILTER else t for t in fit.terms]
    return fit_poses(fit.state.problem, terms, 3)
