"""Compares references' readings with their baselines, with a reason for each unusable one."""

import math

import numpy as np
from numpy.typing import NDArray

from anser_ros.frames import faults
from anser_ros.frames.intake import Frame
from anser_ros.refit import health

ComplexArray = NDArray[np.complex128]

SILENT_CODE, NO_BASELINE_CODE = len(faults.FAULTS), len(faults.FAULTS) + 1
"""Codes of what only a baseline shows, after those of `frames.faults`."""
_OF_KIND = {
    'missing': health.MISSING,
    'not_finite': health.NOT_FINITE,
    'absurd': health.ABSURD,
    'stuck': health.STUCK,
}
_REASONS = (
    health.OK,
    *(_OF_KIND.get(fault.kind, health.FLAGGED) for fault in faults.FAULTS if fault is not None),
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

    def read(self, frame: Frame) -> tuple[NDArray[np.bool_], list[str]]:
        """Return which readings (S,) of a judged frame can be used, and why others cannot."""
        flux, codes = frame.flux, frame.codes
        with np.errstate(over='ignore', invalid='ignore'):  # of readings that are absurd
            is_silent = (flux.real**2 + flux.imag**2).sum(axis=1) < self._least
        codes = np.where((codes == faults.GOOD) & is_silent, SILENT_CODE, codes)
        codes = np.where(np.isnan(self._least), NO_BASELINE_CODE, codes)
        return codes == faults.GOOD, [_REASONS[code] for code in codes.tolist()]


class NoiseUnits:
    """Turns changes of readings into units of the nominal noise, in phase with what drives the
    metal.

    Parameters
    ----------
    baseline : ndarray, shape (S, K), complex
        Readings without the metal, T; NaN for a coil that has none.
    phase : ndarray, shape (K,), complex
        Unit phasors of what drives the metal.
    noise_t : float
        Nominal noise of a phasor component, T.

    Attributes
    ----------
    size : float
        Root mean square of a component of the baseline, in the same units.
    """

    def __init__(self, baseline: ComplexArray, phase: ComplexArray, noise_t: float) -> None:
        self._scale = phase.conj() / noise_t
        known = baseline[np.isfinite(baseline)]
        power = float((np.abs(known) ** 2).mean()) if known.size else 0.0
        self.size = math.sqrt(0.5 * power) / noise_t

    def of(self, change: ComplexArray) -> NDArray[np.float64]:
        """Return changes (S, K), T, as real and imaginary parts, shape (S, K, 2)."""
        scaled = change * self._scale
        return scaled.view(np.float64).reshape(*scaled.shape, 2)
