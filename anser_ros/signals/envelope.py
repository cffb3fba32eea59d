"""Fits the line below a cloud of arrivals, whose delays are unknown and never negative."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from itertools import pairwise

FOLLOWED_SHARE = 1e-4
"""Largest relative rate difference at which a device's clock is followed. Two quartz clocks differ
by less; a larger value would follow slow changes of the host's load."""
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


class Envelope:
    """Describes the line below the offsets of arrivals, over the device's time.

    Every record arrives late by an unknown delay that is never negative. Arrival minus device time
    therefore lies above a line whose slope is the difference of the two clocks' rates, and touches
    it where a record arrived without delay. The line is estimated by the edge, around the middle
    of the last minute, of the lower convex hull of the earliest arrivals (Moon, Skelly and
    Towsley, "Estimation and removal of clock skew from network delay measurements", INFOCOM 1999).
    A busy host on which nothing arrives early for a while thus does not move it. At first the line
    is level; a slope that is still uncertain is shrunk towards zero.

    Parameters
    ----------
    time_ns, offset_ns : float
        Device time of a first record, and how much later it arrived, ns.

    Attributes
    ----------
    newest_ns : float
        Device time of the newest record, ns.
    """

    def __init__(self, time_ns: float, offset_ns: float) -> None:
        self._slope = 0.0
        self._offset_ns, self.newest_ns = offset_ns, time_ns
        self._earliest: deque[tuple[float, float]] = deque([(time_ns, offset_ns)], maxlen=_MEMORY)
        self._stretch_end_ns = time_ns + _STRETCH_NS

    def offset_at(self, time_ns: float) -> float:
        """Return how much later than a device time the host's clock reads, ns."""
        return self._offset_ns + self._slope * (time_ns - self.newest_ns)

    def take(self, time_ns: float, offset_ns: float) -> None:
        """Take a record that is not older than the newest one."""
        before = self._earliest[-1]
        if offset_ns - before[1] < self._slope * (time_ns - before[0]):
            self._earliest[-1] = time_ns, offset_ns
        self._offset_ns = min(offset_ns, self.offset_at(time_ns))
        self.newest_ns = time_ns
        if time_ns >= self._stretch_end_ns:
            self._draw(time_ns)

    def _draw(self, time_ns: float) -> None:
        """Draw the line again at the end of a stretch, and begin another one."""
        if len(self._earliest) >= _FEWEST:
            self._slope = _slope_below(self._earliest)
        self._offset_ns = min(o + self._slope * (time_ns - d) for d, o in self._earliest)
        # Nothing has come in the new stretch yet: any arrival is earlier than none.
        self._earliest.append((time_ns, float('inf')))
        self._stretch_end_ns = time_ns + _STRETCH_NS


def _slope_below(points: Sequence[tuple[float, float]]) -> float:
    """Return the most probable slope of the line below points, with `_TYPICAL_SHARE` as prior.

    Two points determine a line; the distances of the next ones above it show how certain it is.
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
