"""From code phasors to fluxes in tesla, referred to the measured coil currents.

A coil of N turns and area A behind an amplifier of gain G sees a flux density B exp(+j w t) along
its axis as the voltage (Faraday's law; the winding sense makes the sign positive)

    V = j w a B exp(-j w d),    a = N A G,    d = delay of the channel

and the sum-of-currents channel sees the current I_k of emitter k at that emitter's tone, so

    B_k = V_k / (j w_k a exp(-j w_k d)) * I_nominal,k exp(-j w_k d_I) / I_k

is the flux density at nominal current with the phase of the measured current as its zero. A
current that drifts, and the unknown start of the window, drop out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import ParameterError
from anser_ros.signals.demodulation import ToneFit


@dataclass(frozen=True)
class FluxWindow:
    """Fluxes of one window.

    Attributes
    ----------
    flux : ndarray, shape (S, K), complex, T at nominal current; NaN for an emitter without current
    sigma : ndarray, shape (S, K), T, standard deviation of each component, by the residual noise
    current : ndarray, shape (K,), complex, A, phase relative to the window's middle
    current_sigma : ndarray, shape (K,), A
    driven : ndarray, shape (K,), whether the emitter carries current
    """

    flux: NDArray[np.complex128]
    sigma: NDArray[np.float64]
    current: NDArray[np.complex128]
    current_sigma: NDArray[np.float64]
    driven: NDArray[np.bool_]


class FluxConverter:
    """Converts fits of all columns to the fluxes of the sensor columns.

    Parameters
    ----------
    frequencies_hz : K drive tones
    sensor_columns : S columns of the sensors, in the order wanted
    volts_per_code : S scales of these columns
    area_m2 : S effective areas N A G; negative for a coil wired the other way round
    delay_s : S delays of the channels behind the coil
    current_column, amperes_per_code, current_delay_s : the sum-of-currents channel
    nominal_currents_a : K peak currents that the fluxes are given for
    least_current : share of the nominal current below which an emitter counts as not driven

    Raises
    ------
    ParameterError
        When an area or nominal current is zero or not finite.
    """

    def __init__(
        self,
        frequencies_hz: NDArray[np.float64],
        sensor_columns: NDArray[np.intp],
        volts_per_code: NDArray[np.float64],
        area_m2: NDArray[np.float64],
        delay_s: NDArray[np.float64],
        *,
        current_column: int,
        amperes_per_code: float,
        nominal_currents_a: NDArray[np.float64],
        current_delay_s: float = 0.0,
        least_current: float = 0.05,
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
        self._least = least_current

    def convert(
        self, fit: ToneFit, flux_rates: NDArray[np.complex128] | None = None
    ) -> FluxWindow:
        """Convert one window.

        Parameters
        ----------
        fit : phasors of all columns
        flux_rates : ndarray, shape (S, K), T/s, where they are known though the window was too
            short to fit them; what they add to the phasors is taken off
        """
        current = fit.phasors[self._current_column] * self._amperes_per_code
        current_sigma = fit.sigma[self._current_column] * np.abs(self._amperes_per_code)
        magnitude = np.abs(current)
        driven = magnitude > self._least * self._nominal_a
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
        own = fit.sigma[self._columns] * np.abs(to_flux)
        shared = np.divide(current_sigma, magnitude, where=driven, out=np.zeros_like(magnitude))
        return FluxWindow(
            flux, np.hypot(own, np.abs(flux) * shared), current, current_sigma, driven
        )
