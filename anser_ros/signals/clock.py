"""The map from the device's clock to the host's, by the records that arrive earliest."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from itertools import pairwise

FOLLOWED_SHARE = 1e-4
"""Largest relative rate difference at which a device clock is followed. Two quartz clocks differ
by less; a larger value would follow slow changes of the host's load."""
_JUMP_NS = 1_000_000_000
"""A difference between device and host time beyond this (1 s) is no delay of the line."""
_STALL_NS = 3_000_000_000
"""Time (3 s) that all arrivals must be later than `_JUMP_NS` before the clock counts as changed;
a host that stalls catches up within it."""
_STRETCH_NS = 500_000_000
"""Length (0.5 s) of a stretch of which only the earliest arrival is kept. Shorter stretches keep
more late arrivals, longer ones give the line fewer points."""
_MEMORY = 120
"""Stretches whose earliest arrivals are kept, together a minute. A longer memory makes the rate
more certain and follows its changes with temperature more slowly."""
_FEWEST = 6
"""Stretches from which on the rate is estimated: with fewer, delays look like a rate."""
_TYPICAL_SHARE = 3e-5
"""Standard deviation of the relative rate difference of two quartz clocks, a prior of the rate."""


class DeviceClock:
    """Converts timestamps of the device to host time.

    Every record arrives late by an unknown delay that is never negative. Arrival minus device time
    therefore lies above a line whose slope is the difference of the two clocks' rates, and touches
    it where a record arrived without delay. The line is estimated by the edge, around the middle
    of the last minute, of the lower convex hull of the earliest arrivals (Moon, Skelly and
    Towsley, "Estimation and removal of clock skew from network delay measurements", INFOCOM 1999).
    A busy host on which nothing arrives early for a while thus does not move the stamps. At first
    the line rises by `FOLLOWED_SHARE`; a slope that is still uncertain is shrunk towards zero.

    Parameters
    ----------
    tick_hz : float
        Rate of the device's timestamp counter, Hz.
    """

    def __init__(self, tick_hz: float) -> None:
        self._ns_per_tick = 1e9 / tick_hz
        self._offset_ns: float | None = None
        self._slope = FOLLOWED_SHARE
        self._last_device_ns = 0.0
        self._late_from_ns: float | None = None
        self._earliest: deque[tuple[float, float]] = deque(maxlen=_MEMORY)
        self._stretch_end_ns = 0.0
        self.jumps = 0

    def observe(self, ticks: float, arrival_ns: int) -> None:
        """Take in the arrival of a record with a device timestamp.

        A device time that runs backwards, or jumps ahead of the host's by more than a second,
        starts the estimate anew. If it falls behind by a second, the host may have stalled; only
        when that lasts for three seconds does the clock count as changed.

        Parameters
        ----------
        ticks : float
            Device time, already past at the arrival, in ticks of its counter.
        arrival_ns : int
            Host time of the arrival, ns.
        """
        device_ns = ticks * self._ns_per_tick
        offset = arrival_ns - device_ns
        if self._offset_ns is None:
            self._begin(device_ns, offset)
            return
        elapsed = device_ns - self._last_device_ns
        risen = self._offset_ns + self._slope * max(elapsed, 0.0)
        if elapsed < 0 or risen - offset > _JUMP_NS or self._is_behind(offset - risen, device_ns):
            self.jumps += 1
            self._begin(device_ns, offset)
            return
        self._remember(device_ns, offset)
        self._offset_ns = min(offset, risen)
        self._last_device_ns = device_ns
        if device_ns >= self._stretch_end_ns:
            self._draw(device_ns)

    def _begin(self, device_ns: float, offset_ns: float) -> None:
        """Start the estimate anew with a first arrival."""
        self._late_from_ns = None
        self._slope = FOLLOWED_SHARE
        self._offset_ns, self._last_device_ns = offset_ns, device_ns
        self._earliest.clear()
        self._earliest.append((device_ns, offset_ns))
        self._stretch_end_ns = device_ns + _STRETCH_NS

    def _remember(self, device_ns: float, offset_ns: float) -> None:
        """Keep an arrival as the earliest one of the present stretch if it is."""
        before = self._earliest[-1]
        if offset_ns - before[1] < self._slope * (device_ns - before[0]):
            self._earliest[-1] = (device_ns, offset_ns)

    def _draw(self, device_ns: float) -> None:
        """Draw the line anew at the end of a stretch, and begin another one."""
        if len(self._earliest) >= _FEWEST:
            self._slope = _slope_below(self._earliest)
        self._offset_ns = min(o + self._slope * (device_ns - d) for d, o in self._earliest)
        # Nothing has come in the new stretch yet: any arrival is earlier than none.
        self._earliest.append((device_ns, float('inf')))
        self._stretch_end_ns = device_ns + _STRETCH_NS

    def _is_behind(self, late_ns: float, device_ns: float) -> bool:
        """Whether all arrivals for long have been so late that the clock must have changed."""
        if late_ns <= _JUMP_NS:
            self._late_from_ns = None
        elif self._late_from_ns is None:
            self._late_from_ns = device_ns
        return self._late_from_ns is not None and device_ns - self._late_from_ns > _STALL_NS

    def host_ns(self, ticks: float) -> int:
        """Return the host time (ns) of device time `ticks`; 0 before the first arrival."""
        if self._offset_ns is None:
            return 0
        return round(ticks * self._ns_per_tick + self._offset_ns)


def _slope_below(points: Sequence[tuple[float, float]]) -> float:
    """Return the most probable slope of the line below points, with `_TYPICAL_SHARE` as prior.

    Two points determine a line; the distances of the next ones above it tell how certain it is.
    """
    slope = _hull_slope(points)
    above = sorted(y - slope * x for x, y in points)
    sigma = 2.0 * (above[3] - above[0]) / (points[-1][0] - points[0][0])
    shrunk = slope / (1.0 + (sigma / _TYPICAL_SHARE) ** 2)
    return min(max(shrunk, -FOLLOWED_SHARE), FOLLOWED_SHARE)


def _hull_slope(points: Sequence[tuple[float, float]]) -> float:
    """Return the slope of the lower convex hull's edge at the middle of the abscissae."""
    hull: list[tuple[float, float]] = []
    for x, y in points:
        while len(hull) > 1:
            (x0, y0), (x1, y1) = hull[-2:]
            if (y1 - y0) * (x - x0) < (y - y0) * (x1 - x0):
                break
            hull.pop()
        hull.append((x, y))
    middle = 0.5 * (points[0][0] + points[-1][0])
    for (x0, y0), (x1, y1) in pairwise(hull):
        if x1 >= middle:
            return (y1 - y0) / (x1 - x0)
    return 0.0
