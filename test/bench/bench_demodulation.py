"""Demodulation of 48 channels, 20 ms at 40 kS/s: one least-squares fit, rival one FFT each."""

from __future__ import annotations

import harness
import numpy as np

from anser_ros.signals.demodulation import Demodulator

CHANNELS = 48
SAMPLES = 800
TONES = np.array([6000.0, 6170.0, 6340.0, 6510.0, 6690.0, 6860.0, 7030.0, 7200.0])
ROUNDS = 300


def rows() -> list[harness.Row]:
    """Return the rows of the benchmark table."""
    codes = np.random.default_rng(0).integers(-20000, 20000, (SAMPLES, CHANNELS)).astype(np.int16)
    demodulator = Demodulator(40e3, TONES, SAMPLES)
    taper = np.hanning(SAMPLES)
    bins = np.round(TONES * SAMPLES / 40e3).astype(int)

    def rival() -> np.ndarray:
        return np.array([np.fft.rfft(taper * codes[:, c])[bins] for c in range(CHANNELS)])

    ours_ms, rival_ms = (
        1e3 * float(np.median(harness.timed(work, ROUNDS)[0]))
        for work in (lambda: demodulator.demodulate(codes), rival)
    )
    name = 'demodulation of 48 channels, 20 ms window at 40 kS/s'
    return [harness.row(name, ours_ms, 'ms', ('one FFT per channel', rival_ms), target=1.0)]
