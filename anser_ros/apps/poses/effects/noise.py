"""A sensor's noise is larger than the others', or grows with the distance."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from anser_ros.apps.poses.effect import PoseEffect
from anser_ros.apps.poses.effects.episodes import in_episode
from anser_ros.apps.poses.problem import PoseResiduals, Sensing, jitter
from anser_ros.field.model import EffectRecord

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

NOISIER = 2.0
"""Factor over the other sensors' median noise from which a sensor's is named; sensors of one kind
at one place differ by a half."""
GROWN = 2.0
"""Factor of the jitter over that of a watch's first look from which it is reported: of trackers it
grows by half over their volume."""
WIDEST = 1.3
"""Ratio of far to near distances (95 to 5 %) without which no power law of it can be seen."""
LEAST_LAW_SIGMAS = 5.0
"""Standard deviations by which the noise must differ from a constant: by the likelihood, and by
those of the exponent, which few distances leave large."""
EXPONENTS = (2.8, 6.5)
"""Exponents of the noise that a field makes: the signal falls with the third power, the gradient
with the fourth; what is outside is something else."""
SHARES = np.array([1, 4, 1]) / 6
"""Shares of the variances of three poses in that of their second difference."""
NEW_SHARE = 18 / 35
"""Share of squared second differences that is new: neighbours share values. Their correlations are
-2/3 and 1/6, those of squares 4/9 and 1/36, on both sides."""
REACHED = 12.0
"""Squared deviation over its variance by the law that noise does not reach: once in 1e5. A pose
that the law does not reach has another cause, and one that it reaches is no outlier."""
AT_REST_M_S, HARDLY_EVER = 0.01, 0.1
"""Speed, m/s, below which a body counts as at rest (a hand drifts by less), and share of poses in
motion below which it always is."""
FEWEST_DIFFERENCES = 60  # differences of neighbours that a power law is fitted to


def power_law(square: Array, distance: Array) -> tuple[float, float, float]:
    """Return the exponent of the noise by distance, its sigma, and the likelihood's gain.

    Square (n,) and distances (n, 3) are as of `jitter`. A squared deviation across the velocity
    has two degrees of freedom, so it is distributed exponentially about the variance, which is
    that of the three poses with their shares of a second difference.
    """
    place = np.log(distance / np.median(distance))
    near = REACHED * np.median(square) * np.exp(8 * np.maximum(place[:, 1], 0))
    first = _likeliest(np.minimum(square, near), place)
    reached = square < REACHED * _variance(first, place)
    square, place = square[reached], place[reached]
    best = _likeliest(square, place)
    least, step = _cost(best, square, place), 0.2

    def beside(exponent: float) -> float:
        """Least cost with the exponent held: level and floor go with it."""
        found = minimize(
            lambda v: _cost(np.array([exponent, *v]), square, place), best[1:],
            method='Nelder-Mead',
        )  # fmt: skip
        return float(found.fun)

    sides = [beside(float(best[0]) + way * step) for way in (-1, 1)]
    curvature = max((sum(sides) - 2 * least) / step**2, 1e-9) * NEW_SHARE
    plain = square.size * float(np.log(np.mean(square)) + 1)
    return float(best[0]), float(1 / np.sqrt(curvature)), 2 * NEW_SHARE * (plain - least)


def _variance(law: Array, place: Array) -> Array:
    """Variance (n,) of second differences by a law's exponent, level and floor.

    ``place`` (n, 3) is the logarithm of the distances; level and floor are logarithms too.
    """
    exponent, level, floor = law
    grown = np.exp(np.clip(level + 2 * exponent * place, -60, 60)) @ SHARES
    return np.asarray(grown + np.exp(np.clip(floor, -60, 60)))


def _cost(law: Array, square: Array, place: Array) -> float:
    """Minus the log likelihood of squared deviations (n,), which are distributed exponentially."""
    variance = _variance(law, place)
    return float(np.sum(np.log(variance) + square / variance))


def _likeliest(square: Array, place: Array) -> Array:
    """The law (exponent, level, floor) that is likeliest."""
    level = float(np.log(np.mean(square)))
    tries = [
        minimize(_cost, [n, level, level - 2], args=(square, place), method='Nelder-Mead')
        for n in (3.0, 5.0)
    ]
    return np.asarray(min(tries, key=lambda result: float(result.fun)).x)


def _jitter(sensing: Sensing, chosen: Mask) -> tuple[Array, Array]:
    """`jitter` of those of some poses (n,) in which the body moves; of all where it hardly does.

    A body that rests at one place and moves at others jitters less at the one.
    """
    moving = chosen & (np.linalg.norm(sensing.view.velocity[:, :3], axis=1) > AT_REST_M_S)
    hardly = np.count_nonzero(moving) < HARDLY_EVER * np.count_nonzero(chosen)
    return jitter(sensing, chosen if hardly else moving, sensing.noise.stamp_s > 0)


class PoseExcessNoise(PoseEffect):
    """One sensor's noise is a multiple of the others'."""

    name = 'excess_noise'
    summary = "a sensor's noise is larger than the others'"
    advice = 'Exchange the sensor or its cable, and record again.'
    units = {'factor': '1'}
    makes_jitter = True

    def more_jitter(self, factor: float) -> Sequence[EffectRecord]:
        """Return a record without a sensor: all of them jitter more."""
        if factor < GROWN:
            return ()
        return [EffectRecord(self.name, {'factor': factor}, {'factor': 0.1 * factor})]

    def observed(self, residuals: PoseResiduals) -> Sequence[EffectRecord]:
        """Return each sensor with more noise than the median of the others."""
        noise = {}
        law = RangeNoise().observed(residuals)
        exponent = float(law[0].parameters['exponent']) if law else 0.0
        for sensing in residuals.sensors:
            quiet = sensing.used & ~in_episode(sensing, residuals)
            square, distance = _jitter(sensing, quiet)
            square = square / distance[:, 1] ** (2 * exponent)
            if square.size >= FEWEST_DIFFERENCES:
                noise[sensing.view.sensor] = float(np.sqrt(np.median(square)))
        found = []
        for name, size in noise.items():
            others = [n for other, n in noise.items() if other != name]
            if others and size > NOISIER * float(np.median(others)):
                factor = size / float(np.median(others))
                values = {'sensor': name, 'factor': factor}
                found.append(EffectRecord(self.name, values, {'factor': 0.1 * factor}))
        return found


class RangeNoise(PoseEffect):
    """Jitter grows as a power of the distance from the field generator."""

    name = 'range_noise'
    summary = 'jitter grows with the distance from the field generator'
    advice = 'Work nearer to the field generator.'
    units = {'exponent': '1', 'reference_m': 'm'}
    makes_jitter = True

    def observed(self, residuals: PoseResiduals) -> Sequence[EffectRecord]:
        """Return a power law of all sensors together, each with a level of its own."""
        # Each sensor has a level of its own, so only what changes within one tells a power.
        # Poses far away stand out from a noise that is taken as one; the law judges them too.
        # Those of an episode are off by something else.
        every = [
            _jitter(one, (one.used | one.out) & ~in_episode(one, residuals))
            for one in residuals.sensors
        ]
        pairs = [pair for pair in every if pair[0].size >= FEWEST_DIFFERENCES]
        if not pairs:
            return []
        places = np.concatenate([distance for _, distance in pairs])
        square = np.concatenate([one / np.median(one) for one, _ in pairs])
        distance = np.concatenate([one / np.median(one) for _, one in pairs])
        low, high = np.percentile(distance, [5, 95])
        if high < WIDEST * low:
            return []
        exponent, spread, gain = power_law(square, distance)
        is_clear = gain > LEAST_LAW_SIGMAS**2 and exponent > LEAST_LAW_SIGMAS * spread
        if not (is_clear and EXPONENTS[0] <= exponent <= EXPONENTS[1]):
            return []
        values = {'exponent': exponent, 'reference_m': float(np.median(places))}
        return [EffectRecord(self.name, values, {'exponent': spread})]


EFFECTS = (
    PoseExcessNoise(),
    RangeNoise(),
)
