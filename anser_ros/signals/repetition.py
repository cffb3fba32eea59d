"""Finds repeated samples: a column whose newest samples equal earlier ones bit for bit.

Fresh samples carry new noise, so that a long run of them never equals an earlier one. How long a
run must be follows from the observed noise of a column: at the lag at which its tones return most
nearly, two fresh samples coincide with a probability q, which is counted, and a run of n of them
with q^n. A column whose n samples contain too little randomness proves nothing, and is called
noiseless: if nothing changes, new and old samples cannot be distinguished.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import ParameterError
from anser_ros.signals.repetition_kernels import (
    FINGERPRINT_SAMPLES,
    MOST_ROWS,
    PROBE_SAMPLES,
    SLOTS,
    search,
)

EVIDENCE_BITS = 80.0
"""Bits of surprise that a run must hold to count as repeated. A unit of 42 columns at 40 kS/s with
two seconds of history compares 2^37 pairs of runs a second and 2^65 in ten years, so that one
false alarm in ten years has a probability of 2^-15 even if all tones returned at every lag. Fewer
bits give false alarms, more need longer runs: a column of 3 bits per sample needs 27 samples for
80."""
LONGEST_RUN_S = 0.025
"""Longest run, s, that a column may need. One that needs more has less than 80 bits of noise in it
(0.08 bits per sample at 40 kS/s, 0.06 codes rms) and is noiseless; a longer one would let whole
windows of repeated samples pass before they are found."""
HISTORY_S = 2.5
"""How far back a repetition is found, s. Buffers that a fault of a driver or a cable can repeat
are far shorter; a longer history costs 3.4 MB a second at 42 columns."""
MOST_BYTES = 64_000_000
"""Most memory of the history, bytes; that of a unit with very many channels is shorter."""
_LONGEST_STEP = 2048
"""Most samples, and a power of 2, that wait to be searched; less than any history has."""
_JUDGED_SAMPLES = 2 * _LONGEST_STEP
"""Samples after which it is worked out again how long runs must be: every 0.1 s at 40 kS/s, far
less than `MEMORY_S`. More often only costs time."""
SHORTEST_LAG_S = 1e-3
"""Shortest lag, s, at which fresh samples are compared: over a shorter one a tone at 1 kHz or less
is no other than it was."""
SAMPLED_ROWS = 64
"""Length, samples, of the stretches on which the column is compared with itself at the worst lag;
long enough for what follows on what."""
SAMPLED_SHARE = 16
"""One such stretch in so many is compared. All of them would cost as much as the search."""
MEMORY_S = 1.0
"""Time constant, s, with which coincidences are forgotten. A longer one keeps a tool's movement,
which makes coincidences rarer, in mind when it rests; a shorter one counts few."""
_PRIOR = 32.0
"""Samples that the prior of the coincidences counts for, half of which coincide (one bit each). It
holds the first 0.1 s, until there are samples at the worst lag; more would slow the start down."""
_PRIOR_RUNS = 4.0
"""Coincidences that the prior of what follows one counts for: that noise is so correlated that
every further sample is worth half of its own surprise."""
RAILS = np.array([np.iinfo(np.int16).min, np.iinfo(np.int16).max], np.int16)
"""Ends of the range of the 16-bit converter; a code at either end counts as saturated."""


class RepetitionWatch:
    """Keeps the last samples of a stream, and finds in them what comes again.

    Parameters
    ----------
    columns : int
        Number of columns, C.
    sample_rate_hz : float
        Samples a second and column.
    tones_hz : ndarray, shape (K,), optional
        Tones of the signals, Hz: fresh samples are most alike where all of them return together.

    Raises
    ------
    ParameterError
        When there is no column, or the rate is not positive.

    Attributes
    ----------
    position : int
        Samples since the last reset, holes included.
    """

    def __init__(
        self, columns: int, sample_rate_hz: float, tones_hz: NDArray[np.float64] | None = None
    ) -> None:
        if columns < 1 or not sample_rate_hz > 0:
            raise ParameterError(
                f'repetitions need columns and a rate, not {columns} at {sample_rate_hz:g} S/s'
            )
        rows = min(int(HISTORY_S * sample_rate_hz), MOST_BYTES // (2 * columns), MOST_ROWS)
        self._rate_hz = sample_rate_hz
        self._history = np.zeros((max(rows, 2 * _LONGEST_STEP), columns), np.int16)
        self._slots = np.zeros((columns, SLOTS), np.uint32)
        self._worst_lag = _worst_lag(len(self._history), sample_rate_hz, tones_hz)
        self._longest = max(int(LONGEST_RUN_S * sample_rate_hz), 2 * FINGERPRINT_SAMPLES)
        self.reset()

    def reset(self) -> None:
        """Forget all samples and what they were found to be."""
        columns = self._history.shape[1]
        self.position = self._searched = self._contiguous_from = 0
        self._slots[:] = 0
        self._fingerprint = np.zeros(columns, np.uint32)
        self._probes = np.zeros((len(PROBE_SAMPLES), columns), np.uint32)
        self._probed_at = np.zeros(len(PROBE_SAMPLES), np.int64)
        self._lag, self._run, self._until, self._age = np.zeros((4, columns), np.int64)
        self._equal, self._tally = np.zeros(columns, np.bool_), np.zeros((3, columns))
        self._judge()

    @property
    def columns(self) -> int:
        """Return how many columns a sample has."""
        return self._history.shape[1]

    @property
    def noiseless(self) -> NDArray[np.bool_]:
        """Return the columns with too little noise in their samples to distinguish new from old,
        (C,)."""
        return self._needed > self._longest

    @property
    def needed(self) -> NDArray[np.int64]:
        """Return how long a run of each column must be to count as repeated, samples, (C,)."""
        return self._needed

    @property
    def repeats(self) -> bool:
        """Return whether no column said anything new lately, and one repeats what it said."""
        repeating = self._run >= self._needed
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
            self._search()

    def skip(self, samples: int) -> None:
        """Leave a hole for samples that were lost."""
        self._search()
        rows = len(self._history)
        cleared = min(samples, rows)
        self._history[(self.position + samples - cleared + np.arange(cleared)) % rows] = 0
        self.position += samples
        self._searched = self._contiguous_from = self.position
        self._run[:] = self._lag[:] = 0

    def ages(self, first: int) -> NDArray[np.int64]:
        """Return how old the samples from a position on are, shape (C,), samples.

        It is 0 for a column whose samples are all new, otherwise the time since it had the same
        samples.
        """
        self._search()
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

    def _search(self) -> None:
        """Look at the samples that have come since the last look."""
        rows = len(self._history)
        while self._searched < self.position:
            at = self._searched
            first = at % rows
            until_judged = _JUDGED_SAMPLES - at % _JUDGED_SAMPLES
            count = min(self.position - at, rows - first, until_judged)
            contiguous = at - self._contiguous_from
            search(
                self._history, first, count, at, contiguous, self._fingerprint, self._probes,
                self._probed_at, self._slots, self._needed, self._lag, self._run, self._until,
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
        history, is_new = self._history, self._run < self._needed
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
        self._needed = np.maximum(samples, FINGERPRINT_SAMPLES).astype(np.int64)
        self._tally *= math.exp(-_JUDGED_SAMPLES / (MEMORY_S * self._rate_hz))


def _worst_lag(rows: int, sample_rate_hz: float, tones_hz: NDArray[np.float64] | None) -> int:
    """Return the lag, samples, at which all tones are most nearly where they were.

    The shortest of equally good ones is taken: the less time passes, the less has moved.
    """
    shortest = max(int(SHORTEST_LAG_S * sample_rate_hz), 1)
    lags = np.arange(shortest, max(rows - _LONGEST_STEP, shortest + 1))
    if tones_hz is None or not len(tones_hz):
        return int(lags[0])
    agreement = np.zeros(len(lags))
    for tone in tones_hz:
        agreement += np.cos(2 * np.pi * tone / sample_rate_hz * lags)
    return int(lags[np.argmax(np.round(agreement, 6))])
