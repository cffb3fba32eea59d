"""Holds a window's fluxes, and the queue in which frames wait until their stamps are good."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.signals.clock import SampleClock
from anser_ros.signals.flux import FluxWindow
from anser_ros.wire.points import FluxPoints

PATIENCE_NS = 300_000_000
"""Host time (0.3 s) that a frame waits for an arrival that confirms its stamp. Stalls of the host
are shorter, and a new line settles in less; a pose that is older is of little use."""


@dataclass(frozen=True)
class Staleness:
    """Says why sensors are stale; each array has a place for each of them, shape (S,).

    Attributes
    ----------
    age_s : how long before a sensor said the same, s; 0 where what it says is new or constant
    noiseless : whether it holds too little noise to distinguish new from old
    """

    age_s: NDArray[np.float64]
    noiseless: NDArray[np.bool_]

    def __or__(self, later: Staleness) -> Staleness:
        """What holds of one or the other; of two ages that of the later counts."""
        age_s = np.where(later.age_s > 0, later.age_s, self.age_s)
        return Staleness(age_s, self.noiseless | later.noiseless)


@dataclass(frozen=True)
class FluxFrame:
    """Holds the fluxes of one window.

    Attributes
    ----------
    tool, reference : points of the two topics
    host_ns : middle of the window in the clock of the arrivals; 0 until it is known
    window : conversion with noise and currents, sensors in the order of `FluxStream.sensors`
    flags : flag bits of these sensors
    staleness : why some of them are stale
    repeats : whether the whole control unit says nothing new
    """

    tool: FluxPoints
    reference: FluxPoints
    host_ns: int
    window: FluxWindow
    flags: NDArray[np.int64]
    staleness: Staleness
    repeats: bool = False


@dataclass(frozen=True)
class _Waiting:
    """A frame, its middle and end in samples, and when its last block arrived."""

    frame: FluxFrame
    middle_sample: float
    end_sample: float
    arrival_ns: int


class WaitingFrames:
    """Holds frames until a block that was in time has confirmed their stamps.

    On a punctual line no frame waits. A frame that nothing confirms for `PATIENCE_NS` is withheld.

    ``withheld`` counts these.
    """

    def __init__(self, clock: SampleClock) -> None:
        self._clock = clock
        self._queue: deque[_Waiting] = deque()
        self.withheld = 0

    def __len__(self) -> int:
        """Return how many frames wait."""
        return len(self._queue)

    def add(
        self, frame: FluxFrame, middle_sample: float, end_sample: float, arrival_ns: int
    ) -> None:
        """Let a frame wait from the arrival of its last block on."""
        self._queue.append(_Waiting(frame, middle_sample, end_sample, arrival_ns))

    def release(self, now_ns: int) -> list[FluxFrame]:
        """Return the frames that need not wait any longer, stamped."""
        clock, frames = self._clock, []
        while self._queue:
            first = self._queue[0]
            # What repeats itself is marked so; its stamp need not be better than the line is.
            is_good = clock.is_good(first.end_sample) or (first.frame.repeats and clock.is_settled)
            if not is_good and now_ns - first.arrival_ns < PATIENCE_NS:
                break
            self._queue.popleft()
            if is_good:
                host_ns = clock.host_ns(first.middle_sample)
                frames.append(replace(first.frame, host_ns=host_ns))
            else:
                self.withheld += 1
        return frames

    def forget(self) -> None:
        """Withhold all that wait: their samples belong to a stream that has ended."""
        self.withheld += len(self._queue)
        self._queue.clear()
