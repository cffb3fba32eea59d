"""Knows how emitters' strengths may change while a session is recorded."""

from collections.abc import Sequence

import numpy as np

from anser_ros.arrays import Array, ComplexArray, Integers
from anser_ros.calibration.population import Likelihood, Posterior, solve
from anser_ros.field.measurements import Measurements
from anser_ros.settings import EMITTER_STEADY_S, ToolSettings

WAYS, POINTS = 3, 60
"""Ways in which a strength changes (others add less than a thousandth to a minute of warming), and
times at which they are worked out (between them they are straight, to 1e-5)."""
LEAST_EVIDENCE = 1.0
"""Gain of the log probability for which a strength is let change: emitters that warm up are no
rarity, and one that is let change for nothing costs a hundredth of a millimetre."""
NONE = 1e-12
"""Width of what is held fixed."""


def let_change(likelihood: Likelihood, found: Posterior, groups: Sequence[Integers]) -> Posterior:
    """Return the parameters with one more of some groups let change, or one less, if likelier."""
    best = found
    for rows in groups:
        width, is_held = found.width.copy(), bool(found.width[rows[0]] == NONE)
        width[rows] = 1.0 if is_held else NONE
        other = solve(likelihood, width)
        if other.evidence - LEAST_EVIDENCE * is_held > best.evidence:
            best = other
    return best


class StrengthCourses:
    """Holds the ways in which strengths change in each session, none of them at its start.

    They are the strongest of a rate that goes on for a while, as tracking has it, each of one
    standard deviation. An emitter has ``count`` parameters, those of real parts first.
    """

    def __init__(self, measurements: Sequence[Measurements]) -> None:
        self._ways: dict[str, tuple[Array, Array]] = {}
        for name in dict.fromkeys(m.session for m in measurements):
            times = np.concatenate([m.time for m in measurements if m.session == name])
            late = np.linspace(0.0, max(float(np.ptp(times)), 1.0), POINTS) / EMITTER_STEADY_S
            both, gone = np.minimum(late[:, None], late), np.exp(-late)
            shared = (
                2.0 * both - 1.0 + gone[:, None] + gone - np.exp(-np.abs(late[:, None] - late))
            )
            values, vectors = np.linalg.eigh(shared)
            size = ToolSettings.emitter_rate_1_s * EMITTER_STEADY_S * np.sqrt(values[-WAYS:])
            self._ways[name] = times.min() + EMITTER_STEADY_S * late, size * vectors[:, -WAYS:]
        self.count = 2 * WAYS * len(self._ways)

    def of(self, measurements: Measurements) -> Array:
        """Return what each parameter adds to a strength, (F, `count`/2)."""
        out = np.zeros((len(measurements.time), len(self._ways), WAYS))
        (time, ways), here = self._ways[measurements.session], list(self._ways)
        now = [np.interp(measurements.time, time, way) for way in ways.T]
        out[:, here.index(measurements.session)] = np.stack(now, axis=1)
        return out.reshape(len(out), -1)

    def strengths(self, measurements: Measurements, values: Array) -> ComplexArray:
        """Return emitters' strengths (F, K) by their parameters (K, `count`)."""
        real, imaginary = np.split(values, 2, axis=1)
        return np.asarray(1.0 + self.of(measurements) @ (real + 1j * imaginary).T)
