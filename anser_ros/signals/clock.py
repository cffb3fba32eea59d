"""Maps the device's clock to the host's by the earliest arrivals."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from itertools import pairwise

FOLLOWED_SHARE = 1e-4
"""More than two quartz clocks drift apart: how fast a device clock is followed at most."""
_JUMP_NS = 1_000_000_000
_STALL_NS = 3_000_000_000
_STRETCH_NS = 500_000_000
_MEMORY = 120
"""Stretches of time whose earliest arrivals are remembered: a minute."""
_FEWEST = 6
_TYPICAL_SHARE = 3e-5
"""What two quartz clocks differ by, as a standard deviation."""


class DeviceClock:
    """Host time of device timestamps.

    Every arrival is late by an unknown delay that is never negative. So arrival minus device time
    lies above a line, whose slope is the difference of the two clocks' rates, and touches it where
    something came without delay: the line is the edge, around the middle of the last minute, of
    the lower hull of the earliest arrivals (Moon, Skelly and Towsley, "Estimation and removal of
    clock skew from network delay measurements", INFOCOM 1999). A busy host on which nothing comes
    early for a while does not move the stamps. At first the line rises by `FOLLOWED_SHARE`; a
    slope that is not certain yet is drawn towards that of clocks that agree.

    Parameters
    ----------
    tick_hz : rate of the device's timestamp counter
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
        """Note that device time `ticks` was already past at host time `arrival_ns`.

        Device time that runs backwards, or leaps ahead of the host's by more than a second, starts
        the estimate anew. One that is a second behind may be a host that stalled: only when that
        lasts for three seconds has the clock changed.
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
        """Start anew with a first arrival."""
        self._late_from_ns = None
        self._slope = FOLLOWED_SHARE
        self._offset_ns, self._last_device_ns = offset_ns, device_ns
        self._earliest.clear()
        self._earliest.append((device_ns, offset_ns))
        self._stretch_end_ns = device_ns + _STRETCH_NS

    def _remember(self, device_ns: float, offset_ns: float) -> None:
        """Keep the earliest arrival of this stretch: the last one that is remembered."""
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
        """Host time at device time `ticks`, in the clock of the arrivals; 0 before the first."""
        if self._offset_ns is None:
            return 0
        return round(ticks * self._ns_per_tick + self._offset_ns)


def _slope_below(points: Sequence[tuple[float, float]]) -> float:
    """Most probable slope of the line below points, given what clocks differ by.

    Two points fix a line; how far the next ones lie above it tells how far it can be trusted.
    """
    slope = _hull_slope(points)
    above = sorted(y - slope * x for x, y in points)
    sigma = 2.0 * (above[3] - above[0]) / (points[-1][0] - points[0][0])
    shrunk = slope / (1.0 + (sigma / _TYPICAL_SHARE) ** 2)
    return min(max(shrunk, -FOLLOWED_SHARE), FOLLOWED_SHARE)


def _hull_slope(points: Sequence[tuple[float, float]]) -> float:
    """Slope of the lower convex hull's edge above the middle of the abscissae, in their order."""
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
