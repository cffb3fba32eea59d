"""Finds readings that jump: metal moves steadily and changes all references, faults do neither.

One wrong reference contradicts the others. If many fail at one moment, they outvote the good ones,
and their later readings may look like metal. The moment itself distinguishes the two: each reading
is compared with its predicted course, and all deviations are judged together. They are explained
either by metal, which must have the proportions of the emitters' fields at some place and cannot
have moved far since the last frame, or by coils that jumped independently, beside others that did
not.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from anser_ros.arrays import Array, Booleans, ComplexArray, Integers
from anser_ros.refit.frame import NoiseUnits, power_of
from anser_ros.refit.health import FAULT_ODDS, FAULT_SCALES, left_out
from anser_ros.refit.posterior import STRENGTHS, Bank, FrameEvidence, log_sum, median
from anser_ros.stamps import NANO

LEAST_JUMP_POWER = 5.0
"""Power of a jump, over noise's, from which on it is judged: noise reaches it once in a year."""
FARTHEST = 3.0
"""Steps, in units of the last one, over which a course is carried on, and its noise with it."""
LARGEST_RATE = 0.05
"""Rate at which metal may take the readings off their course, as a part of the baseline's size
each second; an X-ray head that comes close stays below the noise, a hundredth of this at 25 Hz."""
UNPREDICTED = 0.1
"""Share of a coil's jump, in power, that may differ from what the others predict where metal has
appeared from one frame to the next, and share of the coils for which it may be more."""
COMMON = 0.003
"""Relative step of all emitters at once from which on it is no drift of theirs. Currents drift
slowly, each on its own; a gain that all references share, in their amplifier, steps like that."""
SURE = 3.0
"""Standard deviations that an emitter's step must stay below `COMMON` for a fault to be over."""
BEND_VARIANCE = 6.0
"""Variance of a reading less twice the one before plus the one before that, in units of one's."""
RETURNED = 0.1
"""Part of a jump that may be left where a reference has jumped back: metal moved meanwhile."""


class Jumps(NamedTuple):
    """States how far (S, K), T, a frame's readings are off their courses; NaN for no reading.

    ``spread`` (S,) is the noise of that, in units of a reading's, and ``since_s`` the time since
    the last reading of most references, infinite where there was none.
    """

    off: ComplexArray
    spread: Array
    since_s: float


def _where(rows: Booleans, new: ComplexArray, old: ComplexArray) -> ComplexArray:
    """Return new values (S, K) in some rows (S,), the old ones in the others."""
    return new if rows.all() else np.where(rows[:, None], new, old)


class Courses:
    """Follows where each reference's change is on its way to, and how far those that jumped are
    off.

    ``count``, ``width``: references S and emitters K.
    """

    def __init__(self, count: int, width: int) -> None:
        self._last = np.zeros((count, width), dtype=np.complex128)
        self._step = np.zeros((count, width), dtype=np.complex128)
        self._last_ns = np.full(count, np.nan)
        self._step_ns = np.full(count, np.nan)
        # A jump in the middle of a window shows in two frames: what was read before both.
        self._before = self._last, self._last
        self._away = np.zeros((count, width), dtype=np.complex128)
        self._farthest = np.zeros(count)
        # All readings before the first of the present jumps, and when that was.
        self._sound, self._sound_ns = self._last, 0.0
        self._stamp_ns = 0.0

    def follow(self, stamp_ns: int, change: ComplexArray) -> Jumps:
        """Take in changes (S, K), T, and return how far they are off their courses.

        A reference that has no course yet is expected as in the baseline. One without a reading
        (NaN) keeps its course.
        """
        ahead_ns = stamp_ns - self._last_ns
        steps = ahead_ns / self._step_ns
        steps = np.where((steps > 0.0) & (steps <= FARTHEST), steps, 0.0)
        known = np.isfinite(self._last_ns)
        variance = np.where(known, 1.0 + (1.0 + steps) ** 2 + steps**2, 1.0)
        step = change - self._last
        off = step - steps[:, None] * self._step
        read = np.isfinite(power_of(change))
        new = read & known
        since_s = median(ahead_ns[new]) * NANO if new.any() else np.inf
        self._step = _where(new, step, self._step)
        self._step_ns = np.where(new, ahead_ns, np.where(read, np.nan, self._step_ns))
        first, second = self._before
        self._before = _where(read, second, first), _where(read, self._last, second)
        self._last = _where(read, change, self._last)
        self._stamp_ns = float(stamp_ns)
        self._last_ns = np.where(read, self._stamp_ns, self._last_ns)
        return Jumps(off, np.sqrt(variance), since_s)

    def note(self, jumps: Jumps, coils: Integers) -> None:
        """Remember which references have jumped: a jump is no part of a course."""
        if not self._is_away.any():
            self._sound = self._before[0]
            self._sound_ns = self._stamp_ns - 2.0 * jumps.since_s / NANO
        self._step_ns[coils] = np.nan
        first = ~self._is_away[coils]
        whole = (self._last - self._before[0])[coils]
        self._away[coils] += np.where(first[:, None], whole, jumps.off[coils])
        size = np.linalg.norm(self._away[coils], axis=1)
        self._farthest[coils] = np.maximum(self._farthest[coils], size)

    @property
    def _is_away(self) -> Booleans:
        return np.asarray(self._farthest > 0.0)

    def away(self) -> Integers:
        """Return the references that are off by jumps."""
        return np.flatnonzero(self._is_away)

    @property
    def readable(self) -> Booleans:
        """Return which references (S,) have been read now, and twice before."""
        is_read = self._last_ns == self._stamp_ns
        return np.asarray(is_read & np.isfinite(self.bend()).all(axis=1))

    def bend(self) -> ComplexArray:
        """Return readings less twice those before plus those before that (S, K), T."""
        return np.asarray(self._last - 2.0 * self._before[1] + self._before[0])

    def since_sound(self) -> tuple[ComplexArray, float]:
        """Return the change (S, K), T, since before the first of the present jumps, and its s."""
        return self._last - self._sound, (self._stamp_ns - self._sound_ns) * NANO

    def forget_jumps(self) -> Integers:
        """Take the readable references for back from jumps, and return which of them were off."""
        away = np.flatnonzero(self._is_away & self.readable)
        self._away[away], self._farthest[away] = 0.0, 0.0
        return away

    def returned(self, noise_t: float) -> Integers:
        """Return the references that are no longer off by jumps, which is then forgotten.

        One has jumped back when little of its jump is left. All have that jumped when all of them
        read what they did in the baseline: they may have gone wrong unseen, in small steps, and
        then the end of the fault was taken for a jump.

        ``noise_t``: of a phasor component, T.
        """
        away, size = self._is_away, np.linalg.norm(self._away, axis=1)
        calm = math.sqrt(LEAST_JUMP_POWER * 2 * self._away.shape[1]) * noise_t
        back = away & (size < np.maximum(RETURNED * self._farthest, calm))
        if (np.linalg.norm(self._last[away], axis=1) < calm).all():
            back = away
        self._away[back], self._farthest[back] = 0.0, 0.0
        return np.flatnonzero(back)


def _bounded(bank: Bank, seen: FrameEvidence, largest: float) -> FrameEvidence:
    """Return the evidence for metal that changes readings by no more than so many noise units."""
    count = max(1, int(np.count_nonzero(largest**2 >= STRENGTHS)))
    curve, strength = seen.curve[..., :count], np.zeros_like(seen.strength)
    top = curve.max(axis=2, keepdims=True)
    weight = np.exp(curve - top)
    total = weight.sum(axis=2, keepdims=True)
    evidence = (top + np.log(total / len(STRENGTHS))).sum(axis=(1, 2)) + bank.log_prior
    strength[:, :, :count] = weight / total
    best, unknown = int(evidence.argmax()), np.empty(0)
    return replace(seen, log_evidence=evidence, strength=strength, best=best, weighted=unknown)


def _is_predicted(bank: Bank, seen: FrameEvidence, jumps: Array) -> bool:
    """Return whether each coil's jump is what the others predict, as when metal is put down."""
    _, residual = left_out(bank, seen)
    noise = LEAST_JUMP_POWER * jumps[0].size * seen.noise**2
    off = (residual**2).sum(axis=(1, 2))
    size = (jumps**2).sum(axis=(1, 2)) + ((jumps - residual) ** 2).sum(axis=(1, 2))
    concerned = size > noise
    strange = concerned & (off > UNPREDICTED * size)
    return int(strange.sum()) <= UNPREDICTED * int(concerned.sum())


def jumped(
    bank: Bank, seen: FrameEvidence, jumps: Array, spread: float, drift: float, largest: float
) -> Integers:
    """Return the coils that jumped by themselves, as numbers among those in use; often none.

    ``seen`` is the evidence of the ``jumps`` (U, K, 2), noise units over their ``spread``, as if
    they were a change; ``spread`` is the noise of a jump in units of a reading's, ``drift`` the
    prior deviation of an emitter's strength, ``largest`` the change in noise units that metal may
    have made since the last frame.
    """
    free, seen = seen, _bounded(bank, seen, largest)
    freedom = bank.width
    # In phase and quadrature apart: most faults are in one of the two.
    power = (jumps**2).sum(axis=1)
    quiet = -0.5 * power / seen.noise**2 - freedom * np.log(seen.noise)
    scales = FAULT_SCALES[:, None, None]
    curve = -0.5 * power / scales**2 - freedom * np.log(scales)
    top = curve.max(axis=0)
    broad = top + np.log(np.exp(curve - top).mean(axis=0))
    apart = np.maximum(quiet, broad)
    # Before all else: by a drift of all emitters the coils predict each other's jumps too.
    if _is_common_gain(bank, seen, jumps, spread * drift):
        return np.arange(len(jumps))
    odds = apart.sum() - log_sum(seen.log_evidence)
    if odds > FAULT_ODDS and not _is_predicted(bank, free, jumps):
        return np.flatnonzero((broad > quiet).any(axis=1))
    return np.empty(0, dtype=np.int64)


def faults_have_ended(
    courses: Courses, units: NoiseUnits,
    bank_of: Callable[[Booleans], tuple[Bank, object]], level: float, drift: float,
) -> bool:  # fmt: skip
    """Return whether jumps are over: metal alone explains how all has changed since before them.

    Some references must be off by jumps, and the newest frame go on from the two before it. Near
    metal a common gain can pass for metal: then the answer is no. ``bank_of`` returns the
    hypotheses for references (S,) first; ``level`` is the noise of a reading over the nominal one,
    ``drift`` the prior deviation of an emitter's strength.
    """
    readable = courses.readable
    power = (units.of(courses.bend())[readable] ** 2).mean(axis=(1, 2)) / BEND_VARIANCE
    if not courses.away().size or not power.size:
        return False
    if (power > LEAST_JUMP_POWER * level**2).any():
        return False
    change, seconds = courses.since_sound()
    spread = math.sqrt(2.0)
    parts = units.of(change)[readable] / spread
    bank = bank_of(readable)[0]
    seen = bank.evaluate(parts.reshape(-1, 2), level)
    mean, variance = bank.drifts(seen, seen.best)
    step = np.hypot(*mean.T) + SURE * np.sqrt(variance.max(axis=1))
    if (spread * drift * step > COMMON).any():
        return False
    largest = LARGEST_RATE * seconds * units.size
    return not jumped(bank, seen, parts, spread, drift, largest).size


def _is_common_gain(bank: Bank, seen: FrameEvidence, jumps: Array, drift: float) -> bool:
    """Return whether all emitters have stepped alike, which is the references' doing."""
    mean, _ = bank.drifts(seen, seen.best)
    step = drift * (mean @ np.array([1.0, 1.0j]))
    left = jumps.reshape(-1, 2) - bank.drift @ mean
    explained = float((left**2).sum()) < UNPREDICTED * float((jumps**2).sum())
    return explained and float(np.abs(step).min()) > COMMON
