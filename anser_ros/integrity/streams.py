"""Judges a stream of messages: does it have one sender, and are its readings new?

The middleware numbers the messages of a publisher, 1, 2, 3, but does not identify the publisher.
Messages that continue one sequence are one stream; a second sequence is a second sender,
recognised by its first message. The number of publishers that the graph knows distinguishes a lost
message from another sequence, and shows when a sender has gone. A sender that crashed stays in the
graph for some time: it does not count once it has been silent, unless its last message holds until
it is replaced.

A reading without new noise is an old one. Each reading is compared with the channel's own readings
of the last seconds. Two explanations compete: *new*, the difference contains the noise of two
readings; *stuck*, it contains rounding alone or, because a flux is a voltage divided by a measured
current, also the noise of the current. The logarithm of the odds is summed over frames that follow
one another with the same distance in time; odds of ``exp(h)`` come about by chance with a
probability of ``exp(-h)`` at most (Ville's inequality), however many emitters there are and
however long the run is. So with eight emitters one exact repetition is enough, and one emitter
needs a few.
"""

import math
from collections.abc import Hashable
from dataclasses import dataclass, replace

import numpy as np

from anser_ros.frames.faults import STUCK_CODE
from anser_ros.frames.intake import Frame
from anser_ros.kernel_cache import inlined, kernel
from anser_ros.stamps import NANO

SILENT_S = 1.0
"""A sender of a stream that said nothing for this time, s, counts as gone."""


@dataclass
class _Run:
    """Consecutive messages of one sender: the last number, when it came, and what holds by it."""

    number: int
    received_s: float
    lasting: Hashable


class Senders:
    """Distinguishes the senders of one topic.

    With ``is_constant`` what a sender says never changes: who says otherwise is another one,
    whatever number the message has. ``complaint`` is why the topic cannot be believed now; it is
    empty while there is one sender.
    """

    def __init__(self, topic: str, is_constant: bool = False) -> None:
        self._topic, self._is_constant = topic, is_constant
        self._runs: list[_Run] = []
        self._is_numbered = True
        self.complaint = ''

    def forget(self) -> None:
        """Forget all that was received."""
        self._runs, self.complaint = [], ''

    def continues(self, number: int | None) -> bool:
        """Return whether a message is the next one of the only sender that is received."""
        return len(self._runs) == 1 and number == self._runs[0].number + 1

    def take(
        self, number: int | None, publishers: int, now_s: float, lasting: Hashable = None
    ) -> bool:
        """Take a message; return whether it may be believed.

        ``number`` is its sender's number for it, None where the middleware gives none;
        ``publishers`` is how many the graph knows. ``lasting`` is what it says, where that holds
        until the sender says otherwise: senders that say the same do not contradict each other.
        """
        self._is_numbered = number is not None
        if number is not None:
            self._drop_silent(now_s)
            run = self._run_of(number, publishers)
            if run is not None and self._is_constant and run.lasting != lasting:
                run = None
            if run is None:
                if publishers <= 1 and len(self._runs) == 1 and self._is_ended(lasting, now_s):
                    self._runs.clear()  # it has gone, and this is its successor
                self._runs.append(_Run(number, now_s, lasting))
            else:
                run.number, run.received_s, run.lasting = number, now_s, lasting
        return not self.look(publishers, now_s)

    def look(self, publishers: int, now_s: float) -> str:
        """Return `complaint` as it is now, when no message has come."""
        self._drop_silent(now_s)
        complaint = {run.lasting for run in self._runs}
        agree = len(complaint) == 1 and None not in complaint
        if not self._is_numbered and publishers > 1:
            self.complaint = f'{publishers} publishers of {self._topic}'
        elif len(self._runs) > 1 and not agree:
            self.complaint = f'two publishers of {self._topic}'
        else:
            self.complaint = ''
        return self.complaint

    def _drop_silent(self, now_s: float) -> None:
        """Drop the runs that have ended.

        A lasting message outlives its sender's silence. When one of several senders has gone, it
        is unknown which, so their messages stay valid until they are forgotten and requested
        again.
        """
        self._runs = [
            run
            for run in self._runs
            if now_s - run.received_s < SILENT_S or run.lasting is not None
        ]

    def _is_ended(self, lasting: Hashable, now_s: float) -> bool:
        """Return whether silence shows that a sender has gone, to whom another one may succeed.

        It does not where what was said holds on: the graph may not know the second one yet.
        """
        (run,) = self._runs
        if run.lasting is not None:
            return run.lasting == lasting
        return now_s - run.received_s >= SILENT_S

    def _run_of(self, number: int, publishers: int) -> _Run | None:
        """Return the run that a message continues; None for the first of another."""
        for run in self._runs:
            if number == run.number + 1:
                return run
        if publishers > 1:
            return None
        earlier = [run for run in self._runs if run.number < number]
        return max(earlier, key=lambda run: run.number, default=None)


LEAST_NOISE = 0.1
"""The noise of a reading is at least so many times the stated one, which a lab may state several
times too large."""
CURRENT_NOISE = 2e-5
"""Relative change of a stuck column's flux by the noise of the current that it is divided by: some
times that of a 16-bit converter over 20 ms."""
ROUNDING = 2.0**-21
"""Relative difference of two readings of the same samples: fluxes travel as float32, rounded to
2^-24, after a fit to tones of another phase."""
CERTAIN = 35.0
"""Logarithm of the odds from which on a reading is stuck: wrong with a probability of exp(-35) =
6e-16, with 100 channels at 50 Hz once in a century."""
DEPTH = 100
"""Readings that are kept of each channel, two seconds at 50 Hz: the longest buffer whose copies
are found."""
HOPELESS = -60.0
"""Logarithm of the odds of one comparison below which the rest of it is not worked out."""


@inlined
def _fill_terms(now, least, terms):  # type: ignore[no-untyped-def]
    """Write what makes the odds of a repetition of ``now`` (K,): a place and four numbers a row.

    The weakest emitter comes first: it shows noise best, and mostly ends the comparison. The
    rows hold, exactly and but for the currents, the odds of no difference at all, and by how much
    they fall with a squared difference. Returns how many emitters count.
    """
    count, weakest, smallest = 0, 0, math.inf
    for k in range(now.shape[0]):
        size = math.hypot(now[k].real, now[k].imag)
        if not size > 0.0:
            continue
        terms[count, 0] = k
        for way in range(2):
            relative = ROUNDING if way == 0 else CURRENT_NOISE
            share = min((relative * size / least) ** 2, 1.0)
            terms[count, 1 + 2 * way] = -math.log(share)
            terms[count, 2 + 2 * way] = (1.0 / share - 1.0) / (4.0 * least * least)
        if size < smallest:
            weakest, smallest = count, size
        count += 1
    for i in range(5):
        terms[0, i], terms[weakest, i] = terms[weakest, i], terms[0, i]
    return count


@kernel
def compare(flux, codes, ring, filled, newest, sums, least, certain, ages):  # type: ignore[no-untyped-def]
    """Compare readings (S, K) with those of the ring (D, S, K), and put them into it.

    ``codes`` (S,): readings with another than 0 are not looked at. ``filled``: how many frames the
    ring holds; ``newest``: the place of the last one. ``sums`` (S, D, 2), the runs' odds by
    distance in frames, goes on. ``ages`` (S,): how many frames ago the reading was the same, 0 for
    a new one. Returns whether there is any that is not new.
    """
    depth, width = ring.shape[0], flux.shape[1]
    terms, place, some = np.empty((width, 5)), (newest + 1) % depth, False
    for s in range(flux.shape[0]):
        ages[s] = 0
        if codes[s] != 0:
            for d in range(depth):
                sums[s, d, 0] = sums[s, d, 1] = 0.0
            for k in range(width):
                ring[place, s, k] = complex(math.nan, math.nan)
            continue
        count = _fill_terms(flux[s], least, terms)
        for d in range(filled):
            then, exact, scaled = ring[(newest - d) % depth, s], 0.0, 0.0
            for i in range(count):
                k = int(terms[i, 0])
                x, y = flux[s, k].real - then[k].real, flux[s, k].imag - then[k].imag
                square = x * x + y * y
                if not square < math.inf:  # the older one was no reading
                    exact = scaled = HOPELESS
                    break
                exact += terms[i, 1] - terms[i, 2] * square
                scaled += terms[i, 3] - terms[i, 4] * square
                if exact < HOPELESS and scaled < HOPELESS:
                    break
            sums[s, d, 0] = min(max(sums[s, d, 0] + exact, 0.0), 2.0 * certain)
            sums[s, d, 1] = min(max(sums[s, d, 1] + scaled, 0.0), 2.0 * certain)
            if ages[s] == 0 and max(sums[s, d, 0], sums[s, d, 1]) > certain:
                ages[s] = d + 1
                some = True
        for k in range(width):
            ring[place, s, k] = flux[s, k]
    return some


class Freshness:
    """Finds readings that repeat an earlier one.

    ``age_s`` (S,) is how long ago the same reading came, s, for the last frame that had any; 0
    for new ones.
    """

    def __init__(self) -> None:
        self._forget((0, 0))

    def _forget(self, shape: tuple[int, int]) -> None:
        self._ring = np.full((DEPTH, *shape), np.nan, dtype=np.complex128)
        self._stamps = np.zeros(DEPTH, dtype=np.int64)
        self._sums = np.zeros((shape[0], DEPTH, 2))
        self.age_s = np.zeros(shape[0])
        self._ages = np.zeros(shape[0], dtype=np.int64)
        self._filled, self._newest = 0, -1

    def judged(self, frame: Frame, noise_t: float) -> Frame:
        """Return the next frame of a stream with its stuck readings marked.

        ``noise_t`` is the stated noise of a phasor component, T.
        """
        if frame.goes_back or self._ring.shape[1:] != frame.flux.shape:
            self._forget(frame.flux.shape)
        some = compare(
            frame.flux, frame.codes, self._ring, self._filled, self._newest, self._sums,
            LEAST_NOISE * noise_t, CERTAIN, self._ages,
        )  # fmt: skip
        before = self._newest
        self._newest = (self._newest + 1) % DEPTH
        self._filled = min(self._filled + 1, DEPTH - 1)
        if some:
            then = self._stamps[(before + 1 - self._ages) % DEPTH]
            self.age_s = np.where(self._ages > 0, (frame.stamp_ns - then) * NANO, 0.0)
        self._stamps[self._newest] = frame.stamp_ns
        if not some:
            return frame
        return replace(frame, codes=np.where(self._ages > 0, STUCK_CODE, frame.codes))

    def reason(self, row: int) -> str:
        """Return what is said of a stuck reading of the last frame."""
        return f'stuck: the same reading as {self.age_s[row]:.2g} s ago'
