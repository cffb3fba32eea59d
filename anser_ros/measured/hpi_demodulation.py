"""Turns raw samples of SQUID channels into phasors of several tones, and each channel's noise."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from anser_ros.errors import FitError

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

DRIFT_ORDER = 2
"""Degree of the polynomial that follows a channel's drift within an epoch."""
LEAST_PROMINENCE = 20.0
"""A tone stands above the median of the spectrum by this factor."""
WINDOW_BINS = 2
"""Bins of the spectrum by which a frequency may be moved off its peak at most."""
OFF_TONE_HZ = (4.0, 16.0)
"""Distance from the nearest tone at which a channel's noise is measured, Hz."""


@dataclass(frozen=True)
class Tones:
    """Holds phasors of an epoch.

    Attributes
    ----------
    frequencies_hz : ndarray, shape (K,)
    phasors : ndarray, shape (K, S) complex
        In the samples' unit, referred to the common phase of each tone: in phase = real part.
    noise : ndarray, shape (S,)
        Standard deviation of one component of a phasor, from frequencies next to the tones.
    """

    frequencies_hz: Array
    phasors: Complex
    noise: Array


def _design(time_s: Array, frequencies_hz: Array) -> Array:
    age = time_s - time_s.mean()
    drift = [(age / age.max()) ** k for k in range(DRIFT_ORDER + 1)]
    angle = 2.0 * np.pi * np.outer(frequencies_hz, age)
    return np.stack([*drift, *np.cos(angle), *np.sin(angle)], axis=1)


def _solve(samples: Array, design: Array, count: int) -> tuple[Complex, Array]:
    solution = np.linalg.lstsq(design, samples.T, rcond=None)[0]
    cosine = solution[DRIFT_ORDER + 1 : DRIFT_ORDER + 1 + count]
    phasors = cosine - 1j * solution[DRIFT_ORDER + 1 + count :]
    return phasors, np.asarray(samples.T - design @ solution)


def find_tones(samples: Array, rate_hz: float) -> Array:
    """Return the frequencies (Hz) of the tones that all channels (S, T) share.

    Peaks of the mean spectrum are removed one by one, so that a tone inside the window's skirts
    of a stronger one is found too; the joint least-squares fit settles the frequencies.

    Raises
    ------
    FitError
        When no tone stands out.
    """
    count = samples.shape[1]
    time = np.arange(count) / rate_hz
    axis = np.fft.rfftfreq(count, 1.0 / rate_hz)
    tones: list[float] = []
    left = samples - samples.mean(axis=1, keepdims=True)
    while len(tones) < 16:
        spectrum = np.sqrt(np.mean(np.abs(np.fft.rfft(left * np.hanning(count))) ** 2, axis=0))
        spectrum[axis < 5.0] = 0.0
        peak = int(np.argmax(spectrum))
        if spectrum[peak] < LEAST_PROMINENCE * np.median(spectrum):
            break
        tones.append(float(axis[peak]))
        tones = _settle(samples, time, tones, axis[1])
        left = _solve(samples, _design(time, np.array(tones)), len(tones))[1].T
    if not tones:
        raise FitError('no tone stands out of the epoch')
    return np.sort(np.array(tones))


def _settle(samples: Array, time_s: Array, tones: list[float], bin_hz: float) -> list[float]:
    """Frequencies of least residual, within a bin or two of where they start."""
    _, basis = np.linalg.eigh(samples.T @ samples)
    leading = (samples @ basis[:, -24:]) @ basis[:, -24:].T
    start = np.array(tones)

    def misfit(shift: Array) -> float:
        left = _solve(leading, _design(time_s, start + bin_hz * shift), len(start))[1]
        return float(np.sum(left**2) / np.sum(leading**2))

    options = {'xatol': 1e-5, 'fatol': 1e-12, 'maxiter': 400 * len(start)}
    shift = minimize(misfit, np.zeros(len(start)), method='Nelder-Mead', options=options).x
    return [float(f) for f in start + bin_hz * np.clip(shift, -WINDOW_BINS, WINDOW_BINS)]


def demodulate(
    samples: Array, rate_hz: float, frequencies_hz: Array, reference: NDArray[np.bool_]
) -> Tones:
    """Fit all tones and the drift of every channel at once by least squares.

    Parameters
    ----------
    samples : ndarray, shape (S, T)
    rate_hz : float
    frequencies_hz : ndarray, shape (K,)
    reference : ndarray of bool, shape (S,)
        Channels that define a tone's common phase.

    Returns
    -------
    Tones
    """
    time = np.arange(samples.shape[1]) / rate_hz
    phasors, left = _solve(samples, _design(time, frequencies_hz), len(frequencies_hz))
    phase = 0.5 * np.angle(np.sum(phasors[:, reference] ** 2, axis=1))
    beside = _beside(frequencies_hz)
    stray = np.array(
        [_solve(left.T, _design(time, np.array([f])), 1)[0][0] for f in beside.tolist()]
    )
    noise = np.sqrt(0.5 * np.mean(np.abs(stray) ** 2, axis=0))
    return Tones(frequencies_hz, phasors * np.exp(-1j * phase)[:, None], noise)


def _beside(frequencies_hz: Array) -> Array:
    near, far = OFF_TONE_HZ
    low, high = frequencies_hz.min(), frequencies_hz.max()
    below = np.arange(low - far, low - near + 0.1, 2.0)
    above = np.arange(high + near, high + far + 0.1, 2.0)
    return np.concatenate([below[below > 5.0], above])
