"""Samples the world's fluxes into the codes of an analogue-to-digital converter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.simulation.raw_effects import RawEffect
from anser_ros.simulation.world import World
from anser_ros.wire.channel_calibration import ChannelCalibration
from anser_ros.wire.records import FULL_SCALE_CODE

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


OVERLOAD_GAIN = 1e4
"""Gain of an amplifier under overload: so large that any signal reaches the converter's limits."""


@dataclass(frozen=True)
class FrontEnd:
    """Describes the analogue side of a control unit with its converter."""

    sample_rate_hz: float = 40e3  # samples a second and channel
    # full_scale_v, full_scale_a: voltage and current at code 32768, V and A
    full_scale_v: float = 5.0
    full_scale_a: float = 2.5
    # noise_codes, current_noise_codes: white noise before the converter of the sensors and of the
    # currents, codes rms a sample
    noise_codes: float = 2.4
    current_noise_codes: float = 0.5
    current_drift: float = 0.02  # fraction by which the currents fall while the coils warm up
    warm_up_s: float = 60.0  # time constant of the warming, from the first start on, s


class Sampler:
    """Samples all sensors and the sum of the currents, one stretch of time after the other.

    Within a stretch the phasors change linearly between the world's at its two ends, so that
    stretches of 5 ms follow a tool at 0.1 m/s to some 10 pT.

    ``calibration`` is the true response of the channels, ``nominal_current_a`` the peak current
    that the world's fluxes are given for, A.
    """

    def __init__(
        self,
        world: World,
        calibration: ChannelCalibration,
        front_end: FrontEnd,
        nominal_current_a: float,
        *,
        effects: Sequence[RawEffect] = (),
        seed: int = 0,
    ) -> None:
        self._world = world
        self._front_end = front_end
        self._nominal_a = nominal_current_a
        self._effects = tuple(effects)
        self._rng = np.random.default_rng(seed)
        numbers = [sensor.channel for sensor in world.sensors]
        self._areas = calibration.areas_m2(numbers)[:, None]
        self._delays = calibration.delays_s(numbers)[:, None]
        self._current_delay = calibration.current_delay_s
        self._driven_from_s: float | None = None
        self.is_overloaded = False
        self.set_frequencies(np.array(world.setup.frequencies_hz))
        self._last: tuple[float, ComplexArray] | None = None

    def set_frequencies(self, frequencies_hz: Array) -> None:
        """Drive the coils at other tones, shape (K,), Hz, from the next stretch on."""
        self.frequencies_hz = frequencies_hz
        omega = 2 * np.pi * frequencies_hz
        self._volts_per_tesla = 1j * omega * self._areas * np.exp(-1j * omega * self._delays)
        self._current_response = np.exp(-1j * omega * self._current_delay)
        # Each synthesiser starts at another phase, and each coil has another impedance.
        self._start = np.exp(1j * np.arange(1, frequencies_hz.size + 1) ** 2)
        self._last = None

    def drive(self, time_s: float) -> None:
        """Begin to drive the coils at a time (s); later calls change nothing."""
        if self._driven_from_s is None:
            self._driven_from_s = time_s
            self._last = None

    def codes(self, first_sample: int, count: int) -> NDArray[np.int16]:
        """Return the converter codes of `count` samples from `first_sample` since power-up on.

        Returns sensors in the order of the setup, then the sum of currents.
        """
        rate = self._front_end.sample_rate_hz
        begin_s, end_s = first_sample / rate, (first_sample + count) / rate
        begin = (
            self._last[1] if self._last and self._last[0] == begin_s else self._phasors(begin_s)
        )
        end = self._phasors(end_s)
        self._last = (end_s, end)
        time_s = (first_sample + np.arange(count)) / rate
        share = np.arange(count)[:, None] / count
        waves = np.exp(2j * np.pi * time_s[:, None] * self.frequencies_hz)
        basis = np.hstack([waves.real, -waves.imag, share * waves.real, -share * waves.imag])
        change = end - begin
        signals = basis @ np.vstack([begin.T.real, begin.T.imag, change.T.real, change.T.imag])
        volts, current = signals[:, :-1], signals[:, -1]
        for effect in self._effects:
            volts = effect.volts(time_s - self._start_s, volts)
        if self.is_overloaded:
            volts = volts * np.where(np.arange(volts.shape[1]) == 0, OVERLOAD_GAIN, 1.0)
        return self._convert(volts, current)

    @property
    def _start_s(self) -> float:
        """Time at which the coils were first driven, from which warming and effects count."""
        return self._driven_from_s or 0.0

    def _phasors(self, time_s: float) -> ComplexArray:
        """Return the voltages of the sensors and, in the last row, currents; shape (S + 1, K)."""
        flux = self._world.flux(time_s)
        for effect in self._effects:
            flux = effect.flux(time_s - self._start_s, flux)
        current = self.current(time_s)
        volts = flux * self._volts_per_tesla * (current / self._nominal_a)
        return np.vstack([volts, current * self._current_response])

    def current(self, time_s: float) -> ComplexArray:
        """Return the true complex currents of the coils at a time, shape (K,), A."""
        driven_s = time_s - self._start_s
        warm = 1 - np.exp(-driven_s / self._front_end.warm_up_s)
        current = self._nominal_a * (1 - self._front_end.current_drift * warm) * self._start
        for effect in self._effects:
            current = effect.current(driven_s, current)
        return np.asarray(current)

    def _convert(self, volts: Array, current: Array) -> NDArray[np.int16]:
        front = self._front_end
        codes = self._rng.standard_normal((len(volts), volts.shape[1] + 1), np.float32)
        codes[:, :-1] *= front.noise_codes
        codes[:, -1] *= front.current_noise_codes
        codes[:, :-1] += volts * (FULL_SCALE_CODE / front.full_scale_v)
        codes[:, -1] += current * (FULL_SCALE_CODE / front.full_scale_a)
        np.rint(codes, out=codes)
        np.clip(codes, -FULL_SCALE_CODE, FULL_SCALE_CODE - 1, out=codes)
        return codes.astype('<i2')
