"""Each stage of `evaluate` and `diagnose` alone: what it takes, what it gives, what it refuses."""

import csv
import json
import pickle
from dataclasses import FrozenInstanceError, replace
from pathlib import Path

import numpy as np
import pytest

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
from anser_ros.sessions.evaluation_files import POSE_COLUMNS, write_tables
from anser_ros.sessions.evaluation_files import to_document as evaluation_document
from anser_ros.sessions.follower import ModelFollower
from anser_ros.sessions.nominal_board import NominalBoard
from anser_ros.sessions.prepared import correct, prepare
from anser_ros.sessions.session import empty_session, frames_of, load_session
from anser_ros.sessions.starting_model import FOUND_ON, date_drifts, load_model, save_model
from anser_ros.sessions.tracked_session import metrics, pose_series, track

pytestmark = pytest.mark.usefixtures('shared_tables')

ROOT = Path(__file__).resolve().parents[1]
CHANNEL, GAIN = 4, 0.97
LIGHT = SearchSettings(most_effects=1, finalists=2, iterations=4)


@pytest.fixture(scope='module')
def model():
    return load_model(ROOT / 'config' / 'demo_model.yaml')


@pytest.fixture(scope='module')
def moving():
    return load_session(ROOT / 'bags' / 'moving.mcap')


@pytest.fixture(scope='module')
def factory():
    return load_session(ROOT / 'bags' / 'factory.mcap')


@pytest.fixture(scope='module')
def metal():
    return load_session(ROOT / 'bags' / 'metal.mcap')


def beginning(session, frames):
    """The first frames of a session."""
    tools = tuple(tool.frames(np.arange(frames)) for tool in session.tools)
    reference = session.reference.frames(np.arange(frames))
    return replace(session, tools=tools, reference=reference)


def with_gain(session):
    """The session with one channel's readings too small."""
    (tool,) = session.tools
    gain = np.where(tool.sensors.channel == CHANNEL, GAIN, 1.0)[:, None]
    return replace(session, tools=(replace(tool, flux=tool.flux * gain),))


def knowing_the_gain(model):
    record = EffectRecord('sensor_gain', {'channel': CHANNEL, 'gain': GAIN, 'phase_deg': 0.0})
    return replace(model, effects=(record,))


class TestPrepare:
    def test_works_out_what_follows_from_session_and_model(self, moving, model, factory):
        prepared = prepare(moving, model, factory)
        assert prepared.sensors.name == moving.tools[0].sensors.name
        assert prepared.baseline.path == factory.path
        assert prepared.baseline.flux.shape == (len(moving.reference.sensors), 8)
        assert np.isfinite(prepared.baseline.flux).all()
        assert prepared.nominal.board.names == model.emitters
        assert not prepared.correction.terms and not prepared.recorded_drift
        with pytest.raises(FrozenInstanceError):
            prepared.model = model

    def test_another_board_is_refused(self, moving, model, factory):
        other = replace(model, emitters=tuple(f'other{k}' for k in range(8)))
        with pytest.raises(ModelFileError, match='other0'):
            prepare(moving, other)
        with pytest.raises(ModelFileError, match='other0'):
            prepare(moving, model).with_model(other)

    def test_an_empty_session_is_prepared_as_a_recorded_one(self, moving, model, factory):
        empty = empty_session(moving.setup, 'nowhere')
        assert empty.tools[0].flux.shape == (0, 9, 8) and empty.reference.time.size == 0
        early, late = prepare(empty, model, factory), prepare(moving, model, factory)
        assert np.array_equal(early.baseline.flux, late.baseline.flux)
        assert early.sensors.name == late.sensors.name

    def test_the_nominal_model_is_made_once(self, moving, model):
        prepared = prepare(moving, model)
        drawn = prepared.nominal.model
        assert drawn.emitters == model.emitters
        assert prepared.with_session(beginning(moving, 2)).nominal.model is drawn
        assert NominalBoard(None).model is None and NominalBoard(None).field is None

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

    def test_without_effects_all_stays(self, moving, model):
        prepared = prepare(moving, model)
        assert correct(prepared).session.tools[0] is moving.tools[0]


class TestTrack:
    def test_frames_come_in_order_with_all_sensors(self, metal):
        frames = list(frames_of(metal))
        stamps = [frame.stamp_ns for frame in frames]
        assert stamps == sorted(set(stamps)) and stamps[0] == metal.start_ns
        first = next(frame.tools for frame in frames if frame.tools is not None)
        assert first.channels.tolist() == metal.sensors.channel.tolist()
        assert np.array_equal(first.flux, metal.tools[0].flux[0])
        assert (first.in_phase().flux.imag == 0.0).all()

    def test_tracked_compared_and_written(self, moving, model, tmp_path):
        prepared = prepare(beginning(moving, 5), model)
        evaluation = track(prepared)
        series = evaluation.sensors | evaluation.bodies
        assert {len(one.estimates) for one in series.values()} == {5}
        assert set(series) == {*prepared.sensors.name, 'tool_a'}
        assert evaluation.refit is None and evaluation.seconds_per_frame > 0.0
        assert max(np.max(s.position_error) for s in evaluation.sensors.values()) < 1e-3
        assert (
            json.loads(json.dumps(evaluation_document(evaluation)))['bodies']['tool_a']['n'] == 5
        )
        write_tables(tmp_path, evaluation)
        rows = list(csv.DictReader((tmp_path / 'poses.csv').read_text().splitlines()))
        assert tuple(rows[0]) == POSE_COLUMNS and len(rows) == 9 * 5

    def test_nothing_to_compare_has_no_figures(self):
        figures = metrics(pose_series('tool_a/0/x', (), np.empty((0, 3)), np.empty((0, 3))))
        assert figures['n'] == 0 and figures['position_rmse_m'] is None

    def test_without_tools_is_refused(self, moving, model):
        with pytest.raises(BagError, match='no tool fluxes'):
            track(prepare(replace(moving, tools=()), model))


class TestFollow:
    @pytest.mark.long
    def test_the_model_follows_metal_frame_by_frame(self, metal, model, factory):
        follower = ModelFollower(prepare(metal, model, factory))
        frames = [frame for frame in frames_of(metal) if frame.reference is not None]
        standings = [follower.at(frame) for frame in frames[:3]]
        assert all(s.model.emitters == model.emitters and s.withheld is None for s in standings)
        assert sum(follower.summary.states.values()) == 3
        silent = replace(frames[3], reference=None)
        assert follower.at(silent).withheld is None
        late = replace(silent, stamp_ns=silent.stamp_ns + 10**9)
        assert follower.at(late).withheld.state == 'references_lost'

    def test_what_is_missing_is_said(self, metal, model, factory):
        with pytest.raises(BagError, match='--baseline'):
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


@pytest.fixture(scope='module')
def screened(problem):
    return saved(screen(problem))


@pytest.fixture(scope='module')
def search(screened):
    return saved(search_screened(screened, LIGHT))


@pytest.fixture(scope='module')
def confirmed(screened, search):
    return saved(confirm(screened, search, LIGHT))


@pytest.fixture(scope='module')
def found(screened, search, confirmed, model):
    return saved(conclude(screened, search, confirmed, model))


class TestDiagnose:
    """The stages in their order, each with what the one before it gave, from a file."""

    def test_problem(self, prepared, problem):
        assert problem.tools[0].time.size == prepared.session.tools[0].has_pose.sum()
        assert problem.references is None, 'without a baseline the references have no say'
        assert problem.spread == spread_of(prepared)
        with pytest.raises(DiagnosisError, match='needs tool fluxes'):
            problem_of(prepared.with_session(replace(prepared.session, tools=())))

    def test_screen(self, screened, problem):
        assert screened.known == ()
        assert screened.whole.tools[0].time.size == problem.tools[0].time.size
        held = np.isin(screened.training(100).blocks[0], held_out_blocks())
        assert held.size and not held.any()

    @pytest.mark.long
    def test_search(self, search):
        assert [term.effect.name for term in search.fit.terms] == ['sensor_gain']

    @pytest.mark.long
    def test_confirm(self, confirmed):
        assert [term.effect.name for term in confirmed.fit.terms] == ['sensor_gain']
        assert confirmed.refused == ()

    @pytest.mark.long
    def test_conclude(self, found):
        (finding,) = found.findings
        assert finding.record.parameters['channel'] == CHANNEL
        assert finding.record.parameters['gain'] == pytest.approx(GAIN, abs=1e-3)
        assert found.flux_rms_after_t < 0.1 * found.flux_rms_before_t

    def test_held_out_part(self, prepared, problem):
        part = held_out_part(prepared.session, problem)
        (blocks,) = problem.blocks
        times = problem.tools[0].time[np.isin(blocks, held_out_blocks())]
        assert part.tools[0].time.tolist() == [0.0, *times.tolist()]
        assert set(part.reference.time.tolist()) <= set(part.tools[0].time.tolist())

    @pytest.mark.long
    def test_track_held_out_and_document(self, prepared, problem, found, tmp_path):
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
