"""Turns a frame of the references into a change since the baseline, in units of the noise.

The steps, in the order in which a frame passes them: the baseline is the mean reading of the last
moments without metal; a reading that is silent, or has no baseline, is named; the noise is
measured from second differences in time; readings are averaged while they do not change.
"""

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from anser_ros.arrays import Array, Booleans, ComplexArray
from anser_ros.errors import FitError
from anser_ros.field.model import FieldModel
from anser_ros.frames.intake import FAULTS, GOOD, Frame
from anser_ros.physics.sensor import SensorTable
from anser_ros.refit import health
from anser_ros.refit.posterior import median

FEWEST_BASELINE_FRAMES = 3
"""Frames that a baseline needs at least: their scatter is its noise."""
MOST_FRAMES = 2000
"""Most recent frames that a baseline is averaged over, 40 s at 50 Hz."""


class ReadingWindow:
    """Holds the most recent readings of a set of sensors.

    ``span_s``: how far back readings are kept, s of their stamps. Raises `FitError` when the span
    is not positive.
    """

    def __init__(self, sensors: SensorTable, emitters: int, span_s: float) -> None:
        if not span_s > 0:
            raise FitError(f'the span of a baseline must be positive, got {span_s}')
        self._shape = (len(sensors), emitters)
        self._span_ns = round(1e9 * span_s)
        self._frames: deque[tuple[int, ComplexArray]] = deque(maxlen=MOST_FRAMES)

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def full(self) -> bool:
        """Return whether the readings reach back over (nearly) the whole span."""
        if len(self._frames) < FEWEST_BASELINE_FRAMES:
            return False
        return self._frames[-1][0] - self._frames[0][0] >= 0.9 * self._span_ns

    def clear(self) -> None:
        """Forget all readings that were taken in so far."""
        self._frames.clear()

    def add(self, frame: Frame) -> None:
        """Take in a judged frame of the sensors; a jump back in time restarts it.

        Raises `FitError` when the number of emitters is another one.
        """
        if frame.flux.shape != self._shape:
            raise FitError(
                f'readings must be of {self._shape[1]} emitters, got {frame.flux.shape}'
            )
        stamp_ns = frame.stamp_ns
        if self._frames and stamp_ns < self._frames[-1][0]:
            self._frames.clear()
        self._frames.append((stamp_ns, frame.readings))
        while stamp_ns - self._frames[0][0] > self._span_ns:
            self._frames.popleft()

    @property
    def frames(self) -> ComplexArray:
        """Return all readings (F, S, K), T, in the order of time; NaN in place of bad ones."""
        return np.stack([frame for _, frame in self._frames])

    def mean(self) -> ComplexArray:
        """Return the mean reading (S, K), T, with NaN for sensors that are bad in half the frames.

        Raises `FitError` when there are too few frames, or no sensor has good readings.
        """
        if len(self._frames) < FEWEST_BASELINE_FRAMES:
            raise FitError(
                f'a baseline needs {FEWEST_BASELINE_FRAMES} frames of reference readings, '
                f'there are {len(self._frames)}'
            )
        stack = self.frames
        good = np.asarray(np.isfinite(stack).all(axis=2))
        count = np.asarray(good.sum(axis=0))
        total = np.where(good[:, :, None], stack, 0.0).sum(axis=0)
        enough = np.asarray(2 * count >= len(stack))
        if not enough.any():
            raise FitError('no reference sensor has good readings')
        mean = np.full(self._shape, np.nan, dtype=np.complex128)
        mean[enough] = total[enough] / count[enough, None]
        return mean


def power_of(values: ComplexArray) -> Array:
    """Return the sum of the squared magnitudes of each row (S, K), which may overflow."""
    parts = values.view(np.float64)
    return np.asarray(np.einsum('sk,sk->s', parts, parts))


def check_enough(baseline: ComplexArray, needed: int) -> int:
    """Return the number of sensors that have a value in a baseline of shape (S, K).

    Raises `FitError` when there are fewer than are needed.
    """
    count = int(np.isfinite(baseline).all(axis=1).sum())
    if count < needed:
        raise FitError(
            f'a baseline of {count} of {len(baseline)} reference sensors; {needed} are needed'
        )
    return count


def checked_baseline(
    model: FieldModel, references: SensorTable, baseline: ComplexArray
) -> ComplexArray:
    """Return a refit's baseline as an array, shape (S, K), T.

    Raises `FitError` when there are no references, their channels are not unique, or the shape is
    another.
    """
    given = np.asarray(baseline, dtype=np.complex128)
    if len(references) == 0:
        raise FitError('refit: there are no reference sensors')
    if given.shape != (len(references), len(model.emitters)):
        raise FitError(
            f'refit: {len(references)} references and {len(model.emitters)} emitters need a '
            f'baseline of that shape, got {given.shape}'
        )
    if len(set(references.channel.tolist())) != len(references):
        raise FitError('refit: a channel appears twice in the references')
    return given


SILENT_CODE, NO_BASELINE_CODE = len(FAULTS), len(FAULTS) + 1
"""Codes of what only a baseline shows, after those of `frames.intake`."""
_OF_KIND = {
    'missing': health.MISSING,
    'not_finite': health.NOT_FINITE,
    'absurd': health.ABSURD,
    'stuck': health.STUCK,
}
_REASONS = (
    health.OK,
    *(_OF_KIND.get(fault.kind, health.FLAGGED) for fault in FAULTS if fault is not None),
    health.SILENT,
    health.NO_BASELINE,
)
QUIET = 0.05
"""A coil that reads less than this share of its baseline is silent: no metal shields so well."""


class BaselineCheck:
    """Determines which readings can be compared with a baseline (S, K), where that is finite."""

    def __init__(self, baseline: ComplexArray) -> None:
        power = np.asarray((np.abs(baseline) ** 2).sum(axis=1), dtype=np.float64)
        # T^2, below which a coil is silent; NaN without a baseline.
        self._least = np.where(np.isfinite(power), QUIET**2 * power, np.nan)
        lacks = np.isnan(self._least)
        self._lacks = lacks if lacks.any() else None

    def read(self, frame: Frame) -> tuple[Booleans, list[str]]:
        """Return which readings (S,) of a frame can be used, and why not, if any cannot."""
        flux, codes = frame.flux, frame.codes
        is_silent = power_of(flux) < self._least
        codes = np.where((codes == GOOD) & is_silent, SILENT_CODE, codes)
        if self._lacks is not None:
            codes = np.where(self._lacks, NO_BASELINE_CODE, codes)
        readable = codes == GOOD
        return readable, [] if readable.all() else [_REASONS[code] for code in codes.tolist()]


class NoiseUnits:
    """Turns changes of readings into units of the nominal noise, in phase with what drives the
    metal.

    ``phase`` (K,) are unit phasors of what drives the metal; ``size`` is the root mean square of
    a component of the baseline (S, K), in the same units.
    """

    def __init__(self, baseline: ComplexArray, phase: ComplexArray, noise_t: float) -> None:
        self._scale = phase.conj() / noise_t
        known = baseline[np.isfinite(baseline)]
        power = float((np.abs(known) ** 2).mean()) if known.size else 0.0
        self.size = math.sqrt(0.5 * power) / noise_t

    def of(self, change: ComplexArray) -> Array:
        """Return changes (S, K), T, as real and imaginary parts, shape (S, K, 2)."""
        scaled = change * self._scale
        return scaled.view(np.float64).reshape(*scaled.shape, 2)


MEMORY_FRAMES = 50
"""Frames over which the ratio of measured to expected noise is averaged; as long as there are
fewer, over these where it rises: by a ratio that is too small all references seem to jump."""
STEP = 1.1
"""Noise levels are rounded to powers of this, so that tables made for one serve for a while."""

BURST = 5
"""Frames that may follow each other faster than the rate, since they do not arrive evenly."""
MOST_RATE_HZ = 50.0
"""Default of the frame rate, Hz, which turns times into numbers of frames."""


@dataclass
class Pace:
    """Selects the frames that are refitted, at most ``rate_hz`` of them a second.

    Counted in the frames' own stamps: a recording that is replayed at another speed, or read from
    its file, has the same frames refitted.
    """

    rate_hz: float = MOST_RATE_HZ
    _last_ns: int = 0
    _next_ns: float = 0.0

    def is_due(self, stamp_ns: int) -> bool:
        """Return whether the frame of this stamp is to be refitted."""
        period = 1e9 / self.rate_hz
        if stamp_ns < self._last_ns:
            self._next_ns = 0.0
        self._last_ns = stamp_ns
        if stamp_ns < self._next_ns:
            return False
        self._next_ns = max(self._next_ns, stamp_ns - BURST * period) + period
        return True


@dataclass
class NoiseLevel:
    """Estimates the noise from second differences in time, in which smooth changes cancel."""

    nominal_t: float  # T; the estimate starts here and stays within a factor 20
    _previous: list[ComplexArray] = field(default_factory=list)
    _ratio: float = 1.0
    _known: int = 1

    def update(self, flux: ComplexArray) -> float:
        """Take in one frame (S, K), and return the noise over the nominal.

        What is left out is NaN: noise may be its fault, which must not raise that of the others.
        """
        if len(self._previous) == 2:
            bend = flux - 2.0 * self._previous[1] + self._previous[0]
            power = power_of(bend) / bend.shape[1]
            power = power[np.isfinite(power)]
            if power.size:
                # The median over coils, so that a coil that jumps does not count.
                now = min(median(power) / (12.0 * self.nominal_t**2), 4.0 * self._ratio)
                self._known = min(self._known + 1, MEMORY_FRAMES)
                frames = self._known if now > self._ratio else MEMORY_FRAMES
                self._ratio += (now - self._ratio) / frames
                self._ratio = min(max(self._ratio, 1.0 / 400.0), 400.0)
        self._previous = [*self._previous[-1:], flux]
        steps = round(0.5 * math.log(self._ratio) / math.log(STEP))
        return float(STEP**steps)

    @property
    def is_measured(self) -> bool:
        """Return whether frames have had a say: three in a row at least."""
        return self._known > 1

    def forget(self) -> None:
        """Restart after a gap in time; the level is kept."""
        self._previous.clear()


@dataclass
class Average:
    """Keeps the running mean of the readings over the frames in which they do not change.

    Each new frame is compared with the mean so far, given the noise expected of their difference,
    and the mean starts again at the first frame that deviates: a change must be followed without
    delay. A drift below the noise is followed too, late by about `longest` frames. A baseline may
    contain no drift at all, so `integrity.clean_references.check_steady` judges a whole window
    in hindsight.
    """

    longest: int  # most frames that are averaged; 1 switches it off
    _mean: ComplexArray | None = None
    _frames: int = 0

    def update(self, flux: ComplexArray, sigma_t: float) -> tuple[ComplexArray, int]:
        """Take in one frame (S, K) and return the mean with the number of frames in it."""
        if self._mean is None or self._mean.shape != flux.shape:
            self._mean, self._frames = flux.copy(), 1
            return flux, 1
        step = flux - self._mean
        parts = np.ascontiguousarray(step).view(np.float64).ravel()
        power = float(parts @ parts)
        size, same = step.size, True
        if not math.isfinite(power):
            known = np.isfinite(step)
            power, size = float((np.abs(step[known]) ** 2).sum()), int(known.sum())
            same = bool((np.isfinite(flux) == np.isfinite(self._mean)).all())
        expected = 2.0 * sigma_t**2 * (1.0 + 1.0 / self._frames)
        limit = 1.0 + 3.0 / math.sqrt(max(size, 1))
        if not size or not same or power > limit * expected * size:
            self._mean, self._frames = flux.copy(), 1
            return flux, 1
        self._frames = min(self._frames + 1, self.longest)
        self._mean = self._mean + step / self._frames
        return self._mean, self._frames

    def forget(self) -> None:
        """Drop the mean, so that averaging starts again."""
        self._mean, self._frames = None, 0
