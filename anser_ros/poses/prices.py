"""States how much of held-out blocks an effect on poses must explain to be named."""

from collections.abc import Sequence

import numpy as np

from anser_ros.diagnosis.decisions import LEAST_GAIN, PER_PARAMETER
from anser_ros.poses.effect import PoseTerm, Role
from anser_ros.poses.fit import PoseFit
from anser_ros.poses.problem import PosePart
from anser_ros.poses.stamp_step import stamp_step

LEAST_EXPLAINED = 0.015
"""Share of the sum of squares that an effect must explain on unseen blocks: errors of trackers are
alike over seconds and centimetres, and any smooth course takes a trace of them."""
MAP_SHARE, LARGE_SHARE = 0.55, 0.3
"""Share of the squared error of positions that a map must explain, since it follows whatever is
smooth: most, or less where it moves poses by `LARGE_M`. Chosen on recordings with and without
metal."""
LARGE_M = 1.5e-3
"""Error, m, that no tracker has of itself: data sheets say 0.5 to 1.4 mm. What a map takes off is
larger then, and something is there that bends the field."""
SCALE_SHARE, SCALE_M = 0.1, 0.8e-3
"""The same of a scale of one sensor alone, which is few numbers and follows hardly anything: this
share, or more where that is less than `SCALE_M`."""
LEAST_MAP_M = 0.5e-3
"""How far a map must move poses, and what it must take off their errors, m rms: no tracker claims
less of itself. Smaller names what is within its accuracy."""

LEAST_SCALE_SIGMAS = 5.0
"""Standard deviations by which a scale must differ from one, or a sensor's clock from the others':
of six recordings at rest, each a block, 1 in 250 such is chance."""
LEAST_CLOCK_SIGMAS = 3.0
"""The same of a clock that all sensors share: 1 in 370. Smaller names an offset that is less than
what is known of it; larger misses slight ones of a slow tracker."""


def gain_of(before: PoseFit, after: PoseFit, term: PoseTerm) -> float:
    """Return what a term takes off the cross-validated sum of squares, in units of the misfit.

    Blocks of space decide as well on an effect that depends on place.
    """
    effect = term.effect
    ways = (False, True) if effect.blocks_in_space else (False,)
    return min((before.held_out(w) - after.held_out(w)) / after.misfit for w in ways)


def price(term: PoseTerm, total: float, fit: PoseFit) -> float:
    """Return the gain, in units of the misfit, that a term needs; ``total`` is the squared sum."""
    misfit, share = fit.misfit, LEAST_EXPLAINED
    # Only the errors of its own sensor, and of positions where it is a map, can be explained.
    rows = slice(3) if term.role is Role.MAP else slice(6)
    parts = [p for p in fit.state.parts if term.acts_on(p.view.sensor)]
    own = float(sum(np.sum(p.white[:, rows] ** 2) for p in parts))
    if term.role is Role.MAP:
        share = _map_share(term, parts)
    total *= own / max(fit.state.sum_of_squares, 1e-300)
    return max(LEAST_GAIN + PER_PARAMETER * max(term.complexity, 1), share * total / misfit)


def _map_share(term: PoseTerm, parts: Sequence[PosePart]) -> float:
    """Share of the squared error of its sensors' positions that a map must explain.

    What errors of the stamps make is no error of places, and follows no map.
    """
    squares = [p.noise.position_m**2 * np.sum(p.white[p.used, :3] ** 2, axis=1) for p in parts]
    error = float(np.mean(np.concatenate(squares)))
    is_scale = term.effect.is_scale(term)
    least, size = (SCALE_SHARE, SCALE_M) if is_scale else (LARGE_SHARE, LARGE_M)
    return float(np.clip(size**2 / max(error, 1e-18), least, MAP_SHARE))


def doubt(fit: PoseFit, index: int) -> str:
    """Return why the parameters of a term are not believed; empty where they are."""
    term, covariance = fit.terms[index], fit.covariance_of(index)
    effect = term.effect
    record = effect.record(term, covariance)
    if not effect.possible(record):
        return 'implausible parameters'
    views = [part.view for part in fit.state.parts]
    seen = effect.seen_at(record, term, covariance, views)
    if term.role is Role.MAP and float(seen.parameters['rms_m']) < LEAST_MAP_M:
        return f'moves poses by less than {1e3 * LEAST_MAP_M:g} mm'
    sigma = float(np.sqrt(covariance[0, 0]))
    own_clock = effect.role.is_clock and term.sensor is not None
    if effect.role is Role.RATE and _is_beat(fit, term):
        return 'no more than the beat of a poll'
    least = LEAST_CLOCK_SIGMAS if effect.role.is_clock else 0.0
    if effect.is_scale(term) or own_clock:
        least = LEAST_SCALE_SIGMAS
    if abs(float(term.theta[0])) < least * sigma:
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
