"""Samples to fluxes: what comes out is what was put in, and its stated noise is honest."""

import numpy as np
import pytest
from conftest import REPO

from anser_ros.errors import FitError, ParameterError
from anser_ros.signals import demodulation
from anser_ros.signals.demodulation import Demodulator, FluxConverter, FluxRates

RATE = 40e3
TONES = np.array([6000.0, 6170.0, 6340.0, 6510.0, 6690.0, 6860.0, 7030.0, 7200.0])


def phasors(channels: int = 5, seed: int = 0, tones: int = 8) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.normal(0, 2000, (channels, tones)) + 1j * rng.normal(0, 2000, (channels, tones))


def waves(values: np.ndarray, samples: int, tones: np.ndarray = TONES) -> np.ndarray:
    """Samples (N, C) of Re[P exp(jwt)], t = 0 in the middle."""
    time_s = (np.arange(samples) - (samples - 1) / 2) / RATE
    return (np.exp(2j * np.pi * time_s[:, None] * tones) @ values.T).real


@pytest.mark.parametrize('milliseconds', [5, 8, 20, 33.3, 50])
def test_exact_for_the_signal_that_it_models(milliseconds):
    samples = round(RATE * milliseconds / 1e3)
    truth = phasors()
    fit = Demodulator(RATE, TONES, samples).demodulate(waves(truth, samples) + 1234.5)
    assert np.abs(fit.phasors - truth).max() < 1e-7
    assert fit.noise.max() < 1e-3, 'energies cancel to a thousandth of a code'


@pytest.mark.parametrize(('milliseconds', 'motion'), [(5, False), (20, True), (20, False)])
def test_stated_noise_is_the_noise(milliseconds, motion, monkeypatch):
    samples = round(RATE * milliseconds / 1e3)
    if not motion:
        monkeypatch.setattr(demodulation, '_AFFORDABLE_VARIANCE_RATIO', 0.0)
    demodulator = Demodulator(RATE, TONES, samples)
    assert demodulator.follows_motion == motion
    truth = phasors(200, 1)
    noise = 3.0 * np.random.default_rng(2).standard_normal((samples, 200))
    fit = demodulator.demodulate(waves(truth, samples) + noise)
    error = fit.phasors - truth
    ratio = np.concatenate([error.real.ravel(), error.imag.ravel()]) / np.tile(
        fit.sigma.ravel(), 2
    )
    assert np.sqrt(np.mean(ratio**2)) == pytest.approx(1, abs=0.05)
    assert fit.noise.mean() == pytest.approx(3.0, rel=0.02)
    if milliseconds == 20:
        assert fit.sigma.mean() == pytest.approx(3.0 * np.sqrt(2 / samples), rel=0.1)


def test_the_page_states_what_a_fit_costs_in_variance():
    tones, noise = 5000 + 170 * np.arange(8), np.random.default_rng(3).standard_normal

    def variance(milliseconds, **options):
        """Of the mean phasor, over that of one tone alone."""
        count = round(40 * milliseconds)
        demodulator = Demodulator(40e3, tones, count, **options)
        assert demodulator.follows_motion == (milliseconds >= 10)
        fit = demodulator.demodulate(noise((count, 1)))
        return float(np.mean((fit.sigma / fit.noise) ** 2) * count / 2)

    motion = [variance(ms) - 1 for ms in (20, 10)]
    plain = variance(5)
    mains = variance(5, mains_hz=50.0) / plain - 1
    page = ' '.join((REPO / 'docs' / 'acquisition.md').read_text().split())
    slow, quick = (f'{100 * more:.0f} %' for more in motion)
    assert f'{slow} of variance at 20 ms and {quick} at 10 ms' in page
    assert f'Mains harmonics cost {100 * mains:.0f} % of variance at 5 ms' in page
    assert f'170 Hz apart in 5 ms have {plain:.1f} times the variance of one' in page


def test_a_moving_coil_does_not_leak_into_other_tones(monkeypatch):
    samples = 800
    truth = np.zeros((1, 8), complex)
    truth[0, 3] = 10000
    ramp = 1 + 0.04 * np.linspace(-0.5, 0.5, samples)[:, None]
    moving = waves(truth, samples) * ramp
    followed = Demodulator(RATE, TONES, samples).demodulate(moving)
    monkeypatch.setattr(demodulation, '_AFFORDABLE_VARIANCE_RATIO', 0.0)
    plain = Demodulator(RATE, TONES, samples).demodulate(moving)
    assert np.abs(followed.phasors - truth).max() < 1e-3
    assert np.abs(plain.phasors - truth).max() > 5, 'or the column would not be needed'


def test_mains_is_fitted_when_asked():
    samples = 800
    truth = phasors(2)
    time_s = np.arange(samples) / RATE
    hum = sum(3000 / h * np.cos(2 * np.pi * 50 * h * time_s + h) for h in range(1, 6))
    noisy = waves(truth, samples) + hum[:, None]
    with_mains = Demodulator(RATE, TONES, samples, mains_hz=50.0).demodulate(noisy)
    without = Demodulator(RATE, TONES, samples).demodulate(noisy)
    assert np.abs(with_mains.phasors - truth).max() < 1e-6
    assert np.abs(without.phasors - truth).max() > 0.1


def test_a_mains_harmonic_on_a_tone_is_left_to_the_tone(monkeypatch):
    monkeypatch.setattr(demodulation, 'MAINS_HARMONICS', 200)
    fit = Demodulator(RATE, TONES, 800, mains_hz=50.0)
    truth = phasors()
    assert np.abs(fit.demodulate(waves(truth, 800)).phasors - truth).max() < 1e-6


def test_lost_samples_are_left_out_of_the_fit():
    truth = phasors()
    samples = waves(truth, 800)
    present = np.ones(800, bool)
    present[300:420] = False
    samples[~present] = 30000
    fit = Demodulator(RATE, TONES, 800).demodulate(samples, present)
    assert np.abs(fit.phasors - truth).max() < 1e-6


def test_a_fit_that_began_early_is_that_of_the_whole_window():
    rng = np.random.default_rng(5)
    samples = waves(phasors(), 800) + rng.normal(0, 3, (800, len(phasors())))
    demodulator = Demodulator(RATE, TONES, 800)
    whole = demodulator.demodulate(samples)
    for count in (1, 640, 800):
        fit = demodulator.demodulate(samples, begun=demodulator.begin(samples[:count]))
        for name in ('phasors', 'sigma', 'noise'):
            np.testing.assert_allclose(getattr(fit, name), getattr(whole, name), rtol=1e-7)
    present = np.ones(800, bool)
    present[700:720] = False
    lossy = demodulator.demodulate(samples, present, demodulator.begin(samples[:640]))
    assert np.array_equal(lossy.phasors, demodulator.demodulate(samples, present).phasors)


def test_too_few_samples_and_tones_too_close_are_refused():
    present = np.zeros(800, bool)
    present[:30] = True
    with pytest.raises(FitError, match='unknowns need more than 30'):
        Demodulator(RATE, TONES, 800).demodulate(np.zeros((800, 1)), present)
    present[:60] = True
    with pytest.raises(FitError, match='not separable'):
        Demodulator(RATE, TONES, 800).demodulate(np.zeros((800, 1)), present)
    with pytest.raises(ParameterError, match='cannot separate'):
        Demodulator(RATE, np.array([6000.0, 6010.0]), 200)


@pytest.mark.parametrize('samples', [199, 2001])
def test_window_length_is_5_to_50_ms(samples):
    with pytest.raises(ParameterError, match='5 to 50 ms'):
        Demodulator(RATE, TONES, samples)


class TestFlux:
    AREA = np.array([2.0, -1.5])
    DELAY = np.array([3e-6, 0.0])
    NOMINAL = np.full(8, 0.25)

    def converter(self, **changes):
        arguments = {
            'current_column': 2,
            'amperes_per_code': 1e-4,
            'nominal_currents_a': self.NOMINAL,
            'current_delay_s': 1e-6,
        } | changes
        return FluxConverter(
            TONES, np.array([0, 1]), np.full(2, 1.5e-4), self.AREA, self.DELAY, **arguments
        )

    def codes(self, flux, current, samples=800):
        """What the ADC sees of a flux at nominal current when `current` flows."""
        omega = 2 * np.pi * TONES
        field = flux * current / self.NOMINAL
        volts = 1j * omega * self.AREA[:, None] * field * np.exp(-1j * omega * self.DELAY[:, None])
        amperes = current * np.exp(-1j * omega * 1e-6)
        return waves(np.vstack([volts / 1.5e-4, amperes / 1e-4]), samples)

    def test_flux_is_recovered_whatever_the_current_does(self):
        flux = phasors(2, 3) * 1e-10
        demodulator, converter = Demodulator(RATE, TONES, 800), self.converter()
        for seed in range(3):
            rng = np.random.default_rng(seed)
            current = 0.25 * rng.uniform(0.7, 1.2, 8) * np.exp(1j * rng.uniform(-3, 3, 8))
            window = converter.convert(demodulator.demodulate(self.codes(flux, current)))
            assert np.abs(window.flux - flux).max() < 1e-15
            assert np.abs(window.current) == pytest.approx(np.abs(current))
            assert window.driven.all()

    def test_stated_noise_is_the_noise(self):
        flux = phasors(2, 3) * 1e-10
        current = np.full(8, 0.2 + 0.1j)
        demodulator, converter = Demodulator(RATE, TONES, 800), self.converter()
        rng = np.random.default_rng(0)
        clean = self.codes(flux, current)
        ratios = []
        for _ in range(200):
            noisy = clean + rng.standard_normal(clean.shape) * [1.0, 2.0, 3.0]
            window = converter.convert(demodulator.demodulate(noisy))
            ratios.append((window.flux - flux) / window.sigma)
        assert np.sqrt(np.mean(np.abs(ratios) ** 2) / 2) == pytest.approx(1, abs=0.05)

    def test_an_emitter_without_current_has_no_flux(self):
        current = np.full(8, 0.25 + 0j)
        current[5] = 0.001
        fit = Demodulator(RATE, TONES, 800).demodulate(self.codes(phasors(2) * 1e-10, current))
        window = self.converter().convert(fit)
        assert np.isnan(window.flux[:, 5]).all()
        assert np.isfinite(np.delete(window.flux, 5, axis=1)).all()
        assert not window.driven[5] and window.driven.sum() == 7

    def test_refusals(self):
        with pytest.raises(ParameterError, match='effective area'):
            FluxConverter(
                TONES, np.array([0]), np.ones(1), np.zeros(1), np.zeros(1), current_column=1,
                amperes_per_code=1.0, nominal_currents_a=self.NOMINAL,
            )  # fmt: skip
        with pytest.raises(ParameterError, match='nominal current'):
            self.converter(nominal_currents_a=np.zeros(8))


class TestShortWindows:
    def test_motion_is_taken_from_the_windows_before(self):
        samples, hop_s = 200, 5e-3
        rng = np.random.default_rng(4)
        start = phasors(3, 8) * 1e-12
        rate = 0.5 * np.abs(start) * rng.standard_normal((3, 8))
        demodulator = Demodulator(RATE, TONES, samples)
        assert not demodulator.follows_motion
        to_code = 2j * np.pi * TONES * 1e6
        converter = FluxConverter(
            TONES, np.arange(3), np.full(3, 1e-6), np.ones(3), np.zeros(3),
            current_column=3, amperes_per_code=1e-4, nominal_currents_a=np.full(8, 0.25),
        )  # fmt: skip
        rates, errors = FluxRates(), []
        time_s = (np.arange(samples) - (samples - 1) / 2) / RATE
        for window in range(8):
            middle_s = window * hop_s
            turn = np.exp(2j * np.pi * TONES * middle_s)
            level = (start + rate * middle_s) * to_code * turn
            slope = waves(rate * to_code * turn, samples) * time_s[:, None]
            current = waves(2500.0 * turn[None], samples)
            fit = demodulator.demodulate(np.hstack([waves(level, samples) + slope, current]))
            flux = converter.convert(fit, rates.at(middle_s)).flux
            rates.add(middle_s, flux)
            errors.append(np.abs(flux - start - rate * middle_s).max() / np.abs(start).max())
        assert errors[0] > 1e-4
        assert max(errors[-3:]) < 0.1 * errors[0]

    def test_a_gap_starts_anew(self):
        rates = FluxRates()
        for window in range(4):
            rates.add(0.005 * window, np.full((1, 1), 1j * window))
        assert rates.at(0.02)[0, 0] == pytest.approx(200j)
        assert rates.at(0.2) is None
        rates.add(0.2, np.zeros((1, 1), complex))
        assert rates.at(0.205) is None
