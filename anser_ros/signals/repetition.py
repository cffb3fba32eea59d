"""Finds repeated samples: a column whose newest samples equal earlier ones bit for bit.

Fresh samples carry new noise, so that a long run of them never equals an earlier one. How long a
run must be follows from the observed noise of a column: at the lag at which its tones return most
nearly, two fresh samples coincide with a probability q, which is counted, and a run of n of them
with q^n. A column whose n samples contain too little randomness proves nothing, and is called
noiseless: if nothing changes, new and old samples cannot be distinguished.

The search is compiled, and goes a sample at a time. Positions count samples since the last reset;
the sample at position p is in row p mod H of the history (H, C).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from anser_ros.arrays import Array, Booleans, Integers
from anser_ros.errors import ParameterError
from anser_ros.kernel_cache import kernel

FINGERPRINT_SAMPLES = 32
"""Samples that a fingerprint depends on, the shortest run found: 32 factors of 2 fill its bits."""
FACTOR = np.uint32(0x9E3779B2)
"""Factor of h <- h * FACTOR + sample modulo 2^32: twice an odd number, the golden ratio's bits."""
ANCHOR_SHARE = 64
"""One fingerprint in so many, by its own value, is looked up: a repeated run has the same ones."""
_ANCHOR_BELOW = np.uint32(2**32 // ANCHOR_SHARE)
"""Fingerprints below this are anchors."""
SLOTS = 2048
"""Remembered anchors of a column, a power of 2: 3 s at 40 kS/s, and in the processor's cache."""
_SLOT_SHIFT = np.uint32(15)
"""Shift of an anchor, which is below 2^26, that leaves the number of its slot."""
_ROW_BITS = np.uint32(20)
"""Bits of a slot that hold the anchor's row in the history, which is not longer than 2^20; above
them are the lowest bits of its fingerprint, which let one in 4096 pass that is another."""
MOST_ROWS = 2**20
"""Longest history, samples, that these bits allow: 2.6 s at 400 kS/s."""
_ROW_MASK = np.uint32(MOST_ROWS - 1)  # of the row in a slot
PROBE_SAMPLES = (128, 512, 2048)
"""Samples after which each fingerprint that all others are compared with is taken anew: in a ring
shorter than one of these it comes again for certain; longer ones have anchors (all but 1e-14)."""


@kernel
def find_repeated(  # type: ignore[no-untyped-def]
    history, first, count, position, contiguous, fingerprint, probes, probed_at, slots, needed,
    lag, run, until, age,
):  # fmt: skip
    """Take `count` new samples, which lie in the history's rows from `first` on.

    ``position`` is that of the first of them, ``contiguous`` how many samples before it follow on
    each other without a hole. ``fingerprint`` (C,) is carried on; ``probes`` (P, C) are those of
    the positions ``probed_at`` (P,). ``slots`` (C, SLOTS) holds the anchors. Where a column is
    being followed at a ``lag`` (C,), ``run`` (C,) samples have come true; from ``needed`` (C,) on
    they count as repeated: ``until`` (C,) is then the position behind the last of them and
    ``age`` (C,) the lag.
    """
    rows, columns = history.shape
    short, middle, long = probes[0], probes[1], probes[2]
    is_met = np.empty(columns, np.uint32)
    followed = 0
    for c in range(columns):
        followed += lag[c] > 0
    for i in range(count):
        row, at = first + i, position + i
        for c in range(columns if followed else 0):
            if lag[c] == 0:
                continue
            other = row - lag[c]
            if other < 0:
                other += rows
            if history[other, c] != history[row, c]:
                lag[c], run[c] = 0, 0
                followed -= 1
                continue
            run[c] += 1
            if run[c] >= needed[c]:
                until[c], age[c] = at + 1, lag[c]
        # Apart from the search, this takes several columns per step.
        for c in range(columns):
            fingerprint[c] = np.uint32(fingerprint[c] * FACTOR + np.uint32(history[row, c]))
        for c in range(columns):
            mark = fingerprint[c]
            is_met[c] = (
                np.uint32(mark < _ANCHOR_BELOW)
                | np.uint32(mark == short[c])
                | np.uint32(mark == middle[c])
                | np.uint32(mark == long[c])
            )
        for c in range(columns):
            if not is_met[c]:
                continue
            mark = fingerprint[c]
            is_probe = (mark == short[c]) | (mark == middle[c]) | (mark == long[c])
            found = 0
            if mark < _ANCHOR_BELOW:
                slot, tag = mark >> _SLOT_SHIFT, np.uint32(mark << _ROW_BITS)
                entry = slots[c, slot]
                slots[c, slot] = tag | np.uint32(row)
                if np.uint32((entry ^ tag) & ~_ROW_MASK) == 0:
                    found = (row - np.int64(entry & _ROW_MASK)) % rows
            if is_probe:
                found = at - probed_at[0 if mark == short[c] else 1 if mark == middle[c] else 2]
            if found <= 0 or lag[c] > 0 or found >= rows - needed[c]:
                continue
            # What a buffer repeats it repeats in all columns, of which most meet no anchor yet;
            # the column that met one comes first, for there may be no more to it.
            for ahead in range(columns):
                b = (c + ahead) % columns
                if lag[b] > 0:
                    continue
                same, most = 0, min(needed[b], contiguous + i + 1)
                while same < most:
                    one = row - same if same <= row else row - same + rows
                    other = one - found if found <= one else one - found + rows
                    if history[one, b] != history[other, b]:
                        break
                    same += 1
                if same >= FINGERPRINT_SAMPLES:
                    lag[b], run[b] = found, same
                    followed += 1
                    if same >= needed[b]:
                        until[b], age[b] = at + 1, found
                elif ahead == 0:
                    break
        for k in range(probed_at.size):
            if (at + 1) % PROBE_SAMPLES[k] == 0:
                for c in range(columns):
                    probes[k, c] = fingerprint[c]
                probed_at[k] = at


EVIDENCE_BITS = 80.0
"""Bits of surprise that a run must hold to count as repeated: 42 columns at 40 kS/s compare 2^65
pairs of runs in ten years, with one false alarm at a probability of 2^-15."""
LONGEST_RUN_S = 0.025
"""Longest run, s, that a column may need. One that needs more (0.08 bits per sample at 40 kS/s,
0.06 codes rms) is noiseless: whole windows would pass before a repetition is found."""
HISTORY_S = 2.5
"""How far back a repetition is found, s: farther than the buffers of drivers reach."""
MOST_BYTES = 64_000_000
"""Most memory of the history, bytes; that of a unit with very many channels is shorter."""
_LONGEST_STEP = 2048
"""Most samples, and a power of 2, that wait to be searched; less than any history has."""
_JUDGED_SAMPLES = 2 * _LONGEST_STEP
"""Samples after which it is worked out again how long runs must be: every 0.1 s at 40 kS/s."""
SHORTEST_LAG_S = 1e-3
"""Shortest lag, s, at which fresh samples are compared: over less, slow tones are as they were."""
SAMPLED_ROWS = 64
"""Length, samples, of the stretches on which a column is compared with itself."""
SAMPLED_SHARE = 16
"""One such stretch in so many is compared. All of them would cost as much as the search."""
MEMORY_S = 1.0
"""Time constant, s, with which coincidences are forgotten: they are rarer while a tool moves."""
_PRIOR = 32.0
"""Samples that the prior of the coincidences counts for, half of which coincide (one bit each)."""
_PRIOR_RUNS = 4.0
"""Coincidences that the prior of what follows one counts for: half of a sample's own surprise."""
RAILS = np.array([np.iinfo(np.int16).min, np.iinfo(np.int16).max], np.int16)
"""Ends of the range of the 16-bit converter; a code at either end counts as saturated."""


class RepetitionWatch:
    """Keeps the last samples of a stream, and finds in them what comes again.

    ``tones_hz`` (K,) are the tones of the signals, Hz: fresh samples are most alike where all of
    them return together. ``position`` counts samples since the last reset, holes included;
    ``needed`` (C,) is how long a run must be to count as repeated, samples. Raises
    `ParameterError` when there is no column, or the rate is not positive.
    """

    def __init__(self, columns: int, sample_rate_hz: float, tones_hz: Array | None = None) -> None:
        if columns < 1 or not sample_rate_hz > 0:
            raise ParameterError(
                f'repetitions need columns and a rate, not {columns} at {sample_rate_hz:g} S/s'
            )
        rows = min(int(HISTORY_S * sample_rate_hz), MOST_BYTES // (2 * columns), MOST_ROWS)
        self.columns, self._rate_hz = columns, sample_rate_hz
        self._history = np.zeros((max(rows, 2 * _LONGEST_STEP), columns), np.int16)
        self._slots = np.zeros((columns, SLOTS), np.uint32)
        self._worst_lag = _worst_lag(len(self._history), sample_rate_hz, tones_hz)
        self._longest = max(int(LONGEST_RUN_S * sample_rate_hz), 2 * FINGERPRINT_SAMPLES)
        self.reset()

    def reset(self) -> None:
        """Forget all samples and what they were found to be."""
        columns = self.columns
        self.position = self._searched = self._contiguous_from = 0
        self._slots[:] = 0
        self._fingerprint = np.zeros(columns, np.uint32)
        self._probes = np.zeros((len(PROBE_SAMPLES), columns), np.uint32)
        self._probed_at = np.zeros(len(PROBE_SAMPLES), np.int64)
        self._lag, self._run, self._until, self._age = np.zeros((4, columns), np.int64)
        self._equal, self._tally = np.zeros(columns, np.bool_), np.zeros((3, columns))
        self._judge()

    @property
    def noiseless(self) -> Booleans:
        """Return the columns with too little noise in their samples to distinguish new from old,
        (C,)."""
        return self.needed > self._longest

    @property
    def repeats(self) -> bool:
        """Return whether no column said anything new lately, and one repeats what it said."""
        repeating = self._run >= self.needed
        return bool(np.all(repeating | self.noiseless) and np.any(repeating))

    def take(self, codes: NDArray[np.int16]) -> None:
        """Keep the samples (n, C) that follow those before."""
        history, count = self._history, len(codes)
        first = self.position % len(history)
        step = min(count, len(history) - first)
        history[first : first + step] = codes[:step]
        if step < count:
            history[: count - step] = codes[step:]
        self.position += count
        if self.position - self._searched >= _LONGEST_STEP:
            self.search()

    def skip(self, samples: int) -> None:
        """Leave a hole for samples that were lost."""
        self.search()
        rows = len(self._history)
        cleared = min(samples, rows)
        self._history[(self.position + samples - cleared + np.arange(cleared)) % rows] = 0
        self.position += samples
        self._searched = self._contiguous_from = self.position
        self._run[:] = self._lag[:] = 0

    def ages(self, first: int) -> Integers:
        """Return how old the samples from a position on are, shape (C,), samples.

        It is 0 for a column whose samples are all new, otherwise the time since it had the same
        samples.
        """
        self.search()
        return np.where(self._until > first, self._age, 0)

    def matches_history(self, position: int, codes: NDArray[np.int16]) -> bool | None:
        """Return whether the samples at a position were these (n, C); None where it is a hole."""
        rows = len(self._history)
        if position < max(0, self.position - rows) or position + len(codes) > self.position:
            return False
        known = self._history[(position + np.arange(len(codes))) % rows]
        if not known.any() and codes.any():
            return None
        return bool(np.array_equal(known, codes))

    def search(self) -> None:
        """Look at the samples that have come since the last look."""
        rows = len(self._history)
        while self._searched < self.position:
            at = self._searched
            first = at % rows
            until_judged = _JUDGED_SAMPLES - at % _JUDGED_SAMPLES
            count = min(self.position - at, rows - first, until_judged)
            contiguous = at - self._contiguous_from
            find_repeated(
                self._history, first, count, at, contiguous, self._fingerprint, self._probes,
                self._probed_at, self._slots, self.needed, self._lag, self._run, self._until,
                self._age,
            )  # fmt: skip
            if contiguous > self._worst_lag:
                self._compare(first, count, at)
            self._searched = at + count
            if count == until_judged:
                self._judge()

    def _compare(self, first: int, count: int, at: int) -> None:
        """Compare samples, those of a few stretches, with the samples of the worst lag before.

        Samples at an end of the converter's range tell nothing of the noise, and neither do
        columns that repeat themselves.
        """
        history, is_new = self._history, self._run < self.needed
        stretch = SAMPLED_ROWS * SAMPLED_SHARE
        for start in range(at - at % stretch, at + count, stretch):
            begin, end = max(start, at), min(start + SAMPLED_ROWS, at + count)
            if begin >= end:
                continue
            rows = first + np.arange(begin - at, end - at)
            now = history[rows]
            counts = (now > RAILS[0]) & (now < RAILS[1]) & is_new
            same = counts & (now == history[(rows - self._worst_lag) % len(history)])
            continued = same & np.concatenate([self._equal[None], same[:-1]])
            self._tally += [part.sum(axis=0) for part in (counts, same, continued)]
            self._equal = same[-1] & (end < start + SAMPLED_ROWS)

    def _judge(self) -> None:
        """Work out how long a run must be, from the coincidences of samples that are fresh."""
        tried, coincided, continued = self._tally
        same = (coincided + 0.5 * _PRIOR) / (tried + _PRIOR)
        followed = continued + _PRIOR_RUNS * np.sqrt(same)
        surprise = -np.log2(np.maximum(same, followed / (coincided + _PRIOR_RUNS)))
        samples = np.ceil(EVIDENCE_BITS / np.maximum(surprise, 1e-6))
        self.needed = np.maximum(samples, FINGERPRINT_SAMPLES).astype(np.int64)
        self._tally *= math.exp(-_JUDGED_SAMPLES / (MEMORY_S * self._rate_hz))


def _worst_lag(rows: int, sample_rate_hz: float, tones_hz: Array | None) -> int:
    """Return the shortest lag, samples, at which all tones are most nearly where they were."""
    shortest = max(int(SHORTEST_LAG_S * sample_rate_hz), 1)
    lags = np.arange(shortest, max(rows - _LONGEST_STEP, shortest + 1))
    if tones_hz is None or not len(tones_hz):
        return int(lags[0])
    agreement = np.zeros(len(lags))
    for tone in tones_hz:
        agreement += np.cos(2 * np.pi * tone / sample_rate_hz * lags)
    return int(lags[np.argmax(np.round(agreement, 6))])
