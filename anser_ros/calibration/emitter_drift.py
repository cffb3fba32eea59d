"""Finds emitters whose strength changes during a scan, from the references.

A change of an emitter's strength changes all references' readings of it by one factor, and nothing
else. Metal changes each of them by another one.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from anser_ros.calibration.disturbances import stretches
from anser_ros.field.measurements import Measurements
from anser_ros.settings import RefitSettings

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

FEWEST_SENSORS = RefitSettings.min_references
"""References that have to be read throughout: with fewer, metal may look like a strength."""
LEAST_DRIFT = 2e-4
"""Change of a strength (rms, relative) from which on it is one; it moves a pose by a hundredth of
a millimetre."""
CERTAIN = 5.0
"""The same in standard deviations of what noise makes of it: of a mean over the session, noise
alone hardly ever makes five times what it usually does."""
COMMON = 0.995
"""Share of the power of an emitter's changes that one factor must explain: all of a drift, but of
a large metal body that comes up from below up to 97 %."""


def emitter_strength(reference: Measurements) -> ComplexArray:
    """Return each emitter's strength relative to its median over a scan, shape (F, K), complex.

    It is one for emitters that do not drift, and for all emitters if there are too few references.

    ``reference``: F frames of the R references.
    """
    count, emitters = len(reference.time), reference.flux.shape[2]
    out = np.ones((count, emitters), dtype=np.complex128)
    good = reference.valid.all(axis=0)
    bins = stretches(reference.time)
    size = np.bincount(bins)
    if good.sum() < FEWEST_SENSORS or (size > 0).sum() < FEWEST_SENSORS:
        return out
    flux = reference.flux[:, good]
    noise = np.median(np.abs(np.diff(flux, axis=0)) ** 2, axis=0) / np.log(2.0) / 2.0
    seen = np.flatnonzero(size)
    means = np.array([flux[bins == b].mean(axis=0) for b in seen])
    middle = np.array([reference.time[bins == b].mean() for b in seen])
    for k in range(emitters):
        steady = np.median(means[:, :, k].real, axis=0) + 1j * np.median(
            means[:, :, k].imag, axis=0
        )
        weight = 1.0 / np.maximum(noise[:, k], 1e-30)
        total = float((weight * np.abs(steady) ** 2).sum())
        gain = (means[:, :, k] * (weight * steady.conj())).sum(axis=1) / max(total, 1e-300)
        change = means[:, :, k] - steady
        power = float((weight * np.abs(change) ** 2 * size[seen, None]).sum())
        chance = float(change.size)
        common = float((total * np.abs(gain - 1.0) ** 2 * size[seen]).sum())
        drift = float(np.sqrt(np.mean(np.abs(gain - 1.0) ** 2)))
        by_noise = np.sqrt(1.0 / max(total * float(np.mean(size[seen])), 1e-300))
        if drift < max(LEAST_DRIFT, CERTAIN * by_noise):
            continue
        if common > COMMON * (power - chance):
            out[:, k] = CubicSpline(middle, gain)(reference.time)
    return out


def at_strength(measurements: Measurements, time: Array, strength: ComplexArray) -> Measurements:
    """Return measurements as emitters of constant strength would have given them.

    ``time`` (G,): s, ascending. ``strength`` (G, K): of the emitters at these times, as of
    `emitter_strength`.
    """
    now = np.stack([np.interp(measurements.time, time, column) for column in strength.T], axis=1)
    return replace(measurements, flux=measurements.flux / now[:, None, :])
