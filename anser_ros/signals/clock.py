"""Maps a device's samples to the host's time, by the records that arrive earliest."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from enum import Enum
from itertools import pairwise

FOLLOWED_SHARE = 1e-4
"""Largest relative difference of rates that is followed: two quartz clocks differ by less."""
_STRETCH_NS = 500_000_000
"""Length (0.5 s) of a stretch of which only the earliest arrival is kept."""
_MEMORY = 120
"""Stretches whose earliest arrivals are kept, together a minute: rates change with temperature."""
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

    ``newest_ns`` is the device time of the newest record, ns, at first that of the record with
    which it was made.
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
    """Return the most probable slope of the line below points, with `_TYPICAL_SHARE` as prior."""
    # Two points determine a line; how far the next ones are above it shows how certain it is.
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


LARGEST_LATENESS_S = 4e-3
"""Lateness, s, up to which an arrival confirms the line; one that is so much too early refutes it.
It is the 5 ms that a stamp may be wrong by, less what the line itself is uncertain by."""
_SETTLE_NS = 200_000_000
"""Time (0.2 s) that a new line must stand: bytes that had piled up push it down meanwhile."""
_SETTLE_UNPROVEN_NS = 3_000_000_000
"""The same (3 s) where answers bound it loosely or are awaited: a late line's answers are late."""
_REFUTED_NS = 1_000_000.0
"""By how much (1 ms) an answer must show a line to be too early to refute it."""
_SETTLED_NS = 1_000_000.0
"""Fall of a new line (1 ms) that begins the time again; less is how arrivals scatter."""
_ANSWER_S = 0.15
"""Longest time, s, that an answer may take to bound nothing: the device has 100 ms for it."""
_ANSWER_HOLDS_NS = 60e9
"""Device time (60 s) after which two clocks may have drifted apart by more than an answer says."""
_FALSE_ANSWERS = 3
"""Answers contradicted by arrivals after which none is asked for: the device answers too early."""
_DOUBT_NS = 30_000_000
"""Time (30 ms) of blocks without a confirmation from which on the device is asked."""
_GIVE_UP_NS = 10_000_000_000
"""Time (10 s) of unchanged lateness after which a silent device is believed to have lost time."""
_BUCKET_NS = 50_000_000
"""Time (50 ms) of arrivals of which the earliest one tells how well the line is confirmed."""
_BUCKETS = 10
"""Such times that are looked back on, without those in which nothing arrives."""
_FLOOR_S = 1e-4
"""Least uncertainty of a stamp, s: what reading a byte and taking the time cost."""


class ClockState(Enum):
    """Names what is known of the stamps; the value is the word for an operator."""

    SETTLING = 'settling'
    GOOD = 'ok'
    LATE = 'late'


class SampleClock:
    """Converts sample numbers of a stream to host time.

    Samples come from one oscillator, so between a sample's number and the host's time lies a
    straight line: its slope is within 100 ppm of the nominal one, and no arrival lies below it. It
    is estimated by `Envelope`. Each arrival is checked for what would contradict it:

    - one that comes earlier than it could refutes the line, and a new one begins;
    - while all arrivals come later than `LARGEST_LATENESS_S`, either the line to the host is late
      or the device lost time. No stamp is good then, until an arrival is in time again, or an
      answer of the device (`bound`) shows which of the two it is.

    ``jumps`` counts how often the line was started again because it was refuted; ``is_settled`` is
    whether it is relied on, however late the newest arrivals are; ``confirmed`` is the number of
    the newest sample that an arrival in time, or an answer, has confirmed (-inf before).
    """

    def __init__(self, sample_rate_hz: float) -> None:
        self._ns_per_sample = 1e9 / sample_rate_hz
        self.jumps = 0
        self._answers = False
        self.restart()

    def restart(self) -> None:
        """Begin a new stream of samples, with numbers that have nothing to do with the last."""
        self._lower: tuple[float, float] | None = None
        self._false_answers = 0
        self._quickest_ns = math.inf
        self._begin_anew()

    def _begin_anew(self) -> None:
        self._line: Envelope | None = None
        self.confirmed = -math.inf
        self.is_settled = False
        self._stands: tuple[int, float] = (0, 0.0)
        self._earliest: deque[tuple[int, float]] = deque(maxlen=_BUCKETS)
        self._late_from_ns: int | None = None
        self._newest_ns = 0
        self._newest_offset = self._newest_sample = 0.0
        self._unexplained_from_ns = 0

    def observe(self, sample: float, arrival_ns: int) -> None:
        """Take in the arrival of a block, host time, ns, monotonic.

        ``sample`` is the number of the sample behind the block's last one.
        """
        time_ns = sample * self._ns_per_sample
        offset = arrival_ns - time_ns
        late = 0.0 if self._line is None else offset - self._line.offset_at(time_ns)
        if self._line is not None and (
            time_ns < self._line.newest_ns
            or (self.is_settled and late < -1e9 * LARGEST_LATENESS_S)
        ):
            self.jumps += 1
            self._begin_anew()
            late = 0.0
        if self._line is None:
            self._line = Envelope(time_ns, offset)
            self._stands = arrival_ns, offset
        self._newest_ns, self._newest_offset = arrival_ns, offset
        self._newest_sample = sample
        self._contradict(time_ns, offset)
        self._note_lateness(late, arrival_ns)
        if late > 1e9 * LARGEST_LATENESS_S and self.is_settled:
            self._doubt(arrival_ns)
            return
        self._late_from_ns = None
        self._line.take(time_ns, offset)
        self.confirmed = sample
        if not self.is_settled:
            self._settle(time_ns, arrival_ns)

    def bound(self, sample: float, sent_ns: int) -> None:
        """Take in that a sample was not yet taken when a command was sent that is now answered.

        The answer takes the same way as the samples: if they come late because the line is late,
        so does the answer; if the device lost time, the answer is quick. The device took the
        ``sample`` after it had answered; the command left after ``sent_ns``, host time, ns,
        monotonic.
        """
        if self._false_answers >= _FALSE_ANSWERS:
            return
        self._answers = True
        time_ns = sample * self._ns_per_sample
        lower, known = sent_ns - time_ns, self._lower_offset(time_ns)
        if known is None or lower > known:
            self._lower = time_ns, lower
        if self._line is None:
            return
        # The answer came with the newest block, and took as long as that is above the bound.
        took_ns = self._newest_offset - lower
        self._quickest_ns = min(self._quickest_ns, took_ns)
        if took_ns > 1e9 * _ANSWER_S:
            self._unexplained_from_ns = self._newest_ns
        is_refuted = lower > self._line.offset_at(time_ns) + _REFUTED_NS
        if is_refuted and (self.is_doubted or not self.is_settled):
            self.jumps += self.is_settled
            self._begin_anew()
        elif is_refuted:
            return
        elif not self.is_settled:
            self._settle(time_ns, self._newest_ns)
        elif self._quickest_ns < 1e9 * LARGEST_LATENESS_S:
            self.confirmed = self._newest_sample

    def _lower_offset(self, time_ns: float) -> float | None:
        """Least offset, ns, that the line can have at a time, by the last answer."""
        if self._lower is None:
            return None
        at, lower = self._lower
        if abs(time_ns - at) > _ANSWER_HOLDS_NS:
            return None
        return lower - FOLLOWED_SHARE * abs(time_ns - at)

    def _contradict(self, time_ns: float, offset: float) -> None:
        """Drop an answer that an arrival shows to be false: it is earlier than it could be."""
        lower = self._lower_offset(time_ns)
        if lower is not None and offset < lower - _SETTLED_NS:
            self._lower = None
            self._false_answers += 1

    def _settle(self, time_ns: float, arrival_ns: int) -> None:
        """See whether a new line can be relied on."""
        assert self._line is not None
        offset, lower = self._line.offset_at(time_ns), self._lower_offset(time_ns)
        # How far the line lies above the least that it can be, ns; None without an answer.
        slack = None if lower is None else offset - lower
        since, stood = self._stands
        if offset < stood - _SETTLED_NS:
            self._stands = since, stood = arrival_ns, offset
        if slack is None:
            awaited = self._answers and self._false_answers < _FALSE_ANSWERS
            self.is_settled = arrival_ns - since > (_SETTLE_UNPROVEN_NS if awaited else _SETTLE_NS)
        elif slack < 1e9 * LARGEST_LATENESS_S:
            self.is_settled = True
        elif slack > 1e9 * _ANSWER_S or max(late for _, late in self._earliest) > _SETTLED_NS:
            self._stands = arrival_ns, offset
        else:
            self.is_settled = arrival_ns - since > _SETTLE_UNPROVEN_NS

    def _doubt(self, arrival_ns: int) -> None:
        """Note an arrival that is late."""
        if self._late_from_ns is None:
            self._late_from_ns = arrival_ns
            self._unexplained_from_ns = arrival_ns
        elif arrival_ns - self._unexplained_from_ns > _GIVE_UP_NS:
            self.jumps += 1
            self._begin_anew()

    def _note_lateness(self, late_ns: float, arrival_ns: int) -> None:
        recent = self._earliest
        if recent and arrival_ns - recent[-1][0] < _BUCKET_NS:
            recent[-1] = recent[-1][0], min(recent[-1][1], late_ns)
        else:
            recent.append((arrival_ns, late_ns))

    @property
    def wants_answer(self) -> bool:
        """Return whether an answer of the device would help: the line is new, or late for long."""
        if self._line is None or self._false_answers >= _FALSE_ANSWERS:
            return False
        return not self.is_settled or self.is_doubted

    @property
    def is_doubted(self) -> bool:
        """Return whether all blocks have been late for longer than a host's stall explains."""
        late_from = self._late_from_ns
        return late_from is not None and self._newest_ns - late_from > _DOUBT_NS

    @property
    def state(self) -> ClockState:
        """Return what is known of the stamps now."""
        if not self.is_settled:
            return ClockState.SETTLING
        return ClockState.LATE if self._late_from_ns is not None else ClockState.GOOD

    @property
    def lateness_s(self) -> float:
        """Return by how much the earliest of the recent arrivals was late, s."""
        return max(min((late for _, late in self._earliest), default=0.0), 0.0) / 1e9

    @property
    def sigma_s(self) -> float:
        """Return the standard deviation of a confirmed stamp, s; infinite while the line is not
        settled.
        """
        if not self.is_settled:
            return math.inf
        return math.hypot(_FLOOR_S, min(self.lateness_s, LARGEST_LATENESS_S))

    def is_good(self, sample: float) -> bool:
        """Return whether the host time of a sample is known to 5 ms."""
        return self.is_settled and self.confirmed >= sample

    def host_ns(self, sample: float) -> int:
        """Return the host time (ns) of a sample's number; 0 before the first arrival."""
        if self._line is None:
            return 0
        time_ns = sample * self._ns_per_sample
        return round(time_ns + self._line.offset_at(time_ns))
