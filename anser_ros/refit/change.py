"""Decides which readings are refitted, and averages them, with their noise, at rest."""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from anser_ros.refit.evidence import median

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

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
    """Estimates the noise from second differences in time, in which smooth changes cancel.

    Attributes
    ----------
    nominal_t : float
        T; the estimate starts here and stays within a factor 20.
    """

    nominal_t: float
    _previous: list[ComplexArray] = field(default_factory=list)
    _ratio: float = 1.0
    _known: int = 1

    def update(self, flux: ComplexArray) -> float:
        """Take in one frame (S, K), and return the noise over the nominal.

        What is left out is NaN: noise may be its fault, which must not raise that of the others.
        """
        if len(self._previous) == 2:
            bend = flux - 2.0 * self._previous[1] + self._previous[0]
            power = (bend.real**2 + bend.imag**2).mean(axis=1)
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

    Attributes
    ----------
    longest : int
        Most frames that are averaged; 1 switches it off.
    """

    longest: int
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
