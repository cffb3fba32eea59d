"""Converts phasors in codes to fluxes in tesla, referred to the measured coil currents.

A coil of N turns and area A behind an amplifier of gain G turns a flux density B exp(+j w t) along
its axis into the voltage (Faraday's law; the winding sense makes the sign positive)

    V = j w a B exp(-j w d),    a = N A G,    d = delay of the channel

and the channel of the summed currents has the current I_k of emitter k at that emitter's tone, so

    B_k = V_k / (j w_k a exp(-j w_k d)) * I_nominal,k exp(-j w_k d_I) / I_k

is the flux density at nominal current, with the phase of the measured current as its zero. A drift
of the current and the unknown start of the window cancel. Rates of change of the fluxes, for
windows too short to fit them, come from earlier windows.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.arrays import Array, Booleans, ComplexArray
from anser_ros.errors import ParameterError
from anser_ros.signals.demodulation import ToneFit

LEAST_CURRENT = 0.05
"""Fraction of the nominal current below which an emitter is not driven: the rest is noise."""


@dataclass(frozen=True)
class FluxWindow:
    """Holds fluxes and currents of one window."""

    # (S, K), flux density at nominal current, T; NaN for an emitter without current
    flux: ComplexArray
    # (S, K), standard deviation of each component from the residual noise, T
    sigma: Array
    # (K,), measured currents, A, with their phase in the middle of the window
    current: ComplexArray
    # (K,), standard deviation of each component of the currents, A
    current_sigma: Array
    driven: Booleans  # (K,), whether the emitter carries current


class FluxConverter:
    """Converts fitted phasors of all columns to the fluxes of the sensor columns.

    ``frequencies_hz`` (K,) are the drive tones, ``nominal_currents_a`` (K,) the peak currents that
    fluxes are given for. ``sensor_columns`` (S,) are in the order wanted, each with its scale, its
    effective area N A G (negative for a coil wired the other way round) and the delay of its
    channel. The column of the summed currents has its own scale and delay. Raises `ParameterError`
    when an area or nominal current is zero or not finite.
    """

    def __init__(
        self,
        frequencies_hz: Array,
        sensor_columns: NDArray[np.intp],
        volts_per_code: Array,
        area_m2: Array,
        delay_s: Array,
        *,
        current_column: int,
        amperes_per_code: float,
        nominal_currents_a: Array,
        current_delay_s: float = 0.0,
    ) -> None:
        if not np.all(np.isfinite(area_m2) & (area_m2 != 0)):
            raise ParameterError('the effective area of a channel is zero or not finite')
        if not np.all(np.isfinite(nominal_currents_a) & (nominal_currents_a > 0)):
            raise ParameterError('the nominal current of an emitter is not finite and positive')
        omega = 2 * np.pi * np.asarray(frequencies_hz, float)
        self._columns = sensor_columns
        response = 1j * omega * area_m2[:, None] * np.exp(-1j * omega * delay_s[:, None])
        self._tesla_per_code = volts_per_code[:, None] / response
        self._current_column = current_column
        self._amperes_per_code = amperes_per_code * np.exp(1j * omega * current_delay_s)
        self._nominal_a = nominal_currents_a

    def convert(self, fit: ToneFit, flux_rates: ComplexArray | None = None) -> FluxWindow:
        """Convert the phasors of one window to fluxes.

        Windows that are too short to fit ``flux_rates`` (S, K), T/s, are given these, and the bias
        of the phasors by them is subtracted.
        """
        current = fit.phasors[self._current_column] * self._amperes_per_code
        current_sigma = fit.sigma[self._current_column] * np.abs(self._amperes_per_code)
        magnitude = np.abs(current)
        driven = magnitude > LEAST_CURRENT * self._nominal_a
        reference = np.full(current.shape, complex(np.nan, np.nan))
        reference[driven] = self._nominal_a[driven] / current[driven]
        to_flux = self._tesla_per_code * reference
        phasors = fit.phasors[self._columns]
        if fit.motion_bias is not None and flux_rates is not None:
            rates = np.zeros_like(flux_rates)
            np.divide(flux_rates, to_flux, where=driven & np.isfinite(flux_rates), out=rates)
            added = np.hstack([rates.real, rates.imag]) @ fit.motion_bias.T
            phasors = phasors - added[:, : driven.size] - 1j * added[:, driven.size :]
        flux = phasors * to_flux
        sensor_sigma = fit.sigma[self._columns] * np.abs(to_flux)
        relative = np.divide(current_sigma, magnitude, where=driven, out=np.zeros_like(magnitude))
        sigma = np.hypot(sensor_sigma, np.abs(flux) * relative)
        return FluxWindow(flux, sigma, current, current_sigma, driven)


REACH_S = 0.03
"""Time over which the straight line is fitted, s: a tool's velocity hardly changes meanwhile."""
LONGEST_WINDOW_GAP_S = 0.05
"""Longest time from one window to the next, s: earlier ones say nothing of the motion."""
FEWEST_WINDOWS = 3
"""Windows that a slope needs at least, so that the noise of a single one does not make it."""


class FluxRates:
    """Finds the slopes of the fluxes over the last windows, by a straight line through them.

    Over `REACH_S` the slopes are determined so well that subtracting their effect from a short
    window adds hardly any noise.
    """

    def __init__(self) -> None:
        self._past: deque[tuple[float, ComplexArray]] = deque()

    def add(self, time_s: float, flux: ComplexArray) -> None:
        """Take in the fluxes (S, K), T, of a window at the time of its middle.

        A gap or a step back in time discards the windows before.
        """
        past = self._past
        if past and not 0 < time_s - past[-1][0] <= LONGEST_WINDOW_GAP_S:
            past.clear()
        past.append((time_s, flux))
        while len(past) > FEWEST_WINDOWS and time_s - past[0][0] > REACH_S:
            past.popleft()

    def at(self, time_s: float) -> ComplexArray | None:
        """Return the rates (S, K), T/s, at a time, or None without enough recent windows."""
        past = self._past
        if len(past) < FEWEST_WINDOWS or not 0 < time_s - past[-1][0] <= LONGEST_WINDOW_GAP_S:
            return None
        times = np.array([moment for moment, _ in past])
        weights = times - times.mean()
        weights /= weights @ weights
        return np.asarray(np.tensordot(weights, np.array([flux for _, flux in past]), axes=1))
