"""Whether a channel's readings are new: a reading without new noise is an old one.

Each reading is compared with the channel's own readings of the last seconds. Two explanations
compete: *new*, the difference holds the noise of two readings; *stuck*, it holds rounding alone,
or, since a flux is a voltage over a measured current, the noise of the current too. The logarithm
of the odds is summed over frames that follow one another with the same distance in time; odds of
``exp(h)`` come about by chance with a probability of ``exp(-h)`` at most (Ville's inequality),
however many emitters there are and however long the run is. So with eight emitters one exact
repetition will do, and one emitter needs a few.
"""

import math
from dataclasses import replace

import numba
import numpy as np
from numpy.typing import NDArray

from anser_ros.frames.faults import STUCK_CODE
from anser_ros.frames.intake import BACK, NANO, Frame

LEAST_NOISE = 0.1
"""The noise of a reading is at least so many times the stated one. Larger, and a lab that states
its noise several times too large has readings called stuck that are quiet; smaller, and a stuck
column whose current is still measured needs longer to be seen."""
CURRENT_NOISE = 2e-5
"""Relative change of a stuck column's flux by the noise of the current that it is divided by. It
is some times that of a 16-bit converter over 20 ms. Smaller, and a stuck column of a unit with
noisier currents passes for new; larger, and a weak column takes longer to be told from it."""
ROUNDING = 2.0**-21
"""Relative difference of two readings of the same samples: fluxes travel as float32, rounded to
2^-24, after a fit to tones of another phase. Larger, and readings of little noise near the board
look like copies; smaller, and copies look new."""
CERTAIN = 35.0
"""Logarithm of the odds from which on a reading is stuck. A comparison is wrong with a probability
of exp(-35) = 6e-16 at most: with 100 channels at 50 Hz, once in a century.
Smaller, and a still tool is called stuck; larger, and a few emitters need a longer run."""
DEPTH = 100
"""Readings that are kept of each channel: two seconds at 50 Hz, so the copies of a buffer of up to
that length are found. Fewer, and a longer buffer passes; more, and each frame costs more."""
HOPELESS = -60.0
"""Logarithm of the odds of one comparison below which the rest of it is not worked out."""


@numba.njit(cache=True, error_model='numpy')
def _odds(now, then, width, weakest, least):  # type: ignore[no-untyped-def]
    """Logarithm of the odds that a reading repeats another: exactly, and but for its currents."""
    exact, scaled = 0.0, 0.0
    for i in range(width):
        # The weakest emitter tells most of noise: it comes first, and mostly ends the comparison.
        k = (weakest + i) % width
        size = math.hypot(now[k].real, now[k].imag)
        if not size > 0.0 or not math.isfinite(then[k].real + then[k].imag):
            continue
        x, y = now[k].real - then[k].real, now[k].imag - then[k].imag
        square = (x * x + y * y) / (4.0 * least * least)
        for way in range(2):
            relative = ROUNDING if way == 0 else CURRENT_NOISE
            share = min((relative * size / least) ** 2, 1.0)
            odds = -math.log(share) - square * (1.0 / share - 1.0)
            exact, scaled = (exact + odds, scaled) if way == 0 else (exact, scaled + odds)
        if exact < HOPELESS and scaled < HOPELESS:
            break
    return exact, scaled


@numba.njit(cache=True, error_model='numpy')
def compare(flux, usable, ring, filled, newest, sums, least, certain, ages):  # type: ignore[no-untyped-def]
    """Compare readings (S, K) with those of the ring (D, S, K) and write ``ages`` (S,).

    ``filled``: how many frames the ring holds; ``newest``: the place of the last one. ``sums``
    (S, D, 2), the runs' odds by distance in frames, goes on. ``ages``: how many frames ago the
    reading was the same, 0 for a new one.
    """
    depth = ring.shape[0]
    for s in range(flux.shape[0]):
        ages[s] = 0
        if not usable[s]:
            sums[s] = 0.0
            continue
        weakest, smallest = 0, math.inf
        for k in range(flux.shape[1]):
            size = math.hypot(flux[s, k].real, flux[s, k].imag)
            if 0.0 < size < smallest:
                weakest, smallest = k, size
        for d in range(filled):
            then = ring[(newest - d) % depth, s]
            exact, scaled = _odds(flux[s], then, flux.shape[1], weakest, least)
            for way in range(2):
                total = max(sums[s, d, way] + (exact if way == 0 else scaled), 0.0)
                sums[s, d, way] = min(total, 2.0 * certain)
                if total > certain and ages[s] == 0:
                    ages[s] = d + 1
        sums[s, filled:] = 0.0


class Freshness:
    """Tells readings that repeat an earlier one.

    Attributes
    ----------
    age_s : ndarray, shape (S,)
        How long ago the same reading came, s, for the last frame that was judged; 0 for new ones.
    """

    def __init__(self) -> None:
        self.age_s: NDArray[np.float64] = np.zeros(0)
        self._forget((0, 0))

    def _forget(self, shape: tuple[int, int]) -> None:
        self._ring = np.full((DEPTH, *shape), np.nan, dtype=np.complex128)
        self._stamps = np.zeros(DEPTH, dtype=np.int64)
        self._sums = np.zeros((shape[0], DEPTH, 2))
        self._ages = np.zeros(shape[0], dtype=np.int64)
        self._filled, self._newest = 0, -1

    def judged(self, frame: Frame, noise_t: float) -> Frame:
        """Return the frame with its stuck readings marked.

        Parameters
        ----------
        frame : Frame
            The next one of a stream.
        noise_t : float
            Stated noise of a phasor component, T.
        """
        if frame.jump == BACK or self._ring.shape[1:] != frame.flux.shape:
            self._forget(frame.flux.shape)
        usable = frame.usable
        compare(
            frame.flux, usable, self._ring, self._filled, self._newest, self._sums,
            LEAST_NOISE * noise_t, CERTAIN, self._ages,
        )  # fmt: skip
        there = self._stamps[(self._newest + 1 - self._ages) % DEPTH]
        self.age_s = np.where(self._ages > 0, (frame.stamp_ns - there) * NANO, 0.0)
        self._newest = (self._newest + 1) % DEPTH
        self._filled = min(self._filled + 1, DEPTH)
        self._ring[self._newest] = np.where(usable[:, None], frame.flux, np.nan)
        self._stamps[self._newest] = frame.stamp_ns
        if not self._ages.any():
            return frame
        return replace(frame, codes=np.where(self._ages > 0, STUCK_CODE, frame.codes))

    def reason(self, row: int) -> str:
        """What is said of a stuck reading of the last frame."""
        return f'stuck: the same reading as {self.age_s[row]:.2g} s ago'
