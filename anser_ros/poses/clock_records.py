"""Knows what the records of a diagnosis say of a tracker's clock."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from anser_ros.effects.effect import needed
from anser_ros.field.model import EffectRecord
from anser_ros.poses.effect import Role
from anser_ros.poses.registry import effect_of_record

AGREE_S = 3.0
"""Time about a session's start or middle, s, at which clocks count as agreeing: programs set
clocks when they start, and a rate by regression is about the middle."""


class PoseClock:
    """Knows how late a tracker's stamps are by the records of its clock.

    ``records``: those of the clock are used; ``support``: ``first_ns`` and ``last_ns``, the stamps
    between which a rate was learnt. Beyond them the offset stays as it is at the nearer one,
    because nobody knows whether a clock was set since.
    """

    def __init__(self, records: Sequence[EffectRecord], support: Mapping[str, Any]) -> None:
        offsets = [r for r in records if _is(r, Role.OFFSET)]
        rate = next((r for r in records if _is(r, Role.RATE)), None)
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
        (r for r in records if _is(r, Role.OFFSET) and 'sensor' not in r.parameters),
        None,
    )
    rate = next((r for r in records if _is(r, Role.RATE)), None)
    if rate is None:
        return list(records)
    value = 0.0 if offset is None else float(offset.parameters['offset_s'])
    gained = 1e-6 * float(rate.parameters['rate_ppm'])
    # The offset is that at the middle, half a session after the start.
    apart = min(abs(value), abs(value - 0.5 * gained * duration))
    whole = replace(rate, parameters={**rate.parameters, 'offset_s': value})
    kept = [whole if r is rate else r for r in records]
    return [r for r in kept if r is not offset or apart > abs(gained) * AGREE_S]


def _is(record: EffectRecord, role: Role) -> bool:
    return effect_of_record(record).role is role
