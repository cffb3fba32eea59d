"""Demodulates all drive tones at once by least squares, and converts phasors to fluxes.

A window of samples x(t) of one channel is modelled as

    x(t) = sum_k Re[(P_k + Q_k t) exp(+j w_k t)] + c_0 + c_1 t (+ mains harmonics) + white noise

with t = 0 in the middle of the window. P_k is the phasor and Q_k its rate of change: all
amplitudes of a moving coil change within the window, and a fit without Q_k attributes that change
to other tones. The model is linear, so that its pseudo-inverse is computed once and a window costs
one matrix product (Kay, Fundamentals of Statistical Signal Processing I, section 4.3). Windows
that are too short to determine Q_k are fitted without; the bias by known rates is linear as well.

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
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from anser_ros.arrays import AnyArray, Array, Booleans, ComplexArray
from anser_ros.errors import FitError, ParameterError

SHORTEST_WINDOW_S = 0.005
"""Shortest window, s. Tones 170 Hz apart need about 1/170 s to be separated."""
LONGEST_WINDOW_S = 0.05
"""Longest window, s: a tool at 0.2 m/s moves 1 cm, and its phasors change no longer linearly."""
MAINS_HARMONICS = 5
"""Harmonics of the mains that are fitted in addition to the tones; higher ones are weaker."""
_RANK_TOLERANCE = 1e-6
"""Singular values below this fraction of the largest are left out, as rounding."""
_LARGEST_LOSS = 1e-3
"""Largest part of a wanted coefficient that may lie in the singular vectors that are left out."""
_WORST_VARIANCE_RATIO = 30.0
"""Variance of a phasor, over that of a single tone, beyond which tones are not separable."""
_AFFORDABLE_VARIANCE_RATIO = 2.0
"""The same up to which rates of change are fitted: noise for the error of a moving tool."""


@dataclass(frozen=True)
class ToneFit:
    """Holds fitted phasors of one window, in the unit of the samples."""

    phasors: ComplexArray  # (C, K), peak amplitude and phase in the middle of the window
    sigma: Array  # (C, K), standard deviation of the real and of the imaginary part
    noise: Array  # (C,), root mean square of the residual of a sample
    # (2K, 2K), bias of the phasors [Re, Im] by rates [Re, Im] that the fit leaves out, s; None
    # where the rates are fitted
    motion_bias: Array | None = None


@dataclass(frozen=True)
class _Solution:
    """A solved design: orthonormal basis, map to coefficients, and their variance factors."""

    basis: Array
    to_coefficients: Array
    variance: Array


@dataclass(frozen=True)
class BegunFit:
    """Holds what a fit needs of the first ``count`` samples of a window, for C channels."""

    count: int
    projected: Array  # (R, C), on the R columns of the basis
    energy: Array  # (C,), sum of squares


class Demodulator:
    """Demodulates windows of a fixed length, with drive tones (K,), by least squares.

    `MAINS_HARMONICS` of ``mains_hz`` are fitted as well, without one that falls on a tone. The
    phasors' rates of change are fitted where that does not double the variance of the phasors
    (from 10 ms on with tones 170 Hz apart); ``follows_motion`` says whether. Raises
    `ParameterError` when the window is not 5 to 50 ms long, or too short to separate two tones.
    """

    def __init__(
        self,
        sample_rate_hz: float,
        frequencies_hz: Array,
        window_samples: int,
        *,
        mains_hz: float | None = None,
    ) -> None:
        tones = np.asarray(frequencies_hz, float)
        length_s = window_samples / sample_rate_hz
        half_sample = 0.5 / sample_rate_hz
        if not SHORTEST_WINDOW_S - half_sample <= length_s <= LONGEST_WINDOW_S + half_sample:
            raise ParameterError(f'a window of {1e3 * length_s:.3g} ms is not 5 to 50 ms long')
        self.frequencies_hz = tones
        from_middle = np.arange(window_samples) - (window_samples - 1) / 2
        self._times_s = np.asarray(from_middle / sample_rate_hz, float)
        harmonics = _kept_harmonics(mains_hz, tones, sample_rate_hz, length_s)
        for motion, worst in ((True, _AFFORDABLE_VARIANCE_RATIO), (False, _WORST_VARIANCE_RATIO)):
            self.follows_motion = motion
            self._design = _design_matrix(self._times_s, length_s, tones, harmonics, motion)
            try:
                self._solution = _solve(self._design, 2 * tones.size, worst)
                break
            except FitError as error:
                failure = error
        else:
            spacing_hz = float(np.diff(np.sort(tones)).min(initial=np.inf))
            raise ParameterError(
                f'a window of {1e3 * length_s:.3g} ms cannot separate tones '
                f'{spacing_hz:.4g} Hz apart'
            ) from failure
        self._bias = self._motion_bias(self._solution, self._design, self._times_s)

    def begin(self, samples: AnyArray) -> BegunFit:
        """Fit what is there of a window, its first samples (n, C), before the rest comes."""
        return _projected(self._solution, samples)

    def demodulate(
        self, samples: AnyArray, present: Booleans | None = None, begun: BegunFit | None = None
    ) -> ToneFit:
        """Fit the phasors of all tones of all channels to a window's samples (N, C).

        Samples that are not ``present`` (N,) were lost, and their values are ignored; the fit goes
        on from what was ``begun`` with the same samples where none was lost. Raises `FitError`
        when the samples that are left do not determine the tones.
        """
        solution, bias = self._solution, self._bias
        if present is not None and not present.all():
            solution = _solve(self._design[present], 2 * self.frequencies_hz.size)
            samples, begun = samples[present], None
            bias = self._motion_bias(solution, self._design[present], self._times_s[present])
        whole = _projected(solution, samples, begun)
        coefficients = solution.to_coefficients @ whole.projected
        energy = whole.energy - np.einsum('rc,rc->c', whole.projected, whole.projected)
        freedom = max(whole.count - solution.basis.shape[1], 1)
        noise = np.sqrt(np.maximum(energy, 0.0) / freedom)
        count = self.frequencies_hz.size
        phasors = (coefficients[:count] + 1j * coefficients[count : 2 * count]).T
        variance = (solution.variance[:count] + solution.variance[count : 2 * count]) / 2
        return ToneFit(phasors, noise[:, None] * np.sqrt(variance), noise, bias)

    def _motion_bias(self, solution: _Solution, design: Array, times_s: Array) -> Array | None:
        """Return the phasors that a fit without motion finds in tones times t, (2K, 2K), s."""
        if self.follows_motion:
            return None
        count = 2 * self.frequencies_hz.size
        projected = solution.basis.T @ (times_s[:, None] * design[:, :count])
        return np.asarray((solution.to_coefficients @ projected)[:count])


def _projected(solution: _Solution, samples: AnyArray, begun: BegunFit | None = None) -> BegunFit:
    """Take in the samples (n, C) of a window's beginning that were not ``begun`` with."""
    done = 0 if begun is None else begun.count
    values = samples[done:].astype(np.float64)
    projected = solution.basis[done : len(samples)].T @ values
    energy = np.einsum('nc,nc->c', values, values)
    if begun is not None:
        projected, energy = projected + begun.projected, energy + begun.energy
    return BegunFit(len(samples), projected, energy)


def _kept_harmonics(
    mains_hz: float | None, tones: Array, sample_rate_hz: float, length_s: float
) -> Array:
    if mains_hz is None:
        return np.empty(0)
    harmonics = mains_hz * np.arange(1, MAINS_HARMONICS + 1)
    apart = np.abs(harmonics[:, None] - tones).min(axis=1) > 1 / length_s
    kept: Array = harmonics[apart & (harmonics < sample_rate_hz / 2)]
    return kept


def _design_matrix(
    times_s: Array, length_s: float, tones: Array, harmonics: Array, follow_motion: bool
) -> Array:
    """Return the columns: cos and -sin of the tones, the same times t, offset, slope, mains."""
    unit = times_s / (length_s / 2)
    angle = 2 * np.pi * times_s[:, None] * tones
    waves = np.hstack([np.cos(angle), -np.sin(angle)])
    columns = [waves]
    if follow_motion:
        columns.append(unit[:, None] * waves)
    columns += [np.ones_like(unit)[:, None], unit[:, None]]
    mains = 2 * np.pi * times_s[:, None] * harmonics
    columns += [np.cos(mains), np.sin(mains)]
    return np.hstack(columns)


def _solve(design: Array, wanted: int, worst_ratio: float = _WORST_VARIANCE_RATIO) -> _Solution:
    """Solve the design by singular value decomposition.

    Raises `FitError` when the first `wanted` coefficients are not determined, or with more than
    `worst_ratio` times the variance of a single tone.
    """
    samples, columns = design.shape
    if samples < columns + 1:
        raise FitError(f'{columns} unknowns need more than {samples} samples')
    scale = np.linalg.norm(design, axis=0)
    left, values, right = np.linalg.svd(design / scale, full_matrices=False)
    kept = values > _RANK_TOLERANCE * values[0]
    to_coefficients = (right[kept].T / values[kept]) / scale[:, None]
    variance = np.einsum('pr,pr->p', to_coefficients, to_coefficients)
    lost = np.abs(right[~kept][:, :wanted]).max(initial=0.0)
    worst = variance[:wanted].max() * samples / 2
    if lost > _LARGEST_LOSS or worst > worst_ratio:
        raise FitError(f'tones not separable: variance {worst:.3g} times that of one tone alone')
    return _Solution(np.ascontiguousarray(left[:, kept]), to_coefficients, variance)


LEAST_CURRENT = 0.05
"""Fraction of the nominal current below which an emitter is not driven: the rest is noise."""


@dataclass(frozen=True)
class FluxWindow:
    """Holds fluxes and currents of one window."""

    # (S, K), flux density at nominal current, T; NaN for an emitter without current
    flux: ComplexArray
    # (K,), measured currents, A, with their phase in the middle of the window
    current: ComplexArray
    # (K,), standard deviation of each component of the currents, A
    current_sigma: Array
    driven: Booleans  # (K,), whether the emitter carries current
    own_sigma: tuple[Array, ComplexArray]  # (S, K) each: of the phasors, and what makes them T

    @cached_property
    def sigma(self) -> Array:
        """Return the standard deviation of each component from the residual noise, (S, K), T."""
        magnitude, (own, to_flux) = np.abs(self.current), self.own_sigma
        relative = np.divide(
            self.current_sigma, magnitude, where=self.driven, out=np.zeros_like(magnitude)
        )
        return np.asarray(np.hypot(own * np.abs(to_flux), np.abs(self.flux) * relative))


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
        driven = np.abs(current) > LEAST_CURRENT * self._nominal_a
        reference = np.full(current.shape, complex(np.nan, np.nan))
        reference[driven] = self._nominal_a[driven] / current[driven]
        to_flux = self._tesla_per_code * reference
        phasors = fit.phasors[self._columns]
        if fit.motion_bias is not None and flux_rates is not None:
            rates = np.zeros_like(flux_rates)
            np.divide(flux_rates, to_flux, where=driven & np.isfinite(flux_rates), out=rates)
            added = np.hstack([rates.real, rates.imag]) @ fit.motion_bias.T
            phasors = phasors - added[:, : driven.size] - 1j * added[:, driven.size :]
        own = fit.sigma[self._columns], to_flux
        return FluxWindow(phasors * to_flux, current, current_sigma, driven, own)


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
