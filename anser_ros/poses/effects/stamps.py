"""Stamps are those of a receipt or of a poll, and not of the measurement."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from anser_ros.field.model import EffectRecord
from anser_ros.poses.effect import PoseEffect, PoseResiduals, Sensing
from anser_ros.poses.stamp_step import stamp_step

Array = NDArray[np.float64]

LEAST_S = 2e-3
"""Error of the stamps, s, from which it is named: less moves a hand by a tenth of a millimetre.
Smaller names what harms nobody; larger leaves errors of a fast hand unnamed."""
LEAST_LIKELIHOOD_GAIN = 25.0
"""Minus twice the log likelihood that it must take off in the median sensor; chance takes one, and
so much once in two million sensors."""
STEP_SHARE = (0.15, 0.7)
"""Error over the step that rounding to a step makes: 0.29 if even, more if a poll is late."""


def _is_wide(residuals: PoseResiduals) -> tuple[float, float]:
    """The median error of the stamps over the sensors, and what believing it gains.

    None where fewer than half of the sensors have one: what one of two shows is no clock's.
    """
    errors = [s.stamp_s for s in residuals.sensors]
    if np.percentile(errors, 50, method='lower') < LEAST_S:
        return 0.0, 0.0
    return float(np.median(errors)), float(np.median([s.stamp_gain for s in residuals.sensors]))


def _sigma(residuals: PoseResiduals) -> float:
    """Standard deviation of the median error of the stamps, s.

    By Fisher's information about a variance: each pose has one degree of freedom along its
    velocity, and tells as much of the stamps' error as that is of its error there. Sensors that
    differ by more than this have errors of their own; those that share stamps share the error.
    """
    sensors = residuals.sensors
    sigmas = [s.stamp_s / np.sqrt(2 * max(np.sum(_stamp_share(s) ** 2), 1.0)) for s in sensors]
    apart = len({s.view.time.tobytes() for s in sensors})
    scatter = np.std([s.stamp_s for s in sensors]) / np.sqrt(len(sensors))
    return float(max(scatter, np.median(sigmas) / np.sqrt(apart)))


def _stamp_share(sensing: Sensing) -> Array:
    """Share (n,) of the variance along the velocity that errors of the stamps make."""
    velocity = sensing.view.velocity[sensing.used]
    scale = np.repeat([sensing.position_m, sensing.orientation_rad], 3)
    moved = sensing.stamp_s**2 * np.sum((velocity / scale) ** 2, axis=1)
    return np.asarray(moved / (1 + moved))


def _step(residuals: PoseResiduals, rms: float) -> float:
    """The step of the stamps that makes an error of that size, or zero."""
    for sensing in residuals.sensors:
        step = stamp_step(residuals.session.sensors[sensing.view.sensor].time)
        if step and STEP_SHARE[0] * step < rms < STEP_SHARE[1] * step:
            return step
    return 0.0


class ReceiptJitter(PoseEffect):
    """Stamps are off at random: poses are off along their own velocity."""

    name = 'stamp_jitter'
    summary = 'stamps are those of receipt, and jitter'
    advice = 'Use the counter of the device as stamp (import_poses --stamps device).'
    units = {'rms_s': 's'}
    needs_levers = True
    makes_jitter = True

    def observed(self, residuals: PoseResiduals) -> Sequence[EffectRecord]:
        """Look for a residual that lies along the velocity and grows with it."""
        rms, gain = _is_wide(residuals)
        if rms < LEAST_S or gain < LEAST_LIKELIHOOD_GAIN or _step(residuals, rms):
            return []
        spread = _sigma(residuals)
        values = {'rms_s': rms, 'by_sensor': {s.view.sensor: s.stamp_s for s in residuals.sensors}}
        return [EffectRecord(self.name, values, {'rms_s': spread}, {'likelihood_gain': gain})]


class QuantisedStamps(PoseEffect):
    """Stamps lie on the grid of a poll, and poses are off along their velocity by as much."""

    name = 'quantised_stamps'
    summary = 'stamps are those of a poll'
    advice = 'Use the counter of the device as stamp, or poll more often.'
    units = {'step_s': 's'}
    needs_levers = True
    makes_jitter = True

    def observed(self, residuals: PoseResiduals) -> Sequence[EffectRecord]:
        """Look for an error of the stamps that is that of their grid."""
        rms, gain = _is_wide(residuals)
        step = _step(residuals, rms) if rms >= LEAST_S and gain >= LEAST_LIKELIHOOD_GAIN else 0.0
        if not step:
            return []
        values = {'step_s': step, 'rms_s': rms}
        return [
            EffectRecord(self.name, values, {'step_s': 0.01 * step}, {'likelihood_gain': gain})
        ]


EFFECTS = (ReceiptJitter(), QuantisedStamps())
