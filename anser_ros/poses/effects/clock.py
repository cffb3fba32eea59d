"""The clocks of the tracker and of the optical reference differ by an offset and a rate."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.base import Remedy
from anser_ros.poses.effect import NumberEffect, PoseSetting, PoseTerm, PoseView, Role

Array = NDArray[np.float64]


class PoseTimeOffset(NumberEffect):
    """Applies the optical pose stamped t - theta at stamp t of a tracked pose, s."""

    name = 'time_offset'
    summary = 'the tracked stamps are late (positive) or early by the optical clock'
    advice = 'Correct the stamps by it; both streams stamped by one clock do not have it.'
    units = {'offset_s': 's'}
    plausible = {'offset_s': (-5.0, 5.0)}
    remedy = Remedy.OPTICAL
    role = Role.OFFSET
    key = 'offset_s'
    spread = 0.3  # s: offsets are some tenths of a second

    def sites(self, setting: PoseSetting) -> Sequence[PoseTerm]:
        """Try one offset for all sensors, and one per sensor."""
        own = [PoseTerm(self, {'sensor': s}, np.zeros(1)) for s in setting.sensors]
        return [PoseTerm(self, {}, np.zeros(1)), *(own if len(own) > 1 else [])]

    def slopes(self, term: PoseTerm, view: PoseView) -> Array | None:
        """Return minus the velocity of the predicted pose, or None for other sensors."""
        return -view.velocity[:, :, None] if term.acts_on(view.sensor) else None

    def clock(self, term: PoseTerm, sensor: str, time: Array) -> Array:
        """Return the stamps less the offset."""
        return time - term.theta[0] if term.acts_on(sensor) else time


class PoseClockRate(NumberEffect):
    """Theta is the rate, 1e-3, by which the tracked clock gains on the optical one."""

    name = 'clock_rate'
    summary = 'the clocks of tracker and reference run apart'
    advice = (
        'Stamp both streams by one clock; the corrector removes it within this recording alone.'
    )
    units = {'rate_ppm': '1e-6'}
    plausible = {'rate_ppm': (-3e3, 3e3)}
    remedy = Remedy.OPTICAL
    role = Role.RATE
    key, factor = 'rate_ppm', 1e3
    spread = 2.0  # rates err by some parts in a thousand

    def sites(self, setting: PoseSetting) -> Sequence[PoseTerm]:
        """Return one term, as one rate holds for all sensors."""
        middle = setting.start + 0.5 * setting.duration
        return [PoseTerm(self, {'middle_s': middle}, np.zeros(1))]

    def slopes(self, term: PoseTerm, view: PoseView) -> Array | None:
        """Return minus the velocity, the more the farther from the session's middle."""
        apart = 1e-3 * (view.time - term.site['middle_s']) / (1 + 1e-3 * term.theta[0]) ** 2
        return np.asarray(-(view.velocity * apart[:, None])[:, :, None])

    def clock(self, term: PoseTerm, sensor: str, time: Array) -> Array:
        """Return the stamps, s, without what their clock gains: a rate of r makes times 1 + r."""
        middle = term.site['middle_s']
        return np.asarray(middle + (time - middle) / (1 + 1e-3 * term.theta[0]))


EFFECTS = (PoseTimeOffset(), PoseClockRate())
