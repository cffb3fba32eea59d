"""Choose which of several fitted explanations is taken."""

from collections.abc import Sequence

from anser_ros.diagnosis.decisions import FROM_OTHERS, NOTHING_LEFT, STEADY, as_good
from anser_ros.diagnosis.fit import Fit
from anser_ros.diagnosis.structure import noise_scale
from anser_ros.effects.effect import Family


def at_floor(fit: Fit) -> bool:
    """Return whether a fit leaves nothing but noise."""
    return fit.misfit < NOTHING_LEFT * max(noise_scale(fit.state) ** 2, 1.0)


def taken_from_others(fit: Fit) -> float:
    """Return what a new fluctuation's freedom takes off that is another effect's, unexplained so
    far.

    For each of its columns, every frame loses the share of one value in the remaining residual.
    """
    return FROM_OTHERS * fit.newest.effect.freedom(fit.newest) * max(fit.misfit - 1.0, 0.0)


def choose(fitted: Sequence[tuple[float, Fit]]) -> tuple[float, Fit]:
    """Return the best fit, or a simpler one that is as good within what its parameters could gain.

    If several leave nothing but noise, the simplest is chosen.
    """
    gain, best = max(fitted, key=lambda pair: pair[0])
    newest = best.newest
    steady = [
        (g, f) for g, f in fitted if g > STEADY * gain and newest.effect.rivals(newest, f.newest)
    ]
    if steady:
        gain, best = max(steady, key=lambda pair: pair[0])
    most = best.newest.complexity
    simpler = [
        (g, f)
        for g, f in fitted
        if f.newest.complexity < most
        and gain - g < as_good(most - f.newest.complexity) * max(best.misfit, 1.0)
    ]
    simpler += [
        (g, f)
        for g, f in fitted
        if f.newest.effect.family is Family.FLUCTUATION
        and f.newest.complexity < most
        and at_floor(f)
    ]
    if not simpler:
        return gain, best
    return min(simpler, key=lambda pair: (pair[1].newest.complexity, -pair[0]))
