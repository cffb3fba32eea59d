"""The clocks of the tracker and of the optical reference differ by an offset and a rate."""

from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.base import Remedy
from anser_ros.effects.effect import needed, sigmas
from anser_ros.field.model import EffectRecord
from anser_ros.poses.effect import PoseEffect, PoseSetting, PoseSite, PoseTerm, PoseView, Role

Array = NDArray[np.float64]


class PoseTimeOffset(PoseEffect):
    """Applies the optical pose stamped t - theta at stamp t of a tracked pose, s."""

    name = 'time_offset'
    summary = 'the tracked stamps are late (positive) or early by the optical clock'
    advice = 'Correct the stamps by it; both streams stamped by one clock do not have it.'
    units: ClassVar[Mapping[str, str]] = {'offset_s': 's'}
    plausible: ClassVar[Mapping[str, tuple[float, float]]] = {'offset_s': (-5.0, 5.0)}
    remedy = Remedy.OPTICAL
    role = Role.OFFSET

    def sites(self, setting: PoseSetting) -> Sequence[PoseTerm]:
        """Try one offset for all sensors, and one per sensor."""
        own = [PoseTerm(self, {'sensor': s}, np.zeros(1)) for s in setting.sensors]
        return [PoseTerm(self, {}, np.zeros(1)), *(own if len(own) > 1 else [])]

    def prior(self, term: PoseTerm) -> Array:
        """Return a prior spread of 0.3 s: offsets are some tenths of a second."""
        return np.full(1, 0.3)

    def slopes(self, term: PoseTerm, view: PoseView) -> Array | None:
        """Return minus the velocity of the predicted pose, or None for other sensors."""
        return -view.velocity[:, :, None] if term.acts_on(view.sensor) else None

    def clock(self, term: PoseTerm, sensor: str, time: Array) -> Array:
        """Return the stamps less the offset."""
        return time - term.theta[0] if term.acts_on(sensor) else time

    def record(self, term: PoseTerm, covariance: Array) -> EffectRecord:
        """Record the offset, and the sensor where it is one sensor's."""
        values = {**term.site, 'offset_s': float(term.theta[0])}
        return EffectRecord(self.name, values, {'offset_s': float(sigmas(covariance)[0])})

    def term(self, record: EffectRecord) -> PoseTerm:
        """Read the offset, s, from a record."""
        sensor = record.parameters.get('sensor')
        site: PoseSite = {} if sensor is None else {'sensor': str(sensor)}
        return PoseTerm(self, site, np.array([float(needed(record, 'offset_s'))]))


class PoseClockRate(PoseEffect):
    """Theta is the rate, 1e-3, by which the tracked clock gains on the optical one."""

    name = 'clock_rate'
    summary = 'the clocks of tracker and reference run apart'
    advice = (
        'Stamp both streams by one clock; the corrector removes it within this recording alone.'
    )
    units: ClassVar[Mapping[str, str]] = {'rate_ppm': '1e-6'}
    plausible: ClassVar[Mapping[str, tuple[float, float]]] = {'rate_ppm': (-3e3, 3e3)}
    remedy = Remedy.OPTICAL
    role = Role.RATE

    def sites(self, setting: PoseSetting) -> Sequence[PoseTerm]:
        """Return one term, as one rate holds for all sensors."""
        middle = setting.start + 0.5 * setting.duration
        return [PoseTerm(self, {'middle_s': middle}, np.zeros(1))]

    def prior(self, term: PoseTerm) -> Array:
        """Expect rates that err by some parts in a thousand."""
        return np.full(1, 2.0)

    def slopes(self, term: PoseTerm, view: PoseView) -> Array | None:
        """Return minus the velocity, the more the farther from the session's middle."""
        apart = 1e-3 * (view.time - term.site['middle_s']) / (1 + 1e-3 * term.theta[0]) ** 2
        return np.asarray(-(view.velocity * apart[:, None])[:, :, None])

    def clock(self, term: PoseTerm, sensor: str, time: Array) -> Array:
        """Return the stamps, s, without what their clock gains: a rate of r makes times 1 + r."""
        middle = term.site['middle_s']
        return np.asarray(middle + (time - middle) / (1 + 1e-3 * term.theta[0]))

    def record(self, term: PoseTerm, covariance: Array) -> EffectRecord:
        """Record the rate, and the time at which the offset is the offset."""
        sigma = 1e3 * float(sigmas(covariance)[0])
        values = {'rate_ppm': 1e3 * float(term.theta[0]), 'middle_s': term.site['middle_s']}
        return EffectRecord(self.name, values, {'rate_ppm': sigma})

    def term(self, record: EffectRecord) -> PoseTerm:
        """Read the clock's rate, ppm, from a record."""
        rate = 1e-3 * float(needed(record, 'rate_ppm'))
        return PoseTerm(self, {'middle_s': float(needed(record, 'middle_s'))}, np.array([rate]))


EFFECTS = (PoseTimeOffset(), PoseClockRate())
