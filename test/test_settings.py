"""Values that an installation states: read everywhere by one name, and each of them matters."""

import argparse
from copy import copy
from dataclasses import replace

import numpy as np
import pytest
import yaml
from conftest import REPO
from refit_world import anser_world
from test_setup import document

from anser_ros.cli import calibrate, diagnose, evaluate
from anser_ros.errors import ParameterError, SetupError
from anser_ros.refit.prior import UPRIGHT, build_prior
from anser_ros.sessions.diagnosis import spread_of
from anser_ros.sessions.prepared import prepare
from anser_ros.sessions.session import load_session, measured_noise, stamp_sigma, tracking_noise
from anser_ros.sessions.starting_model import model_for
from anser_ros.sessions.tracked_session import track_session
from anser_ros.settings import (
    SECTIONS,
    VALUES,
    Accuracy,
    RefitSettings,
    parse_entries,
    settings_from,
)
from anser_ros.tracking.estimate import TrackerSettings
from anser_ros.wire.setup import dump_setup, parse_setup

pytestmark = pytest.mark.usefixtures('shared_tables')

BAGS = REPO / 'bags'
OTHER = {
    'flux_noise_t': 1.5e-10, 'optical_position_m': 0.3e-3, 'optical_rotation_rad': 2e-3,
    'reference_position_m': 1e-3, 'reference_axis_rad': 0.02, 'reference_gain': 0.02,
    'stamp_sigma_s': 2e-3, 'emitter_drift': 0.05, 'min_references': 8, 'average_frames': 1,
    'persistence': 0.5, 'hold_frames': 3, 'references_age_s': 2.0, 'error_modes': 5, 'seed': 9,
    'tool_coil_position_m': 1e-3, 'tool_coil_axis_rad': 0.05, 'tool_coil_gain': 0.02,
    'max_speed_m_s': 0.5, 'max_acceleration_m_s2': 5.0, 'emitter_offset': 1e-9,
    'emitter_rate_1_s': 1e-12,
}  # fmt: skip
"""Another value of everything that may be stated."""
OPTICAL = ('optical_position_m', 'optical_rotation_rad')
TRACKED = [name for name in VALUES if name != OPTICAL[1]]
"""What has an effect on an evaluation, which compares places and directions alone."""


def setup_with(**sections):
    return parse_setup(yaml.safe_dump({**document(), **sections}))


def entries(stated):
    return [f'{name}={value!r}' for name, value in stated.items()]


def read(settings, name):
    part = next(key for key, names in SECTIONS.items() if name in names)
    return getattr(settings if part == 'refit' else getattr(settings, part), name)


@pytest.fixture(scope='module')
def world():
    return anser_world()


@pytest.fixture(scope='module')
def usual(world):
    return world.refit()


class TestStating:
    def test_no_name_stands_twice_and_every_one_is_tried_here(self):
        assert sum(map(len, SECTIONS.values())) == len(VALUES)
        assert set(OTHER) == set(VALUES)
        assert all(read(RefitSettings(), name) != value for name, value in OTHER.items())

    @pytest.mark.parametrize('name', VALUES)
    def test_the_setup_document_states_it(self, name):
        section = next(key for key, names in SECTIONS.items() if name in names)
        setup = setup_with(**{section: {name: OTHER[name]}})
        assert read(setup.refit, name) == OTHER[name]
        others = [other for other in VALUES if other != name]
        assert all(read(setup.refit, other) == VALUES[other].default for other in others)
        assert parse_setup(dump_setup(setup)) == setup
        assert not set(SECTIONS) & set(setup.extra)

    def test_an_option_goes_before_the_document_and_that_before_the_default(self):
        setup = setup_with(accuracy={'reference_gain': 0.01, 'flux_noise_t': 1e-10})
        above = setup.with_stated(parse_entries(['reference_gain=0.02', 'seed=3']))
        assert (above.accuracy.reference_gain, above.refit.seed) == (0.02, 3)
        assert above.accuracy.flux_noise_t == 1e-10
        assert above.accuracy.reference_position_m == Accuracy.reference_position_m
        assert setup.accuracy.reference_gain == 0.01

    @pytest.mark.parametrize(
        ('sections', 'said'),
        [
            ({'accuracy': {'gain': 0.1}}, 'accuracy has no key gain; it may have flux_noise_t'),
            ({'refit': {'reference_gain': 0.1}}, 'refit has no key reference_gain'),
            ({'accuracy': {'reference_gain': -0.1}}, r'reference_gain must be in \[0, 1\], got'),
            ({'accuracy': {'flux_noise_t': 0}}, 'flux_noise_t must be in'),
            ({'accuracy': {'flux_noise_t': '6e-11'}}, 'YAML takes 6e-11 for text'),
            ({'accuracy': {'reference_gain': True}}, 'reference_gain must be a number'),
            ({'accuracy': {'reference_gain': float('nan')}}, 'reference_gain must be a number'),
            ({'refit': {'min_references': 4.5}}, 'min_references must be a whole number'),
            ({'refit': [1]}, 'refit must be a mapping'),
        ],
    )
    def test_a_bad_document_is_told_in_one_line(self, sections, said):
        with pytest.raises(SetupError, match=said) as error:
            setup_with(**sections)
        assert '\n' not in str(error.value)

    @pytest.mark.parametrize(
        ('given', 'said'),
        [
            (['gain=1'], 'no value gain to state; there are: flux_noise_t'),
            (['seed'], "'seed' must be NAME=VALUE with a number"),
            (['seed=1.5'], "'seed=1.5' must be NAME=VALUE"),
            (['seed=1', 'seed=2'], 'seed is stated twice'),
            (['persistence=1'], r'persistence must be in \[0.01, 0.9999\]'),
            (['reference_gain=inf'], 'reference_gain must be a number, got inf'),
        ],
    )
    def test_bad_entries_are_told_in_one_line(self, given, said):
        with pytest.raises(ParameterError, match=said) as error:
            parse_entries(given)
        assert '\n' not in str(error.value)

    def test_what_the_acquisition_measured_gives_way_to_what_is_stated(self):
        told = setup_with(flux_noise_t=2e-10)
        assert (measured_noise(told), tracking_noise(told)) == (2e-10, 2e-10)
        quiet = setup_with(flux_noise_t=2e-11)
        assert tracking_noise(quiet) == Accuracy.flux_noise_t
        stated = told.with_stated({'flux_noise_t': 5e-11})
        assert (measured_noise(stated), tracking_noise(stated)) == (0.0, 5e-11)
        found = [tracking_noise(one, 7e-12) for one in (told, setup_with(), stated)]
        assert found == [2e-10, 7e-12, 5e-11], 'what a calibration found is before a document'

    def test_the_stamps_error_that_was_measured_gives_way_to_what_is_stated(self):
        assert stamp_sigma(setup_with()) == Accuracy.stamp_sigma_s
        assert stamp_sigma(setup_with(stamp_sigma_s=1e-3)) == 1e-3
        assert stamp_sigma(setup_with(stamp_sigma_s=0)) == 0.0
        for nonsense in (-1e-3, 'late', True, 5.0, float('nan')):
            assert stamp_sigma(setup_with(stamp_sigma_s=nonsense)) == Accuracy.stamp_sigma_s
        stated = setup_with(stamp_sigma_s=1e-3).with_stated({'stamp_sigma_s': 2e-3})
        assert stamp_sigma(stated) == 2e-3


@pytest.mark.long
class TestEffect:
    def with_settings(self, usual, **values):
        """The refit with other settings that its tables do not depend on."""
        other = copy(usual)
        other.settings = replace(usual.settings, **values)
        other._prepare()
        other.reset()
        return other

    @pytest.mark.parametrize(
        'name', ['reference_position_m', 'reference_axis_rad', 'reference_gain']
    )
    def test_the_survey_is_in_what_metal_may_look_like(self, world, usual, name):
        tables = usual._tables
        cloud, layer = tables.priors[0].cloud, tables.priors[0].layer
        covariances = [
            build_prior(
                cloud, UPRIGHT, layer, world.references, tables.excitation.field(cloud.positions),
                np.array(tables.frequencies_hz), accuracy, np.random.default_rng(1),
            ).covariance
            for accuracy in (Accuracy(), Accuracy(**{name: OTHER[name]}))
        ]  # fmt: skip
        assert not np.array_equal(*covariances)

    def test_the_seed_is_that_of_the_draws(self, usual):
        body = [
            replace(usual._tables, settings=settings_from(s)).body_prior(0) for s in ({}, OTHER)
        ]
        assert not np.array_equal(body[0].draw_moments, body[1].draw_moments)

    def test_the_refit_makes_another_model(self, world, usual):
        usual.reset()
        flux = world.baseline + world.metal(np.array([[0.03, -0.02, -0.09]]))
        channels = world.references.channel
        one = usual.update(1, channels, flux).model
        noisy = Accuracy(flux_noise_t=OTHER['flux_noise_t'])
        for values in ({'emitter_drift': OTHER['emitter_drift']}, {'accuracy': noisy}):
            other = self.with_settings(usual, **values).update(1, channels, flux).model
            assert not np.array_equal(one.moments, other.moments)
        other = self.with_settings(usual, error_modes=OTHER['error_modes'])
        less = VALUES['error_modes'].default - OTHER['error_modes']
        assert len(one.modes) - len(other.update(1, channels, flux).model.modes) == less

    def test_the_refit_counts_references_and_frames(self, world, usual):
        channels, flux = world.references.channel, world.baseline
        few = self.with_settings(usual, min_references=len(world.references) + 1)
        assert few.update(1, channels, flux).state == 'few_references'
        brief = self.with_settings(usual, average_frames=1, hold_frames=3, persistence=0.5)
        assert brief._average.longest == 1
        brief._watch.exclude(0)
        for _ in range(3):
            assert brief._watch.excluded[0]
            brief._watch.agreed(0, True)
            brief._watch.readmit()
        assert not brief._watch.excluded[0]
        usual.reset()
        odds = [refit.update(1, channels, flux).log_odds for refit in (usual, brief)]
        assert odds[0] != odds[1]

    def test_the_diagnosis(self):
        session = load_session(BAGS / 'moving.mcap')
        model = model_for('nominal', session)
        usual = spread_of(prepare(session, model))
        for name in SECTIONS['accuracy']:
            spread = spread_of(prepare(session.with_stated({name: OTHER[name]}), model))
            assert getattr(spread.accuracy, name) == OTHER[name]
            if name.startswith('reference'):
                assert spread.reference_change > 1.2 * usual.reference_change
            if name == 'flux_noise_t':
                assert spread.flux_t > usual.flux_t and spread.noise_t == OTHER[name]
            if name.startswith('optical'):
                assert (spread.accuracy.pose_jitter > 1.2 * usual.accuracy.pose_jitter).any()
        assert usual.reference_change == 0.01


class TestCommands:
    @pytest.mark.parametrize(
        ('name', 'used'),
        [('evaluate', TRACKED), ('diagnose', VALUES), ('calibrate', SECTIONS['accuracy'])],
    )
    def test_the_session_has_what_is_stated(self, name, used, monkeypatch, tmp_path):
        module = {'evaluate': evaluate, 'diagnose': diagnose, 'calibrate': calibrate}[name]
        target = {'evaluate': 'track_session', 'calibrate': 'calibrate_sessions'}
        seen = []

        def keep(session, *_arguments, **_options):
            seen.append(session[0] if isinstance(session, list) else session)
            raise ParameterError('kept')

        monkeypatch.setattr(module, target.get(name, 'diagnose_session'), keep)
        parser = argparse.ArgumentParser()
        module.add_arguments(parser)
        given = [str(BAGS / 'moving.mcap'), '--out', str(tmp_path / 'out')]
        if name != 'calibrate':
            given += ['--model', 'nominal']
        for entry in entries({key: OTHER[key] for key in used}):
            given += ['--set', entry]
        baseline = ['--baseline', str(BAGS / 'scan.mcap')]
        kept = {'evaluate': ['--refit'], 'diagnose': baseline}.get(name, [])
        for words, options in (('kept', kept), ('effect', [] if kept else ['--set', 'seed=3'])):
            args = parser.parse_args(given + options)
            args.session = getattr(args, 'session', None) or args.sessions[0]
            with pytest.raises(ParameterError, match=words):
                module.work(args, lambda *words: None)
        assert all(read(seen[0].setup.refit, key) == OTHER[key] for key in used)

    def test_tracking_starts_from_the_stated_noise(self):
        session = load_session(BAGS / 'moving.mcap')
        brief = replace(session, tools=tuple(tool.frames(np.arange(3)) for tool in session.tools))
        model = model_for('nominal', session)
        sigma = []
        for stated in ({}, {'flux_noise_t': 2e-8}):
            found = track_session(brief.with_stated(stated), model, TrackerSettings(gate=np.inf))
            series = next(iter(found.sensors.values()))
            sigma.append(series.estimates[0].sigma_position_m)
        assert sigma[1] > 1.05 * sigma[0]
