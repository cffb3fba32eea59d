"""Searches, compiled and a sample at a time, for runs of samples that a column has said before.

All arrays have a place for each of C columns. Positions count samples since the last reset; the
sample at position p is in row p mod H of the history (H, C).
"""

import numpy as np

from anser_ros.kernel_cache import kernel

FINGERPRINT_SAMPLES = 32
"""Samples that a fingerprint depends on. The factor of its recursion holds the number 2 once, so
that after 32 steps a sample has left its 32 bits. It is the shortest run that can be found."""
FACTOR = np.uint32(0x9E3779B2)
"""Factor of the recursion h <- h * FACTOR + sample modulo 2^32: twice an odd number, the golden
ratio's 32 bits, which spreads neighbouring codes over the whole range."""
ANCHOR_SHARE = 64
"""One fingerprint in so many, by its own value, is remembered and looked up: where it lies hangs
on the samples alone, so a run that comes again has its anchors at the same samples. Fewer would
find a repetition later; more cost time, and what they find is found a millisecond earlier."""
_ANCHOR_BELOW = np.uint32(2**32 // ANCHOR_SHARE)
"""Fingerprints below this are anchors."""
SLOTS = 2048
"""Remembered anchors of a column, a power of 2: at 40 kS/s they are those of 3 s. A newer one
takes the place of an older one with which it shares a slot, so a long ring is found by its second
anchor or so. More of them leave the processor's cache, and the search takes twice the time."""
_SLOT_SHIFT = np.uint32(15)
"""Shift of an anchor, which is below 2^26, that leaves the number of its slot."""
_ROW_BITS = np.uint32(20)
"""Bits of a slot that hold the anchor's row in the history, which is not longer than 2^20; above
them are the lowest bits of its fingerprint, which let one in 4096 pass that is another."""
MOST_ROWS = 2**20
"""Longest history, samples, that these bits allow: 2.6 s at 400 kS/s."""
_ROW_MASK = np.uint32(MOST_ROWS - 1)
"""Mask of the row in a slot."""
PROBE_SAMPLES = (128, 512, 2048)
"""Samples after which each of the fingerprints that all others are compared with is taken anew. In
a ring that is shorter than one of these numbers such a probe comes again for certain, at the
latest after twice the number; that a longer one has no anchor has a probability of 1e-14."""


@kernel
def _run_length(history, row, column, lag, longest):  # type: ignore[no-untyped-def]
    """Return how many samples up to that of a row equal those `lag` before, at most `longest`."""
    rows = history.shape[0]
    for back in range(longest):
        one = row - back
        if one < 0:
            one += rows
        other = one - lag
        if other < 0:
            other += rows
        if history[one, column] != history[other, column]:
            return back
    return longest


@kernel
def search(  # type: ignore[no-untyped-def]
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
            if _run_length(history, row, c, found, FINGERPRINT_SAMPLES) < FINGERPRINT_SAMPLES:
                continue
            # What a buffer repeats it repeats in all columns, of which most meet no anchor yet.
            for b in range(columns):
                if lag[b] > 0:
                    continue
                same = _run_length(history, row, b, found, min(needed[b], contiguous + i + 1))
                if same >= FINGERPRINT_SAMPLES:
                    lag[b], run[b] = found, same
                    followed += 1
                    if same >= needed[b]:
                        until[b], age[b] = at + 1, found
        for k in range(probed_at.size):
            if (at + 1) % PROBE_SAMPLES[k] == 0:
                probes[k] = fingerprint
                probed_at[k] = at
