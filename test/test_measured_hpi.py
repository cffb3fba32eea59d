"""Coils on a head: tones, channels, chips, places; a made-up helmet and the real epoch."""

import os
from pathlib import Path

import numpy as np
import pytest

from anser_ros.assessment.hummel import rigid_distances
from anser_ros.errors import FitError
from anser_ros.measured import hpi_coils
from anser_ros.measured.hpi_channels import examine
from anser_ros.measured.hpi_demodulation import Tones, demodulate, find_tones
from anser_ros.measured.hpi_fit import (
    CoilData,
    LeadSearch,
    first_place,
    fit_coil,
    grow_chain,
)
from anser_ros.measured.hpi_places import (
    arms_left_out,
    best_arm,
    distance_mm,
    order_of,
    outward,
)
from anser_ros.measured.squid_array import ChipErrors, SquidArray, whitener

ROOT = Path(__file__).resolve().parents[1]
FOLDER = Path(os.environ.get('ANSER_SHARED', ROOT.parent / 'shared')) / 'measured' / 'hpi_coils'
needs_data = pytest.mark.skipif(not FOLDER.is_dir(), reason='no shared folder with measured data')
COIL = np.array([0.06, 0.02, 0.04])
MOMENT = 1e-8 * np.array([0.7, 0.1, 0.6])


def helmet(n_chips=60):
    """Chips on a half sphere of 11 cm: a magnetometer and two planar gradiometers each."""
    k = np.arange(n_chips) + 0.5
    up, turn = 1.0 - 1.2 * k / n_chips, np.pi * (1.0 + 5.0**0.5) * k
    side = np.sqrt(1.0 - up**2)
    normal = np.column_stack([side * np.cos(turn), side * np.sin(turn), up])
    names, points, normals, weights, is_magnetometer = [], [], [], [], []
    for chip, n in enumerate(normal):
        x = np.cross(n, [0.0, 0.0, 1.0])
        x /= np.linalg.norm(x)
        y = np.cross(n, x)
        for kind, axis in ((1, None), (2, x), (3, y)):
            names.append(f'C {chip:03d}{kind}')
            is_magnetometer.append(kind == 1)
            normals.append(np.tile(n, (4, 1)))
            if axis is None:
                offset = 6e-3 * np.array([x + y, x - y, -x + y, -x - y])
                weight = np.full(4, 0.25)
            else:
                offset = 8.4e-3 * np.array([axis, axis, -axis, -axis])
                weight = np.array([1.0, 1.0, -1.0, -1.0]) / (2 * 16.8e-3)
            points.append(0.11 * n + offset)
            weights.append(weight)
    return SquidArray(
        tuple(names),
        np.array(is_magnetometer),
        np.array(points),
        np.array(normals),
        np.array(weights),
        np.arange(3 * n_chips).reshape(-1, 3),
    )


def noise_of(array):
    return np.where(array.is_magnetometer, 1e-14, 3e-13)


def coil_data(array, seed=0, extra=0.0):
    noise = noise_of(array)
    signal = array.signals(COIL) @ MOMENT + extra
    signal = signal + noise * np.random.default_rng(seed).normal(size=len(noise))
    return CoilData(signal, noise, np.ones(len(noise), bool))


class TestTones:
    @pytest.mark.long
    def test_close_tones_are_found_and_separated(self):
        rng = np.random.default_rng(1)
        rate, count = 600.6, 600
        time = np.arange(count) / rate
        tones = np.array([70.0, 72.0, 74.0, 76.0])
        size = rng.normal(size=(4, 40))
        samples = size.T @ np.cos(2 * np.pi * np.outer(tones, time) + 0.3)
        samples = 10 * samples + 5 * time + rng.normal(size=samples.shape)
        found = find_tones(samples, rate)
        np.testing.assert_allclose(found, tones, atol=0.01)
        out = demodulate(samples, rate, found, np.ones(40, bool))
        for k in range(4):
            r = np.corrcoef(out.phasors[k].real, size[k])[0, 1]
            assert abs(r) > 0.999
        assert np.median(out.noise) == pytest.approx(np.sqrt(2.0 / count), rel=0.3)

    def test_noise_has_no_tone(self):
        samples = np.random.default_rng(0).normal(size=(30, 400))
        with pytest.raises(FitError, match='no tone'):
            find_tones(samples, 500.0)


class TestChannels:
    def tones(self, array, stored, seed=0):
        rng = np.random.default_rng(seed)
        phasors = stored / np.where(array.is_magnetometer, 1e-14, 1e-12)
        noise = np.full(stored.shape[1], 0.05)
        phasors = phasors + 0.05 * (rng.normal(size=stored.shape) * (1 + 0j))
        return Tones(np.arange(len(stored)) + 70.0, phasors.astype(complex), noise)

    def test_inverted_and_noisy_channels_are_named(self):
        array = helmet()
        stored = np.array([coil_data(array).signals, (array.signals(-COIL) @ MOMENT)])
        tones = self.tones(array, stored)
        inverted, noisy = [4, 40, 100], [11]
        tones.phasors[:, inverted] *= -1.0
        tones.noise[noisy] *= 30.0
        found = examine(array, tones, stored)
        assert np.flatnonzero(found.inverted).tolist() == inverted
        assert np.flatnonzero(found.noisy).tolist() == noisy
        assert found.correlation.min() > 0.999
        text = '\n'.join(found.text(array))
        assert array.names[11] in text

    def test_number_of_tones_must_fit(self):
        array = helmet()
        stored = coil_data(array).signals[None]
        with pytest.raises(FitError, match='tones in the epoch'):
            examine(array, self.tones(array, np.vstack([stored, stored])), stored)
        with pytest.raises(FitError, match='same tone'):
            both = np.vstack([stored, stored])
            examine(array, self.tones(array, np.vstack([stored, 0 * stored + 1e-12])), both)


class TestArray:
    def test_chip_columns_are_what_a_moved_chip_sees(self):
        array = helmet(8)
        columns = array.chip_columns(COIL, MOMENT)
        shift = np.array([1e-4, -5e-5, 8e-5])
        moved = array.signals(COIL - shift) @ MOMENT - array.signals(COIL) @ MOMENT
        np.testing.assert_allclose(columns[:, :3] @ shift, moved, rtol=0.05, atol=1e-13)

    def test_offset_moves_along_the_normal(self):
        array = helmet(8)
        further = array.changed({'array_offset': 1e-3}).centres_m
        np.testing.assert_allclose(
            np.linalg.norm(further, axis=1) - np.linalg.norm(array.centres_m, axis=1), 1e-3
        )

    def test_whitener_makes_chip_errors_white(self):
        array, rng = helmet(40), np.random.default_rng(4)
        columns, noise = array.chip_columns(COIL, MOMENT), noise_of(array)
        errors = ChipErrors(3e-4, 5e-3, 0.0)
        used = np.ones(len(noise), bool)
        white = whitener(array, noise, columns, array.signals(COIL) @ MOMENT, errors, used)
        chip = np.repeat(np.arange(40), 3)
        spread = np.array([3e-4] * 3 + [5e-3] * 3)
        draws = [
            white.apply(
                np.sum(columns * (spread * rng.normal(size=(40, 6)))[chip], axis=1)
                + noise * rng.normal(size=len(noise))
            )
            for _ in range(40)
        ]
        assert np.std(draws) == pytest.approx(1.0, rel=0.05)


class TestPlaces:
    def test_coil_is_found_within_its_sigma(self):
        array = helmet()
        data = coil_data(array)
        start = first_place(array, data, np.array([[0.05, 0.0, 0.05], [-0.05, 0.0, 0.05]]))
        fit = fit_coil(array, data, start, ChipErrors(1e-5, 1e-4, 0.0))
        assert np.linalg.norm(fit.places_m[0] - COIL) < 3.0 * fit.sigma_m
        np.testing.assert_allclose(fit.moments[0], MOMENT, rtol=0.02, atol=1e-10)

    @pytest.mark.long
    def test_stray_field_of_a_lead_is_found(self):
        array = helmet()
        lead = np.array([-0.03, -0.05, 0.02])
        stray = array.signals(lead) @ (1e-10 * np.array([1.0, 1.0, 0.0]))
        data = coil_data(array, extra=stray)
        errors = ChipErrors(1e-4, 2e-3, 0.0)
        chain = grow_chain(array, data, COIL + 1e-3, errors, LeadSearch(array), 1)
        assert chain[1].log_likelihood > chain[0].log_likelihood + 10.0
        assert np.linalg.norm(chain[1].places_m[1] - lead) < 0.01

    def test_rigid_distance_ignores_a_rigid_motion(self):
        rng = np.random.default_rng(2)
        points = rng.normal(size=(4, 3))
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        turn *= np.sign(np.linalg.det(turn))
        moved = points @ turn.T + 1.0
        assert rigid_distances(moved, points).max() < 1e-12
        order = [2, 0, 3, 1]
        assert order_of(moved, points[order]) == order
        assert distance_mm(moved, points[order]) < 1e-9

    def test_lever_arm_is_found_without_the_coil_scored(self):
        places = 0.08 * np.array([[1, 0, 0.3], [-1, 0, 0.3], [0, 1, 0.3], [0, -0.9, 0.5]])
        moments = places + 0.01
        axes = outward(places, moments)
        digitised = places - 2e-3 * axes
        assert best_arm(places, axes, digitised) == pytest.approx(2e-3, abs=1e-4)
        arms, left = arms_left_out(places, moments, digitised)
        np.testing.assert_allclose(arms, 2e-3, atol=1e-4)
        assert left.max() < 1e-4

    def test_leads_stop_where_the_loss_stops_falling(self):
        loss = np.array([[2.0, 2.1], [1.5, 1.6], [1.49, 1.6], [1.2, 1.3], [1.4, 1.4]])
        assert hpi_coils.choose_leads(loss) == 3


class TestFile:
    def test_missing_and_foreign_files(self, tmp_path):
        with pytest.raises(FitError, match='no such file'):
            hpi_coils.load(tmp_path)
        np.savez(tmp_path / 'hpi_coils.npz', a=1)
        with pytest.raises(FitError, match='expected set'):
            hpi_coils.load(tmp_path)

    @needs_data
    def test_stored_amplitudes_are_matched_and_wrong_channels_named(self):
        data = hpi_coils.load(FOLDER)
        tones = demodulate(
            data.epoch,
            data.rate_hz,
            np.array([70.0, 72.0, 74.0, 76.0]),
            data.array.is_magnetometer,
        )
        found = examine(data.array, tones, data.stored)
        assert found.correlation.min() > hpi_coils.TARGET_CORRELATION
        assert found.correlation_in_phase.min() > hpi_coils.TARGET_CORRELATION
        names = np.array(data.array.names)
        assert names[found.noisy].tolist() == ['MEG 2443']
        assert all(name.endswith('3') for name in names[found.inverted])
        coils = [CoilData(s, found.noise, ~found.noisy) for s in found.signals]
        fits = [
            fit_coil(data.array, coil, first_place(data.array, coil, place[None]), hpi_coils.START)
            for coil, place in zip(coils, data.vendor_m[[0, 1, 2, 3]], strict=True)
        ]
        places = np.array([fit.places_m[0] for fit in fits])
        vendor = distance_mm(data.vendor_m, data.digitised_m)
        assert vendor == pytest.approx(2.06, abs=0.01)
        assert distance_mm(places, data.digitised_m) < vendor
