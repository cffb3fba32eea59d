"""Measures the accuracy that only the stream itself shows, for the setup document."""

import math
from dataclasses import replace

import numpy as np

from anser_ros.nodes.acquisition_parts.flux_frame import FluxFrame
from anser_ros.nodes.streams.measured_keys import FLUX_NOISE, STAMP_SIGMA
from anser_ros.settings import Accuracy
from anser_ros.wire.setup import Setup

EARLIEST_S = 10.0
"""Least time, s, from one setup document to the next for the sake of the stamps: trackers start
again with it, and a host's load changes within seconds."""
_FACTOR = 2.0
"""Ratio by which the stamps' uncertainty must differ from what was published to be published
again."""


class MeasuredAccuracy:
    """Follows the noise of the first fluxes, and the uncertainty of the stamps."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Start again: the stream is another one."""
        self._noise_t: float | None = None
        self._begun_s = -math.inf
        self._stated_s = Accuracy.stamp_sigma_s
        self._squares = 0.0
        self._frames = 0

    def must_republish(self, frame: FluxFrame, sigma_s: float, now_s: float) -> bool:
        """Take a frame with its stamp's uncertainty; return whether to publish the setup again."""
        if math.isfinite(sigma_s):
            self._squares += sigma_s**2
            self._frames += 1
        if self._noise_t is None:
            noise = frame.window.sigma[np.isfinite(frame.window.sigma)]
            self._noise_t = float(np.median(noise)) if noise.size else 0.0
            self._begun_s = now_s
            return True
        if now_s - self._begun_s < EARLIEST_S or not self._frames:
            return False
        mean_s = math.sqrt(self._squares / self._frames)
        self._begun_s, self._squares, self._frames = now_s, 0.0, 0
        if 1 / _FACTOR <= mean_s / self._stated_s <= _FACTOR:
            return False
        self._stated_s = float(f'{mean_s:.1g}')
        return True

    def stated_in(self, setup: Setup, rate_hz: float) -> Setup:
        """Return the setup with the stream's true rate and what was measured."""
        measured: dict[str, float] = {}
        if self._noise_t:
            measured[FLUX_NOISE] = float(f'{self._noise_t:.2g}')
        if self._stated_s != Accuracy.stamp_sigma_s:
            measured[STAMP_SIGMA] = self._stated_s
        return replace(setup, flux_rate_hz=rate_hz, extra={**setup.extra, **measured})
