"""Cuts overlapping windows from a stream of sample blocks, with the samples that they miss.

The device's ticks and its samples share a clock and must advance together; ticks confirm how many
blocks were lost.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.arrays import Booleans, Integers
from anser_ros.errors import ParameterError
from anser_ros.signals.repetition import RAILS, RepetitionWatch

_SLACK_SAMPLES = 2.0
"""Difference, samples, that rounding of ticks may make."""
_SLACK_SHARE = 5e-4
"""Relative difference up to which ticks and samples run at one pace; quartzes differ less."""
_REFERENCE_S = 1.0
"""Time, s, over which the two are compared."""
_TRUST_S = 0.2
"""Time, s, that ticks must agree before they are believed again about lost blocks."""
_AGAIN_S = 0.1
"""Disagreements closer together than this, s, are a wrong pace, others are jumps."""
_HOLE_TOLERANCE = 0.01
"""Relative difference up to which a hole's length by ticks and by sequence number agree."""
_LONGEST_HOLE_S = 10.0
"""Longest hole, s, that the sequence number alone may tell of while ticks are not believed."""
_WRAP = 2**32
"""Ticks after which a 32-bit counter begins again."""


class TickCheck:
    """Compares the advance of ticks with that of samples while no block is missing.

    The stamps follow from the samples; ticks only confirm how many blocks were lost.

    ``trusted`` is whether ticks may confirm the length of a hole, ``words`` what is wrong with
    them (empty while nothing is), and ``disagreements`` how often ticks that had agreed did not.
    """

    def __init__(self, sample_rate_hz: float, tick_hz: float) -> None:
        self._rate_hz, self._per_tick = sample_rate_hz, sample_rate_hz / tick_hz
        self.disagreements = 0
        self.reset()

    def reset(self) -> None:
        """Begin a new stream."""
        self.trusted, self.words = True, ''
        self._reference: tuple[int, int] | None = None
        self._last_ticks = 0
        self._agrees_from = 0
        self._disagreed_at: int | None = None

    def take(self, sample: int, ticks: int) -> None:
        """Take the ticks of a block whose first sample has a number."""
        if self._reference is None:
            self.begin(sample, ticks)
            return
        since, from_ticks = self._reference
        elapsed = sample - since
        slack = _SLACK_SAMPLES + _SLACK_SHARE * elapsed
        advance = (ticks - from_ticks) * self._per_tick
        if abs(advance - elapsed) > slack:
            advance = self._advance(from_ticks, ticks, elapsed)
        if abs(advance - elapsed) > slack:
            self._disagree(sample, ticks, advance, elapsed)
            self.begin(sample, ticks)
        elif elapsed > _REFERENCE_S * self._rate_hz:
            self.begin(sample, ticks)
        if not self.trusted and sample - self._agrees_from > _TRUST_S * self._rate_hz:
            self.trusted, self.words = True, ''
        self._last_ticks = ticks

    def confirms(self, samples: int, ticks: int) -> bool:
        """Return whether a block `samples` after the last one may have these ticks."""
        if not self.trusted:
            return samples <= _LONGEST_HOLE_S * self._rate_hz
        advance = self._advance(self._last_ticks, ticks, samples)
        return abs(advance - samples) <= 1 + _HOLE_TOLERANCE * samples

    def begin(self, sample: int, ticks: int) -> None:
        """Compare from a block on: the first, or one after a hole, which was judged already."""
        self._reference, self._last_ticks = (sample, ticks), ticks

    def _advance(self, before: int, ticks: int, samples: int) -> float:
        """Samples that pass from one count of ticks to another; a 32-bit counter may wrap."""
        plain = (ticks - before) * self._per_tick
        wrapped = (ticks - before) % _WRAP * self._per_tick
        return min(plain, wrapped, key=lambda advance: abs(advance - samples))

    def _disagree(self, sample: int, ticks: int, advance: float, elapsed: int) -> None:
        again = self._disagreed_at is not None and (
            sample - self._disagreed_at < _AGAIN_S * self._rate_hz
        )
        if ticks == self._last_ticks:
            self.words = 'stand still'
        elif again:
            self.words = f'run at {advance / elapsed:.4g} times the pace of the samples'
        else:
            self.words = f'jumped by {(advance - elapsed) / self._rate_hz:.3g} s'
        if self.trusted:
            self.disagreements += 1
        self.trusted, self._agrees_from, self._disagreed_at = False, sample, sample


_SEQUENCES = 2**32
"""Number after which the blocks' sequence number begins again (an unsigned 32-bit counter)."""


@dataclass(frozen=True)
class Window:
    """Holds one window of samples of all channels."""

    codes: NDArray[np.int16]  # (N, C), converter codes
    present: Booleans  # (N,), false where a sample was lost
    # Number of the sample in the middle of the window, since the stream began
    middle_sample: float
    saturated: Booleans  # (C,), whether a sample lies at an end of the converter's range
    stuck: Booleans  # (C,), whether all samples are the same
    # (C,), how long before, samples, a column said what it says in the window, or a part of it; 0
    # where all of it is new
    ages: Integers
    # (C,), whether a column holds too little noise to distinguish new samples from old ones
    noiseless: Booleans
    repeats: bool  # Whether no column says anything new

    @property
    def dropped(self) -> bool:
        """Return whether samples are missing inside the window."""
        return not bool(self.present.all())


@dataclass
class CutterCounters:
    """Counts the windows, samples and blocks of a stream, and its restarts."""

    windows: int = 0
    windows_lost: int = 0
    windows_skipped: int = 0
    windows_dropped_samples: int = 0
    missing_samples: int = 0
    duplicate_blocks: int = 0
    restarts: int = 0


class WindowCutter:
    """Collects blocks and returns a window every `hop_samples`.

    Lost blocks leave a hole of the right length, so that the windows keep their grid. A window
    with less than half of its samples counts as lost. A sequence number that does not fit the
    device's ticks begins a new stream, and so does one that was already used with other samples.

    A hop, the way from one window to the next, leaves samples out if it is longer than the window.

    ``window`` is the length of one, samples, ``end_sample`` the number of the sample behind the
    newest block, since the device began to count, ``expected`` the number of the block that
    follows on it (None: any); ``samples_wanted`` is how many the next window still lacks. Raises
    `ParameterError` when a length is less than one sample.
    """

    def __init__(
        self, window_samples: int, hop_samples: int, watch: RepetitionWatch, ticks: TickCheck
    ) -> None:
        if min(hop_samples, window_samples) < 1:
            raise ParameterError(
                f'a window of {window_samples} and a hop of {hop_samples} samples: both must be '
                'at least one'
            )
        self.counters = CutterCounters()
        self.columns = watch.columns
        self.window = window_samples
        self._hop = hop_samples
        self._watch, self._ticks = watch, ticks
        self._codes = np.zeros((max(4 * window_samples, 8192), watch.columns), np.int16)
        self._present = np.zeros(len(self._codes), bool)
        self.reset()

    def reset(self) -> None:
        """Forget the samples; the next block begins a new grid of windows."""
        self._filled = 0
        self.samples_wanted = self.window
        self.expected: int | None = None
        self.end_sample = self._begin_sample = 0
        self._watch.reset()
        self._ticks.reset()

    def coming(self) -> NDArray[np.int16]:
        """Return the samples (n, C) that are there of the next window, lost ones included."""
        count = max(self.window - self.samples_wanted, 0)
        return self._codes[self._filled - count : self._filled]

    def push(
        self, sequence: int, timestamp_ticks: int | Sequence[int], codes: NDArray[np.int16]
    ) -> list[Window]:
        """Add a block of samples (n, C) and return the windows that it completes.

        ``sequence`` is its number modulo 2^32, the ticks are those of its first sample. Several
        blocks of one length, of which the first is expected and the others follow, are added at
        once by the ticks of each. Raises `ParameterError` when the block has another number of
        channels.
        """
        if codes.shape[1] != self._codes.shape[1]:
            raise ParameterError(
                f'a block of {codes.shape[1]} channels in a stream of {self._codes.shape[1]}'
            )
        ticks = (timestamp_ticks,) if isinstance(timestamp_ticks, int) else timestamp_ticks
        block = len(codes) // len(ticks)
        missing = self._missing_blocks(sequence, ticks[0], codes) * block
        if missing < 0:
            self.counters.duplicate_blocks += 1
            return []
        if self.expected is None:
            self.end_sample = self._begin_sample = sequence * block
        first = self.end_sample + missing
        self.expected = (sequence + len(ticks)) % _SEQUENCES
        windows: list[Window] = []
        if missing:
            self.counters.missing_samples += missing
            self._watch.skip(missing)
            self._ticks.begin(first, ticks[0])
            # Windows that lie inside a long hole are not cut.
            hops = max((missing - 2 * self.window) // self._hop, 0)
            self.counters.windows_lost += hops
            left = missing - hops * self._hop
            windows += self._advance(None, left, first - left)
        else:
            for rank, each in enumerate(ticks):
                self._ticks.take(first + rank * block, each)
        self._watch.take(codes)
        self.end_sample = first + len(codes)
        return windows + self._advance(codes, len(codes), first)

    def _missing_blocks(self, sequence: int, ticks: int, codes: NDArray[np.int16]) -> int:
        """Return the number of blocks lost before this one; -1 for a block that came before."""
        if self.expected is None or sequence == self.expected:
            return 0
        ahead, block = (sequence - self.expected) % _SEQUENCES, len(codes)
        if ahead >= _SEQUENCES // 2:
            place = self._watch.position - (_SEQUENCES - ahead) * block
            if self._watch.matches_history(place, codes) is not False:
                return -1
        elif self._ticks.confirms((ahead + 1) * block, ticks):
            return ahead
        self.counters.restarts += 1
        self.reset()
        return 0

    def _advance(self, codes: NDArray[np.int16] | None, count: int, first: int) -> list[Window]:
        """Append samples, or a hole where `codes` is None, and return the completed windows."""
        windows: list[Window] = []
        done = 0
        while done < count:
            step = min(self.samples_wanted, count - done)
            self._append(None if codes is None else codes[done : done + step], step)
            done += step
            self.samples_wanted -= step
            if self.samples_wanted == 0:
                self.samples_wanted = self._hop
                windows += self._cut(first + done)
        return windows

    def _append(self, codes: NDArray[np.int16] | None, count: int) -> None:
        if self._filled + count > len(self._codes):
            keep = min(self._filled, self.window)
            tail = slice(self._filled - keep, self._filled)
            self._codes[:keep] = self._codes[tail].copy()
            self._present[:keep] = self._present[tail].copy()
            self._filled = keep
        place = slice(self._filled, self._filled + count)
        self._present[place] = codes is not None
        if codes is not None:
            self._codes[place] = codes
        self._filled += count

    def _cut(self, end: int) -> list[Window]:
        """Return the window that ends with the newest sample, unless too little of it arrived."""
        place = slice(self._filled - self.window, self._filled)
        codes, present = self._codes[place].copy(), self._present[place].copy()
        arrived = int(np.count_nonzero(present))
        if 2 * arrived < self.window:
            self.counters.windows_lost += 1
            return []
        self.counters.windows += 1
        seen = codes if arrived == self.window else codes[present]
        if arrived < self.window:
            self.counters.windows_dropped_samples += 1
        low, high = seen.min(axis=0), seen.max(axis=0)
        saturated = (low <= RAILS[0]) | (high >= RAILS[1])
        watch, first = self._watch, end - self.window - self._begin_sample
        return [
            Window(
                codes, present, end - self.window / 2, saturated, low == high,
                watch.ages(first), watch.noiseless, watch.repeats,
            )
        ]  # fmt: skip
