"""Each stage of `evaluate` and `diagnose` alone: what it takes, what it gives, what it refuses."""

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest
from conftest import REPO

from anser_ros.diagnosis.diagnose import conclude, confirm, screen, search_screened
from anser_ros.diagnosis.problem import test_blocks as held_out_blocks
from anser_ros.diagnosis.search import SearchSettings
from anser_ros.errors import BagError, DiagnosisError, ModelFileError
from anser_ros.field.model import EffectRecord, plain
from anser_ros.sessions.baseline import Baseline, clean_flux
from anser_ros.sessions.diagnosis import (
    SessionDiagnosis,
    held_out_part,
    problem_of,
    spread_of,
    track_held_out,
)
from anser_ros.sessions.diagnosis import to_document as diagnosis_document
from anser_ros.sessions.follower import ModelFollower
from anser_ros.sessions.prepared import correct, prepare
from anser_ros.sessions.session import frames_of, load_session
from anser_ros.sessions.starting_model import FOUND_ON, date_drifts, load_model, save_model
from anser_ros.sessions.tracked_session import metrics, pose_series, track

pytestmark = pytest.mark.usefixtures('shared_tables')

CHANNEL, GAIN = 4, 0.97
LIGHT = SearchSettings(most_effects=1, finalists=2, iterations=4)


def recorded(name):
    """Return a fixture of one of the package's own recordings."""
    return pytest.fixture(lambda: load_session(REPO / 'bags' / f'{name}.mcap'), scope='module')


moving, factory, metal = map(recorded, ('moving', 'factory', 'metal'))


@pytest.fixture(scope='module')
def model():
    return load_model(REPO / 'config' / 'demo_model.yaml')


def with_gain(session):
    """The session with one channel's readings too small."""
    (tool,) = session.tools
    gain = np.where(tool.sensors.channel == CHANNEL, GAIN, 1.0)[:, None]
    return replace(session, tools=(replace(tool, flux=tool.flux * gain),))


def knowing_the_gain(model):
    record = EffectRecord('sensor_gain', {'channel': CHANNEL, 'gain': GAIN, 'phase_deg': 0.0})
    return replace(model, effects=(record,))


class TestPrepare:
    def test_another_board_is_refused(self, moving, model, factory):
        other = replace(model, emitters=tuple(f'other{k}' for k in range(8)))
        with pytest.raises(ModelFileError, match='other0'):
            prepare(moving, other)
        with pytest.raises(ModelFileError, match='other0'):
            prepare(moving, model).with_model(other)

    def test_a_drift_holds_on_the_session_that_it_is_dated_by(self, moving, model):
        drift = EffectRecord('coil_drift', {'coil': 1, 'amount': 0.01, 'tau_s': 5.0})
        dated = date_drifts(replace(model, effects=(drift,)), moving)
        assert dated.effects[0].evidence[FOUND_ON] == moving.start_ns
        prepared = prepare(moving, dated)
        assert prepared.recorded_drift
        later = replace(moving, start_ns=moving.start_ns + 1)
        assert not prepared.with_session(later).recorded_drift
        assert date_drifts(dated, later) == dated, 'the first date stays'


class TestCorrect:
    def test_a_known_gain_is_taken_off(self, moving, model):
        prepared = prepare(with_gain(moving), knowing_the_gain(model))
        flux = correct(prepared).session.tools[0].flux
        np.testing.assert_allclose(flux, moving.tools[0].flux, rtol=1e-12)


class TestTrack:
    def test_frames_come_in_order_with_all_sensors(self, metal):
        frames = list(frames_of(metal))
        stamps = [frame.stamp_ns for frame in frames]
        assert stamps == sorted(set(stamps)) and stamps[0] == metal.start_ns
        one = next(frame for frame in frames if frame.tools is not None)
        first = one.tools
        assert first.channels.tolist() == metal.sensors.channel.tolist()
        assert np.array_equal(first.flux, metal.tools[0].flux[0])
        assert (one.in_phase().tools.flux.imag == 0.0).all()

    def test_nothing_to_compare_has_no_figures_and_no_tools_are_refused(self, moving, model):
        figures = metrics(pose_series('tool_a/0/x', (), np.empty((0, 3)), np.empty((0, 3))))
        assert figures['n'] == 0 and figures['position_rmse_m'] is None
        with pytest.raises(BagError, match='no tool fluxes'):
            track(prepare(replace(moving, tools=()), model))


class TestFollow:
    def test_what_is_missing_is_said(self, metal, model, factory):
        with pytest.raises(BagError, match='a refit needs a baseline'):
            ModelFollower(prepare(metal, model))
        blind = replace(metal, reference=None)
        assert prepare(blind, model, factory).baseline is None
        with pytest.raises(BagError, match='needs reference fluxes'):
            ModelFollower(prepare(blind, model, factory))
        few = Baseline(factory.path, clean_flux(factory, metal.reference.sensors, model))
        few.flux[3:] = np.nan
        with pytest.raises(BagError, match=f'{factory.path}.*a baseline of 3'):
            ModelFollower(replace(prepare(metal, model), baseline=few))


def saved(value):
    """What a stage gave, as it comes back from a file."""
    return pickle.loads(pickle.dumps(value))


@pytest.fixture(scope='module')
def prepared(moving, model):
    return prepare(with_gain(moving), model)


@pytest.fixture(scope='module')
def problem(prepared):
    return problem_of(correct(prepared))


class TestDiagnose:
    def test_what_a_problem_is_made_of(self, prepared, problem):
        assert problem.tools[0].time.size == prepared.session.tools[0].has_pose.sum()
        assert problem.references is None, 'without a baseline the references have no say'
        assert problem.spread == spread_of(prepared)
        with pytest.raises(DiagnosisError, match='needs tool fluxes'):
            problem_of(prepared.with_session(replace(prepared.session, tools=())))

    def test_the_held_out_part_is_tracked_from_the_first_frame_on(self, prepared, problem):
        part = held_out_part(prepared.session, problem)
        (blocks,) = problem.blocks
        times = problem.tools[0].time[np.isin(blocks, held_out_blocks())]
        assert part.tools[0].time.tolist() == [0.0, *times.tolist()]
        assert set(part.reference.time.tolist()) <= set(part.tools[0].time.tolist())

    @pytest.mark.long
    def test_each_stage_takes_what_the_one_before_it_gave_from_a_file(
        self, prepared, problem, model, tmp_path
    ):
        screened = saved(screen(problem))
        assert screened.known == ()
        held = np.isin(screened.training(100).blocks[0], held_out_blocks())
        assert held.size and not held.any()
        search = saved(search_screened(screened, LIGHT))
        confirmed = saved(confirm(screened, search, LIGHT))
        for fit in (search.fit, confirmed.fit):
            assert [term.effect.name for term in fit.terms] == ['sensor_gain']
        assert confirmed.refused == ()
        found = saved(conclude(screened, search, confirmed, model))
        (finding,) = found.findings
        assert finding.record.parameters['channel'] == CHANNEL
        assert finding.record.parameters['gain'] == pytest.approx(GAIN, abs=1e-3)
        assert found.flux_rms_after_t < 0.1 * found.flux_rms_before_t
        unseen = prepared.with_session(held_out_part(prepared.session, problem))
        before, after = track_held_out(unseen, found)
        assert after.position_rmse_m < 0.2e-3 < before.position_rmse_m
        document = diagnosis_document(SessionDiagnosis(found, before, after))
        again = json.loads(json.dumps(document))
        assert again['held_out']['position_rmse_after_m'] == after.position_rmse_m
        assert [effect['name'] for effect in again['effects']] == ['sensor_gain']
        save_model(tmp_path / 'model.yaml', found.model)
        effects = load_model(tmp_path / 'model.yaml').effects
        assert effects[0].parameters == plain(dict(found.model.effects[0].parameters))


def test_plain_data_has_no_arrays():
    value = {1: (np.float64(2.0), np.arange(2)), 'z': 1 + 2j, 'text': 'as it is', 'none': None}
    out = plain(value)
    assert out == {'1': [2.0, [0, 1]], 'z': [1.0, 2.0], 'text': 'as it is', 'none': None}
    assert type(out['1'][0]) is float
