"""Which of several fitted explanations is taken."""

from collections.abc import Sequence

from anser_ros.diagnosis.fit import Fit, misfit
from anser_ros.diagnosis.fluctuating import is_of
from anser_ros.diagnosis.structure import noise_scale
from anser_ros.effects.effect import Term
from anser_ros.effects.fluctuation import Fluctuation

OPEN = 40
"""Parameters that a fluctuation counts for: more than a constant has, less than shaped metal."""
SHAPED = 60
"""Parameters that metal that moves counts for at least: it is shaped once it is taken."""
STEADY = 0.8
"""Share of a fluctuation's gain from which a constant, or a curve, of the same coil or channel is
tried first: freedom in every frame also takes off what is another effect's."""
OTHERS = 2.0
"""What a fluctuation takes off others, over what values alike would lose."""
NOTHING_LEFT = 1.04
"""Misfit over the noise's up to which nothing but noise is left."""


def complexity(term: Term) -> int:
    """Parameters that are paid for when explanations are compared."""
    if isinstance(term.effect, Fluctuation):
        return OPEN
    return max(int(term.theta.size), SHAPED if term.effect.moving else 0)


def at_floor(fit: Fit) -> bool:
    """Whether a fit leaves nothing but noise."""
    return misfit(fit) < NOTHING_LEFT * max(noise_scale(fit.state) ** 2, 1.0)


def taken_from_others(fit: Fit) -> float:
    """What a new fluctuation's freedom takes off that is some other effect's, still unexplained.

    Along each of its columns a frame loses one value's share of whatever stays.
    """
    spread = fit.terms[-1].site.get('_spread')
    if spread is None:
        return 0.0
    frames = int(fit.terms[-1].site.get('_frames', 0))
    return OTHERS * frames * len(spread) * max(misfit(fit) - 1.0, 0.0)


def choose(fitted: Sequence[tuple[float, Fit]]) -> tuple[float, Fit]:
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
