"""Judges frames of fluxes once and in a table's order: order of the stamps, flags, values,
emitters.

The tracker, the refit and the nodes before them share this component, so that the same fault has
the same name and counter everywhere, and a frame that has been judged is not judged again.

A reading without new noise is an old one. Each reading is compared with the channel's own readings
of the last seconds (`Freshness`). Two explanations compete: *new*, the difference contains the
noise of two readings; *stuck*, it contains rounding alone or, because a flux is a voltage divided
by a measured current, also the noise of the current. The logarithm of the odds is summed over
frames that follow one another with the same distance in time; odds of ``exp(h)`` come about by
chance with a probability of ``exp(-h)`` at most (Ville's inequality), however many emitters there
are and however long the run is. So with eight emitters one exact repetition is enough, and one
emitter needs a few.

A reading is one sensor's fluxes of all emitters in one frame. Its first fault in the order of
`FAULTS` counts, with its name, state and reason. The flag bits are those of `wire.points`.
"""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from anser_ros import pose_states as states
from anser_ros.arrays import AnyArray, Booleans, ComplexArray, Integers
from anser_ros.errors import AnserError, LayoutError
from anser_ros.kernel_cache import inlined, kernel
from anser_ros.physics.sensor import LARGEST_FLUX_T
from anser_ros.stamps import JUMP_NS, NANO, Order, order_of
from anser_ros.wire import points


class Fault(NamedTuple):
    """Describes one kind of fault by its name, state and reason."""

    kind: str  # Its name in the counters: ``readings_<kind>``
    state: str  # The state of a pose that the reading was for
    reason: str  # What `/diagnostics` says of it


GOOD = 0
"""Code of a reading without a fault; the codes of faults are their places in `FAULTS`."""
MISSING_CODE, SATURATED_CODE, STALE_CODE, DROPPED_CODE, FLAGGED_CODE = 1, 2, 3, 4, 5
"""Codes of what the frame itself says: no such channel, or a flag."""
FLAG_CODES = (
    (points.SATURATED, SATURATED_CODE),
    (points.STALE, STALE_CODE),
    (points.DROPPED, DROPPED_CODE),
)
"""Flag bits and their codes; the first that is set counts. Any other bit is `FLAGGED_CODE`."""
NOT_FINITE_CODE, ABSURD_CODE = 6, 7
"""Codes of what the values say."""
STUCK_CODE = 8
"""Code of what earlier readings say: this one repeats one of them."""

FAULTS: tuple[Fault | None, ...] = (
    None,
    Fault('missing', states.STALE, 'its channel is not in the frame'),
    Fault('saturated', states.SATURATED, 'flagged saturated by the acquisition'),
    Fault('stale', states.STALE, 'flagged stale by the acquisition'),
    Fault('dropped', states.DROPPED, 'flagged dropped by the acquisition'),
    Fault('flagged', states.NO_SIGNAL, 'flagged by the acquisition with an unknown bit'),
    Fault('not_finite', states.NO_SIGNAL, 'the fluxes are not finite'),
    Fault('absurd', states.NO_SIGNAL, f'fluxes beyond {LARGEST_FLUX_T:g} T are implausible'),
    Fault('stuck', states.STALE, 'stuck: the same reading as before'),
)


def value_codes(flux: ComplexArray) -> Integers:
    """Return what the values of readings (..., K), T, say about them.

    Each is `GOOD`, `NOT_FINITE_CODE` or `ABSURD_CODE`.
    """
    with np.errstate(invalid='ignore'):
        largest = np.maximum(np.abs(flux.real), np.abs(flux.imag)).max(axis=-1, initial=0.0)
    codes = np.where(largest < LARGEST_FLUX_T, GOOD, ABSURD_CODE)
    return np.where(np.isfinite(largest), codes, NOT_FINITE_CODE)


def reading_codes(flux: ComplexArray, flags: NDArray[np.integer[Any]]) -> Integers:
    """Return what is wrong with recorded readings, as `Intake` says it of live ones.

    ``flux`` (..., K) in T and ``flags`` (...) of `wire.points`, where a channel that is not in its
    frame has `STALE` and NaN, make places in `FAULTS`; `GOOD` for readings that can be used.
    """
    codes = np.where(flags == 0, value_codes(flux), FLAGGED_CODE)
    for bit, code in reversed(FLAG_CODES):
        codes[(flags & bit) != 0] = code
    return codes


Count = Callable[[str, int], None]
"""Takes a counter's name and by how much it rises."""


@dataclass(frozen=True)
class Frame:
    """Holds one frame of fluxes as a table of sensors has them."""

    stamp_ns: int  # Middle of the demodulation window
    channels: Integers  # (S,), channels in the table's order
    # (S, K), T; NaN where a channel is missing and in place of components that are not finite
    flux: ComplexArray
    # (S,), what is wrong with each reading: places in `FAULTS`, 0 for nothing
    codes: Integers
    # (K,), emitters that a usable sensor receives; None when all are received, or none at all
    living: Booleans | None = None
    goes_back: bool = False  # Whether the stamp is before that of the frame before

    @property
    def usable(self) -> Booleans:
        """Return a mask (S,) of the readings without a fault."""
        return np.asarray(self.codes == GOOD)

    @property
    def readings(self) -> ComplexArray:
        """Return fluxes without a fault, shape (S, K), T; NaN in place of the others."""
        return np.where(self.usable[:, None], self.flux, np.nan)

    @property
    def kinds(self) -> Counter[str]:
        """Return how many readings have which kind of fault."""
        found = (FAULTS[code] for code in self.codes.tolist())
        return Counter(fault.kind for fault in found if fault is not None)


class Intake:
    """Puts frames into a table's order and judges them.

    ``channels`` (S,) are the table's; others in a frame are passed over. ``count`` gets the
    counters of frames that are admitted: ``frames``, ``duplicates``; ``time_jumps`` back,
    ``time_jumps_forward``; ``frames_empty``, ``frames_dead_emitter``. With ``spares_dead`` the
    user goes on without emitters that died: what is read of them is set to zero and is no fault.
    ``error`` is raised for what is not a frame.

    After a frame, ``last_ns`` is its stamp (0 before the first), and ``dead`` are the emitters
    that no sensor received in it while others were received.
    """

    def __init__(
        self,
        channels: Integers,
        count: Count | None = None,
        spares_dead: bool = False,
        error: type[AnserError] = LayoutError,
    ) -> None:
        self._channels, self._count = np.asarray(channels, dtype=np.int64), count
        self._spares_dead, self._error = spares_dead, error
        self._last_order: bytes | None = None
        self._rows = np.empty(0, dtype=np.int64)
        self.last_ns = 0
        self.dead: tuple[str, ...] = ()

    def admit(
        self,
        stamp_ns: int,
        channels: AnyArray,
        flux: AnyArray,
        flags: AnyArray | None = None,
        emitters: tuple[str, ...] | None = None,
        jump_s: float = JUMP_NS * NANO,
    ) -> Frame | None:
        """Judge a frame as the next one of a stream; None for one that was already seen.

        As `judge`, but ``emitters`` are the names of those that there ought to be, None while no
        model is known; ``jump_s`` is how far ahead of the last one a stamp may be, s. Raises
        `LayoutError`, or the intake's own error, as `judge`, and when the emitters are not as many
        as there ought to be.
        """
        frame = self.judge(stamp_ns, channels, flux, flags, None if emitters is None else
                           len(emitters))  # fmt: skip
        order = order_of(stamp_ns, self.last_ns, round(jump_s / NANO))
        if order is Order.SAME:
            self._note('duplicates')
            return None
        # A frame that is only a little late has no place in what was solved since either.
        goes_back = order in (Order.LATE, Order.BACK)
        if goes_back:
            self._note('time_jumps')
        elif order is Order.AHEAD:
            self._note('time_jumps_forward')
        self.last_ns = stamp_ns
        self._note('frames')
        if not len(channels):
            self._note('frames_empty')
        self.dead = ()
        if frame.living is not None:
            self._note('frames_dead_emitter')
            silent = np.flatnonzero(~frame.living).tolist()
            self.dead = tuple(f'emitter {k}' if emitters is None else emitters[k] for k in silent)
        return replace(frame, goes_back=True) if goes_back else frame

    def _note(self, name: str) -> None:
        if self._count is not None:
            self._count(name, 1)

    def judge(
        self,
        stamp_ns: int,
        channels: AnyArray,
        flux: AnyArray,
        flags: AnyArray | None = None,
        emitters: int | None = None,
    ) -> Frame:
        """Judge a frame by itself; nothing is counted.

        ``channels`` (N,) are those of the rows of ``flux`` (N, K), T, in any order; ``flags`` (N,)
        are bits of `wire.points`; ``emitters`` says how many there ought to be. Raises
        `LayoutError`, or the intake's own error, when the stamp is not positive, shapes don't fit,
        a channel appears twice, or the emitters are not as many as there ought to be.
        """
        if stamp_ns <= 0:
            raise self._error(f'a flux frame needs a positive stamp, got {stamp_ns} ns')
        given = np.ascontiguousarray(flux, dtype=np.complex128)
        number = np.asarray(channels, dtype=np.int64)
        marks = np.zeros(number.shape, dtype=np.int64)
        if flags is not None:
            marks = np.ascontiguousarray(flags, dtype=np.int64)
        if given.ndim != 2 or number.shape != given.shape[:1] or marks.shape != number.shape:
            raise self._error(
                f'fluxes (s, k) need s channels and as many flags, got {given.shape}, '
                f'{number.shape} and {marks.shape}'
            )
        width = given.shape[1]
        if emitters is not None and width != emitters:
            raise self._error(f'the model has {emitters} emitters, the fluxes {width}')
        self._find_rows(number)
        count = len(self._channels)
        ordered = np.empty((count, width), dtype=np.complex128)
        codes, received = np.empty(count, dtype=np.int64), np.zeros(width, dtype=np.bool_)
        some_dead = fill_frame(
            given, marks, self._rows, LARGEST_FLUX_T, self._spares_dead, ordered, codes, received
        )
        return Frame(stamp_ns, self._channels, ordered, codes, received if some_dead else None)

    def _find_rows(self, number: Integers) -> None:
        """Find each channel's row of the frame, -1 for none; frames seldom differ in this."""
        layout = number.tobytes()
        if layout != self._last_order:
            row = {channel: i for i, channel in enumerate(number.tolist())}
            if len(row) != number.size:
                raise self._error('a channel appears twice in the frame')
            wanted = self._channels.tolist()
            self._rows = np.array([row.get(c, -1) for c in wanted], dtype=np.int64)
            self._last_order = layout


@kernel
def fill_frame(given, marks, rows, largest, spares_dead, flux, codes, received):  # type: ignore[no-untyped-def]
    """Write a frame's fluxes (S, K) in a table's order, and what each reading is.

    ``rows`` (S,): each sensor's row of the frame, -1 for none. ``largest``: of a component, T.
    ``codes`` (S,): places in `FAULTS`. ``received`` (K,), False on entry: emitters
    that a usable sensor receives. Returns whether some are received and some are not.
    """
    count, width = flux.shape
    for s in range(count):
        row = rows[s]
        if row < 0:
            codes[s] = MISSING_CODE
            for k in range(width):
                flux[s, k] = complex(math.nan, math.nan)
            continue
        bits = marks[row]
        codes[s] = FLAGGED_CODE if bits else GOOD
        for bit, code in FLAG_CODES:
            if bits & bit:
                codes[s] = code
                break
        for k in range(width):
            value = given[row, k]
            flux[s, k] = value
            there = math.isfinite(value.real) and math.isfinite(value.imag) and value != 0.0
            if there and bits == 0:
                received[k] = True
    number = 0
    for k in range(width):
        number += received[k]
    some_dead = 0 < number < width
    for s in range(count):
        if rows[s] < 0:
            continue
        finite, sound = True, True
        for k in range(width):
            if some_dead and spares_dead and not received[k]:
                flux[s, k] = 0.0
                continue
            real, imag = flux[s, k].real, flux[s, k].imag
            # A comparison with NaN is false, so this is also what is not finite.
            if abs(real) < largest and abs(imag) < largest:
                continue
            sound = False
            if not math.isfinite(real):
                finite, real = False, math.nan
            if not math.isfinite(imag):
                finite, imag = False, math.nan
            flux[s, k] = complex(real, imag)
        if codes[s] == GOOD and not sound:
            codes[s] = ABSURD_CODE if finite else NOT_FINITE_CODE
    return some_dead


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
    """Compare readings (S, K) with those of the ring (S, K, D), and put them into it.

    ``codes`` (S,): readings with another than 0 are not looked at. ``filled``: how many frames the
    ring holds; ``newest``: the place of the last one. ``sums`` (S, D, 2), the runs' odds by
    distance in frames, goes on. ``ages`` (S,): how many frames ago the reading was the same, 0 for
    a new one. Returns whether there is any that is not new.
    """
    width, depth = ring.shape[1:]
    terms, place, some = np.empty((width, 5)), (newest + 1) % depth, False
    for s in range(flux.shape[0]):
        ages[s] = 0
        if codes[s] != 0:
            for d in range(depth):
                sums[s, d, 0] = sums[s, d, 1] = 0.0
            for k in range(width):
                ring[s, k, place] = complex(math.nan, math.nan)
            continue
        count = _fill_terms(flux[s], least, terms)
        for d in range(filled):
            exact, scaled = 0.0, 0.0
            for i in range(count):
                k = int(terms[i, 0])
                off = flux[s, k] - ring[s, k, newest - d]  # from the end where it is negative
                square = off.real * off.real + off.imag * off.imag
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
            ring[s, k, place] = flux[s, k]
    return some


class Freshness:
    """Finds readings that repeat an earlier one.

    ``age_s`` (S,) is how long ago the same reading came, s, for the last frame that had any; 0
    for new ones.
    """

    def __init__(self) -> None:
        self._forget((0, 0))

    def _forget(self, shape: tuple[int, int]) -> None:
        self._ring = np.full((*shape, DEPTH), np.nan, dtype=np.complex128)
        self._stamps = np.zeros(DEPTH, dtype=np.int64)
        self._sums = np.zeros((shape[0], DEPTH, 2))
        self.age_s = np.zeros(shape[0])
        self._ages = np.zeros(shape[0], dtype=np.int64)
        self._filled, self._newest = 0, -1

    def judged(self, frame: Frame, noise_t: float) -> Frame:
        """Return the next frame of a stream with its stuck readings marked.

        ``noise_t`` is the stated noise of a phasor component, T.
        """
        if frame.goes_back or self._ring.shape[:2] != frame.flux.shape:
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
