"""Emitters without a drawing, and an axisymmetric one seen from an array of sensors.

The world is a loop of current of a finite size; the models are dipoles on an axis.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tracking_world import three_axis

from anser_ros.apps.lab.source_track import Sources, seen_from
from anser_ros.calibration import sensor_fit
from anser_ros.calibration.layouts import Generator, Layout, coaxial, fit_coaxial, place
from anser_ros.calibration.readings import DipoleSites, basis_rows, check_kept, check_measurements
from anser_ros.calibration.result import corrections, reported_effects
from anser_ros.calibration.sensor_fit import SensorFitter
from anser_ros.calibration.sensor_parameters import KINDS
from anser_ros.diagnosis import decisions, screening
from anser_ros.effects.base import Apparatus, View
from anser_ros.effects.correction import Correction
from anser_ros.effects.effect import effect_named
from anser_ros.errors import FitError, ModelFileError
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import EffectRecord, FieldModel, symmetry_axis
from anser_ros.fingerprint import Identity
from anser_ros.physics.board import loop_field
from anser_ros.physics.pose_track import PoseTrack
from anser_ros.physics.sensor import clusters_of
from anser_ros.physics.volume import TrackedVolume
from anser_ros.pose_states import OK
from anser_ros.sessions.starting_model import with_new_survey
from anser_ros.settings import Accuracy
from anser_ros.tracking.tracker import Tracker, TrackerSettings
from anser_ros.wire.setup import parse_setup
from anser_ros.wire.text_files import read_config

EFFECT = effect_named('sensor_gain_spread')
NONE = EffectRecord(EFFECT.name, {'channels': [999], 'values': [[1.0, 0.0]]})
CENTRE = np.array([0.004, -0.003, 0.002])
AXIS = np.array([0.3, -0.2, 0.9]) / np.linalg.norm([0.3, -0.2, 0.9])
RADIUS_M, MOMENT_AM2, NOISE_T = 0.008, 0.5, 2e-7


def source_field(points):
    """Field (P, 3), T, of a round loop of current."""
    angle = 2 * np.pi * np.arange(90) / 90
    ring = RADIUS_M * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    current = MOMENT_AM2 / (np.pi * RADIUS_M**2)
    return loop_field(ring @ _upright().T + CENTRE, points, current)


def _upright():
    """Rotation matrix that takes +z to the loop's axis."""
    across = np.cross([0.0, 1.0, 0.0], AXIS)
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(AXIS, across), AXIS], axis=1)


def array_of_sensors(rng):
    """Seven three-axis sensors, about 25 mm from each other, each turned at random."""
    places = 0.03 * rng.uniform(-1.0, 1.0, size=(7, 3)) * [1.0, 1.0, 0.3]
    turns = Rotation.random(7, random_state=1).as_matrix()
    axes = turns.transpose(0, 2, 1).reshape(-1, 3)
    return replace(three_axis('array', places), axis=axes)


def recorded(table, rng, frames=40, gains=None):
    """Readings of the array around the source, 60 to 100 mm away, and its true poses."""
    place = rng.uniform([-0.03, -0.03, 0.06], [0.03, 0.03, 0.1], size=(frames, 3))
    turn = Rotation.from_rotvec(0.5 * rng.normal(size=(frames, 3))).as_matrix()
    points, axes = table.placed(place, turn)
    flux = np.einsum('pi,pi->p', source_field(points.reshape(-1, 3)), axes.reshape(-1, 3))
    flux = flux.reshape(frames, -1) * (1.0 if gains is None else gains)
    flux = flux + NOISE_T * rng.normal(size=flux.shape)
    valid = np.ones(flux.shape, dtype=bool)
    return Measurements(
        'array', table, 5.0 * np.arange(frames), flux[:, :, None].astype(complex), valid,
        np.zeros(flux.shape, dtype=int), place, turn, np.ones(frames, dtype=bool),
    )  # fmt: skip


def fitted(measured, count):
    """The dipoles that are found, their moments and the residual, T rms."""
    start = place(
        Layout('coaxial', count, 1.0, 0.0), Generator(np.zeros((1, 3)), np.zeros(1), 0.1)
    )
    weights = [np.ones(measured.valid.shape)]
    sites = fit_coaxial([measured], weights, start, count)
    basis, flux = basis_rows(measured, sites), measured.flux.reshape(-1, 1)
    moments = np.linalg.lstsq(basis, flux, rcond=None)[0]
    return sites, moments, float(np.sqrt(np.mean(np.abs(flux - basis @ moments) ** 2)))


@pytest.fixture(scope='module')
def model():
    """The source as a scan of 60 frames has it."""
    rng = np.random.default_rng(3)
    sites, moments, _ = fitted(recorded(array_of_sensors(rng), rng, 60), 3)
    return FieldModel(sites.positions, sites.directions, moments, ('loop',), (1.0,))


class TestCoaxial:
    def test_place_and_axis_are_found_and_the_size_needs_three_dipoles(self):
        rng = np.random.default_rng(2)
        measured = recorded(array_of_sensors(rng), rng, 60)
        sites, moments, left = fitted(measured, 3)
        assert np.linalg.norm(sites.positions[1] - CENTRE) < 3e-4
        assert abs(sites.directions[1] @ AXIS) > 1.0 - 1e-6
        assert moments.sum().real == pytest.approx(MOMENT_AM2, rel=0.01)
        assert left < 1.1 * NOISE_T
        assert fitted(measured, 1)[2] > 1.6 * NOISE_T

    def test_each_emitter_has_an_axis_of_its_own(self):
        rng = np.random.default_rng(4)
        measured = recorded(array_of_sensors(rng), rng)
        other = coaxial(np.array([[0.02, 0.01, 0.0]]), np.array([[1.0, 0.0, 0.0]]), 1, np.zeros(1))
        second = (basis_rows(measured, other) @ [[0.3]]).reshape(*measured.valid.shape, 1)
        both = replace(measured, flux=np.concatenate([measured.flux, second], axis=2))
        centres = np.array([[0.0, 0.0, 0.0], [0.03, 0.0, 0.0]])
        start = place(Layout('coaxial', 1, 1.0, 0.0), Generator(centres, np.zeros(2), 0.03))
        sites = fit_coaxial([both], [np.ones(measured.valid.shape)], start, 1)
        np.testing.assert_allclose(sites.positions[1], other.positions[0], atol=1e-6)
        np.testing.assert_allclose(np.abs(sites.directions[1]), [1.0, 0.0, 0.0], atol=1e-5)
        assert np.linalg.norm(sites.positions[0] - CENTRE) < 2e-3


@pytest.mark.long
def test_gains_of_an_array_are_found_and_no_lever_arm_that_it_does_not_have():
    rng = np.random.default_rng(5)
    gains = np.repeat(1.0 + 0.02 * rng.normal(size=7), 3)
    measured = recorded(array_of_sensors(rng), rng, 63, gains)
    track = PoseTrack(
        measured.time, measured.position, Rotation.from_matrix(measured.rotation).as_quat()
    )
    generator = Generator(np.zeros((1, 3)), np.zeros(1), 0.02)
    fitter = SensorFitter(
        [replace(measured, track=track)], KINDS, generator, Accuracy(NOISE_T, 2e-4, 2e-3)
    )
    found = fitter.fit()
    own = found.errors_of('array')
    assert 'gains' in found.evidence
    assert np.std(own.gain.real / gains) < np.std(gains) / 3.0
    assert np.abs(own.lever_arm).max() < 1e-4


@pytest.mark.parametrize('rate_hz', [0.2, 25.0])
def test_poses_that_are_seconds_apart_say_nothing_of_movement(rate_hz, monkeypatch):
    def suspicious(time, *others):
        return (time > time[20]) & (time < time[30])

    monkeypatch.setattr(sensor_fit, 'unsteady_tool', suspicious)
    monkeypatch.setattr(sensor_fit, 'SMALL_STEP', -1.0)  # all steps are taken
    rng = np.random.default_rng(7)
    measured = recorded(array_of_sensors(rng), rng, 60)
    time = np.arange(60) / rate_hz
    quaternion = Rotation.from_matrix(measured.rotation).as_quat()
    track = PoseTrack(time, measured.position, quaternion)
    measured = replace(measured, time=time, track=track)
    generator = Generator(np.zeros((1, 3)), np.zeros(1), 0.1)
    accuracy = Accuracy(flux_noise_t=NOISE_T, optical_position_m=1e-5, optical_rotation_rad=1e-4)
    found = SensorFitter([measured], ('gains',), generator, accuracy).fit()
    assert bool(reported_effects(found, [measured])) is (rate_hz > 1.0)


class TestFewPoses:
    def test_many_sensors_make_up_for_poses_where_the_field_alone_is_fitted(self):
        rng = np.random.default_rng(6)
        one = array_of_sensors(rng)
        other = replace(
            one, channel=one.channel + 21, name=tuple(f'b{n}' for n in one.name),
            position=one.position + [0.0, 0.0, 0.02],
        )  # fmt: skip
        measured = recorded(one.joined(other), rng, 4)
        assert check_measurements([measured], 36, field_alone=True) == 168
        with pytest.raises(FitError, match=r'at least 10 frames .* got 4; --estimate none'):
            check_measurements([measured], 36)
        with pytest.raises(FitError, match=r'at least 3 frames .* got 2$'):
            check_measurements([measured.frames(slice(2))], 36, field_alone=True)
        with pytest.raises(FitError, match=r'at least 10 frames .* got 4$'):
            check_measurements([recorded(one, rng, 4)], 36, field_alone=True)

    def test_frames_that_the_survey_left_out_are_counted_where_too_few_are_left(self):
        rng = np.random.default_rng(6)
        measured = recorded(array_of_sensors(rng), rng, 40)
        none = measured.frames(slice(0))
        check_kept([measured, measured], [measured, none], 36)
        few = measured.frames(slice(4))
        with pytest.raises(FitError, match=r'^36 of 40 frames were left out.* frames .* got 4$'):
            check_kept([measured], [few], 36)
        with pytest.raises(FitError, match=r'^40 of 40 frames were left out.* got 0'):
            check_kept([measured], [none], 36)


class TestPickup:
    def test_a_constant_field_in_every_sensor_is_found_and_taken_off(self):
        rng = np.random.default_rng(5)
        measured = recorded(array_of_sensors(rng), rng, 60)
        added = 5e-6 * rng.normal(size=(21, 1))
        dirty = replace(measured, flux=measured.flux + added)
        accuracy = Accuracy(
            flux_noise_t=NOISE_T, optical_position_m=1e-5, optical_rotation_rad=1e-4
        )
        generator = Generator(np.zeros((1, 3)), np.zeros(1), 0.1)
        found = SensorFitter([dirty], ('offsets',), generator, accuracy).fit()
        assert set(found.evidence) == {'offsets'}
        left = found.errors_of('array').pickup - added
        assert np.sqrt(np.mean(np.abs(left) ** 2)) < 0.1 * np.sqrt(np.mean(added**2))
        (record,) = (r for r in corrections(found) if r.name == 'sensor_pickup_spread')
        assert record.parameters['spread'] == pytest.approx(5e-6 / np.sqrt(2.0), rel=0.4)
        undone = Correction.of((record,), dirty.sensors, (1.0,))
        flux = undone.flux(0.0, dirty.sensors.channel, dirty.flux[3])
        np.testing.assert_allclose(flux, measured.flux[3] - left, atol=1e-12)


class TestSymmetry:
    def test_dipoles_on_a_line_are_the_same_all_around(self, model):
        axis = symmetry_axis(model.positions, model.directions, model.moments)
        assert abs(axis.direction @ AXIS) > 1.0 - 1e-5
        assert np.linalg.norm(axis.point - CENTRE) < 2e-3

    def test_one_beside_the_line_or_across_it_is_not(self, model):
        beside = DipoleSites(model.positions + [[0, 0, 0], [1e-4, 0, 0], [0, 0, 0]], AXIS[None])
        assert symmetry_axis(beside.positions, model.directions, model.moments) is None
        across = model.directions.copy()
        across[1] = np.cross(across[1], [1.0, 0.0, 0.0])
        assert symmetry_axis(model.positions, across, model.moments) is None

    def test_three_components_at_one_place_are_one_vector(self):
        places, moments = np.tile(CENTRE, (3, 1)), AXIS[:, None].astype(complex)
        axis = symmetry_axis(places, np.eye(3), moments)
        np.testing.assert_allclose(axis.direction, AXIS, atol=1e-12)


class TestSeenFromABody:
    SETTINGS = TrackerSettings(
        flux_noise_t=NOISE_T, volume=TrackedVolume((-0.08, -0.08, 0.03), (0.08, 0.08, 0.13))
    )

    def found(self, model, measured):
        """Places, axes and sigmas (F, ...) from a cold start in every frame, and the truth."""
        sources = Sources()
        tracker = Tracker(model, measured.sensors, self.SETTINGS, [sources])
        out = []
        for k, flux in enumerate(measured.flux):
            poses = tracker.update(10**10 * (k + 1), measured.sensors.channel, flux)
            assert all(pose.state != OK for pose in poses), 'no pose of six numbers is known'
            out.append(sources.found['array'])
        axis = symmetry_axis(model.positions, model.directions, model.moments)
        true = seen_from(axis, measured.position, measured.rotation)
        return out, true

    def test_a_cold_start_finds_it_to_its_sigma(self, model):
        rng = np.random.default_rng(8)
        found, (place_m, axis) = self.found(model, recorded(array_of_sensors(rng), rng, 30))
        assert [e.reason for e in found if e.state != OK] == []
        miss = np.array([e.position for e in found]) - place_m
        cosine = np.sum(np.array([e.axis for e in found]) * axis, axis=1)
        assert np.linalg.norm(miss, axis=1).max() < 1e-3 and cosine.min() > np.cos(0.02)
        inverse = np.linalg.inv([e.covariance[:3, :3] for e in found])
        chi2 = np.einsum('fi,fij,fj->f', miss, inverse, miss)
        assert 1.0 < np.mean(chi2) < 6.0

    def test_a_model_that_knows_how_gains_change_is_nearer_and_less_sure(self, model):
        rng = np.random.default_rng(9)
        table = array_of_sensors(rng)
        gains = np.repeat(1.0 + 0.01 * rng.normal(size=7), 3)
        told = EffectRecord(
            'sensor_gain_spread',
            {
                'spread': 0.01, 'shared': 0.95, 'channels': list(range(21)),
                'values': [[1.0, 0.0]] * 21,
            },
        )  # fmt: skip
        measured = recorded(table, rng, 30, gains)
        errors, sigmas = [], []
        settings = replace(self.SETTINGS, gate=1e3, adaptive=False)
        for effects in ((), (told,)):
            sources = Sources()
            tracker = Tracker(replace(model, effects=effects), table, settings, [sources])
            axis = symmetry_axis(model.positions, model.directions, model.moments)
            true, _ = seen_from(axis, measured.position, measured.rotation)
            for k, flux in enumerate(measured.flux):
                tracker.update(10**10 * (k + 1), table.channel, flux)
                errors.append(np.linalg.norm(sources.found['array'].position - true[k]))
                sigmas.append(sources.found['array'].sigma_position_m)
        before, after = np.sqrt(np.mean(np.square(np.reshape(errors, (2, -1))), axis=1))
        assert after < 0.8 * before
        assert before > 3.0 * np.mean(sigmas[:30]) and after < 2.0 * np.mean(sigmas[30:])

    def test_separate_coils_have_no_gain_in_common(self):
        table = array_of_sensors(np.random.default_rng(1))
        assert [rows.tolist() for rows in clusters_of(table)][1] == [3, 4, 5]
        record = EffectRecord(
            'sensor_gain_spread',
            {'spread': 0.01, 'shared': 0.2, 'channels': [0, 1], 'values': [[1.0, 0.0]] * 2},
        )
        assert Correction.of((record,), table, (1.0,)).gain_changes() is None

    def test_a_distance_beyond_the_volume_is_said(self, model):
        rng = np.random.default_rng(8)
        measured = recorded(array_of_sensors(rng), rng, 2)
        settings = replace(
            self.SETTINGS, volume=TrackedVolume((-0.05, -0.05, 0.2), (0.05, 0.05, 0.3))
        )
        sources = Sources()
        tracker = Tracker(model, measured.sensors, settings, [sources])
        tracker.update(10**10, measured.sensors.channel, measured.flux[0])
        assert sources.found['array'].state != OK


class TestGainsInADiagnosis:
    def view(self, term, frames=3):
        """Three-axis sensors of one body in a linear field, with a term's gains in force."""
        rng = np.random.default_rng(2)
        flux = 1e-6 * (rng.normal(size=(frames, 39, 2)) + 1j * rng.normal(size=(frames, 39, 2)))
        matrix = EFFECT.channel_matrix(term, np.arange(39))
        linear = np.einsum('st,ftk->fsk', matrix, flux)
        table = three_axis('array', 0.05 * rng.normal(size=(13, 3)))
        nothing = np.zeros((frames, 39, 3, 2))
        return table, View(
            np.arange(frames), table, nothing[:, 0, :, 0], np.tile(np.eye(3), (frames, 1, 1)),
            np.zeros((frames, 6)), nothing[..., 0], nothing[..., 0], linear, linear, nothing,
            nothing, nothing, None, None, np.ones(2), False,
        )  # fmt: skip

    def terms(self, table):
        box = np.zeros((2, 3))
        return EFFECT.candidates(Apparatus((table,), None, 2, np.ones(2), 1.0, None, box, box))

    def test_its_columns_are_the_change_of_the_fluxes(self):
        table, _ = self.view(EFFECT.term(NONE))
        (term,) = self.terms(table)
        rng = np.random.default_rng(3)
        here = term.with_theta(0.02 * rng.normal(size=26))
        step = 1e-6 * rng.normal(size=26)
        (_, before), (_, after) = self.view(here), self.view(here.with_theta(here.theta + step))
        slope = EFFECT.columns(here, before) @ step
        np.testing.assert_allclose(after.linear - before.linear, slope, rtol=1e-5, atol=1e-18)
        assert len(self.terms(table.select(np.arange(30)))) == 0, 'ten places are no population'

    def test_its_record_has_a_value_for_each_channel(self):
        table, _ = self.view(EFFECT.term(NONE))
        (term,) = self.terms(table)
        theta = np.zeros(26)
        theta[6] = 0.03
        record = EFFECT.record(term.with_theta(theta), 1e-8 * np.eye(26))
        read = EFFECT.term(record)
        np.testing.assert_allclose(read.values[9:12, 0], 0.03)
        assert np.count_nonzero(read.values) == 3
        assert record.parameters['spread'] == pytest.approx(np.std(theta[::2]))
        changes = EFFECT.gain_changes(read, table)
        assert changes.shape == (13, 39) and np.count_nonzero(changes) == 39

    def test_a_reading_of_few_values_is_no_outlier_for_its_noise(self):
        white = np.zeros((3000, 2 * 6))
        white[:, :6] = np.random.default_rng(1).normal(size=(3000, 6))
        readings = screening._by_reading(white**2, 6, 1)
        ratio = screening._ratio(decisions.READING_RATIO, screening._values(white**2, 6, 1))
        assert not screening._stands_out(readings, ratio).any()
        assert screening._ratio(decisions.READING_RATIO, 16) == decisions.READING_RATIO


class TestNewSurvey:
    def test_gains_stay_and_places_fall_away(self, model):
        setup = parse_setup(read_config('demo_setup.yaml'))
        body = setup.bodies[0]
        channels = [s.channel for s in setup.sensors if s.body == body][:2]
        gains = EffectRecord(
            'sensor_gain_spread',
            {'spread': 0.01, 'channels': channels, 'values': [[1.0, 0.0]] * 2},
        )
        places = EffectRecord(
            'sensor_place_spread',
            {'spread': 1e-4, 'channels': channels, 'values': [[0.0, 0.0, 1e-4]] * 2},
        )
        made = Identity(setup.identity.board, {**setup.identity.bodies, body: '00000000'})
        old = replace(model, effects=(gains, places), made_for=made)
        new = with_new_survey(old, setup, [body])
        assert new.effects == (gains,)
        assert new.made_for.bodies[body] == setup.identity.bodies[body]
        with pytest.raises(ModelFileError, match='no body'):
            with_new_survey(old, setup, ['nobody'])
        with pytest.raises(ModelFileError, match='does not state'):
            with_new_survey(replace(old, made_for=None), setup, [body])
