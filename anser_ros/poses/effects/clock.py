"""The clocks of the tracker and of the optical reference differ by an offset and a rate."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.effect import Remedy, needed, sigmas
from anser_ros.effects.term import Site, Term
from anser_ros.field.model import EffectRecord
from anser_ros.poses.effect import PoseEffect, PoseSetting, PoseView, Role

Array = NDArray[np.float64]

AGREE_S = 3.0
"""Time about a session's start or middle, s, at which clocks count as agreeing: programs set
clocks when they start, and a rate by regression is about the middle. Smaller gives a clock that
was set late in starting an offset as well; larger hides offsets in the rate."""


class PoseTimeOffset(PoseEffect):
    """Applies the optical pose stamped t - theta at stamp t of a tracked pose, s."""

    name = 'time_offset'
    summary = 'the tracked stamps are late (positive) or early by the optical clock'
    advice = 'Correct the stamps by it; both streams stamped by one clock do not have it.'
    units: ClassVar[Mapping[str, str]] = {'offset_s': 's'}
    plausible: ClassVar[Mapping[str, tuple[float, float]]] = {'offset_s': (-5.0, 5.0)}
    remedy = Remedy.OPTICAL
    role = Role.CLOCK

    def sites(self, setting: PoseSetting) -> Sequence[Term]:
        """Try one offset for all sensors, and one per sensor."""
        own = [Term(self, {'sensor': s}, np.zeros(1)) for s in setting.sensors]
        return [Term(self, {}, np.zeros(1)), *(own if len(own) > 1 else [])]

    def prior(self, term: Term) -> Array:
        """Return a prior spread of 0.3 s: offsets are some tenths of a second."""
        return np.full(1, 0.3)

    def slopes(self, term: Term, view: PoseView) -> Array | None:
        """Return minus the velocity of the predicted pose, or None for other sensors."""
        return -view.velocity[:, :, None] if self.acts_on(term, view.sensor) else None

    def clock(self, term: Term, sensor: str, time: Array) -> Array:
        """Return the stamps less the offset."""
        return time - term.theta[0] if self.acts_on(term, sensor) else time

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        """Record the offset, and the sensor where it is one sensor's."""
        values = {**term.site, 'offset_s': float(term.theta[0])}
        return EffectRecord(self.name, values, {'offset_s': float(sigmas(covariance)[0])})

    def term(self, record: EffectRecord) -> Term:
        """Read the offset, s, from a record."""
        sensor = record.parameters.get('sensor')
        site: Site = {} if sensor is None else {'sensor': str(sensor)}
        return Term(self, site, np.array([float(needed(record, 'offset_s'))]))


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
    role = Role.CLOCK

    def sites(self, setting: PoseSetting) -> Sequence[Term]:
        """Return one term, as one rate holds for all sensors."""
        middle = setting.start + 0.5 * setting.duration
        return [Term(self, {'middle_s': middle}, np.zeros(1))]

    def prior(self, term: Term) -> Array:
        """Expect rates that err by some parts in a thousand."""
        return np.full(1, 2.0)

    def slopes(self, term: Term, view: PoseView) -> Array | None:
        """Return minus the velocity, the more the farther from the session's middle."""
        apart = 1e-3 * (view.time - term.site['middle_s']) / (1 + 1e-3 * term.theta[0]) ** 2
        return np.asarray(-(view.velocity * apart[:, None])[:, :, None])

    def clock(self, term: Term, sensor: str, time: Array) -> Array:
        """Return the stamps, s, without what their clock gains: a rate of r makes times 1 + r."""
        middle = term.site['middle_s']
        return np.asarray(middle + (time - middle) / (1 + 1e-3 * term.theta[0]))

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        """Record the rate, and the time at which the offset is the offset."""
        sigma = 1e3 * float(sigmas(covariance)[0])
        values = {'rate_ppm': 1e3 * float(term.theta[0]), 'middle_s': term.site['middle_s']}
        return EffectRecord(self.name, values, {'rate_ppm': sigma})

    def term(self, record: EffectRecord) -> Term:
        """Read the clock's rate, ppm, from a record."""
        rate = 1e-3 * float(needed(record, 'rate_ppm'))
        return Term(self, {'middle_s': float(needed(record, 'middle_s'))}, np.array([rate]))


class PoseClock:
    """Knows how late a tracker's stamps are by the records of its clock.

    Parameters
    ----------
    records : sequence of EffectRecord
        Those of the clock are used.
    support : mapping
        ``first_ns`` and ``last_ns``, the stamps between which a rate was learnt. Beyond them the
        offset stays as it is at the nearer one, because nobody knows whether a clock was set
        since.
    """

    def __init__(self, records: Sequence[EffectRecord], support: Mapping[str, Any]) -> None:
        offsets = [r for r in records if r.name == PoseTimeOffset.name]
        rate = next((r for r in records if r.name == PoseClockRate.name), None)
        self._own = {
            r.parameters['sensor']: _offset(r) for r in offsets if 'sensor' in r.parameters
        }
        # The record of a rate has the offset of all sensors with it, or instead.
        shared = [r for r in offsets if 'sensor' not in r.parameters] if rate is None else [rate]
        self._shared = sum(map(_offset, shared))
        self._gain, self._first, self._last = 0.0, 0, 0
        if rate is not None and 'first_ns' in support:
            gain = 1e-6 * float(needed(rate, 'rate_ppm'))
            self._gain = gain / (1 + gain)
            self._first, self._last = int(support['first_ns']), int(support['last_ns'])

    def late_ns(self, sensor: str, stamp_ns: int) -> int:
        """Return by how much a sensor's stamp is late on the reference's clock, ns."""
        since = min(max(stamp_ns, self._first), self._last) - (self._first + self._last) // 2
        late = self._shared + self._own.get(sensor, 0.0)
        return round(1e9 * late + self._gain * since)


def _offset(record: EffectRecord) -> float:
    return float(needed(record, 'offset_s'))


def one_clock(records: Sequence[EffectRecord], duration: float) -> list[EffectRecord]:
    """Return the records with one for the clock: a rate takes the offset of all sensors with it.

    Clocks that agree about the start or the middle of a session of ``duration`` s have a rate and
    no offset besides.
    """
    offset = next(
        (r for r in records if r.name == PoseTimeOffset.name and 'sensor' not in r.parameters),
        None,
    )
    rate = next((r for r in records if r.name == PoseClockRate.name), None)
    if rate is None:
        return list(records)
    value = 0.0 if offset is None else float(offset.parameters['offset_s'])
    gained = 1e-6 * float(rate.parameters['rate_ppm'])
    # The offset is that at the middle, half a session after the start.
    apart = min(abs(value), abs(value - 0.5 * gained * duration))
    whole = replace(rate, parameters={**rate.parameters, 'offset_s': value})
    kept = [whole if r is rate else r for r in records]
    return [r for r in kept if r is not offset or apart > abs(gained) * AGREE_S]


EFFECTS = (PoseTimeOffset(), PoseClockRate())
