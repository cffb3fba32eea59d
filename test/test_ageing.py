"""A model whose references fell silent, or that lies beside its board: no poses after a while."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import REPO
from tracking_world import certain_model

from anser_ros.errors import BagError, FitError, ModelFileError
from anser_ros.integrity.model_age import ModelAge
from anser_ros.nodes import field_model_io
from anser_ros.nodes.field_model_io import PlaceWatch
from anser_ros.physics.volume import TrackedVolume
from anser_ros.pose_states import REFERENCES_LOST, Withheld
from anser_ros.sessions.baseline import board_place_of, check_place, clean_flux
from anser_ros.sessions.session import load_session
from anser_ros.sessions.starting_model import load_model, model_for
from anser_ros.sessions.tracked_session import track_session

STEP_NS = 20_000_000
LONGEST_S = 0.5


def model_with_metal(time_s, speed_m_s=0.1, added=False):
    """A board's model while a small body comes up from below, which changes what it induces."""
    base = certain_model()
    height = -0.3 + speed_m_s * time_s
    strength = 3e-4 / abs(height) ** 3 * np.ones((1, len(base.emitters)), dtype=complex)
    place = np.array([[0.02, 0.0, height if added else -0.1]])
    return base.with_dipoles(place, np.array([[0.0, 0.0, 1.0]]), strength)


@pytest.mark.parametrize('added', [False, True])
def test_what_moves_on_unseen_stays_within_what_the_aged_model_says(added):
    age = ModelAge(LONGEST_S, TrackedVolume())
    for frame in range(60):
        age.answered(1 + frame * STEP_NS, model_with_metal(frame * 0.02, added=added))
    points = TrackedVolume().samples(4, 3)
    axes = np.tile([0.0, 0.6, 0.8], (len(points), 1))
    last_ns, fresh = age.newest_ns, age.at(age.newest_ns).model
    assert fresh is age.at(last_ns - 5).model, (
        'a model that is no older than its frame is as it was'
    )
    sigmas = []
    for later_s in (0.1, 0.3, 0.5):
        standing = age.at(last_ns + round(later_s * 1e9))
        assert standing.withheld is None
        true = model_with_metal(1.18 + later_s, added=added).flux(points, axes)
        error = true - standing.model.flux(points, axes)
        variance = np.full(error.shape, standing.model.flux_error_t**2)
        for mode in standing.model.modes:
            variance += np.abs(replace(standing.model, moments=mode).flux(points, axes)) ** 2
        assert (np.abs(error) < 3.0 * np.sqrt(variance)).mean() > 0.98
        sigmas.append(np.sqrt(variance.mean()))
    assert sigmas[0] < sigmas[1] < sigmas[2] < 20.0 * np.abs(error).max(), 'no more than needed'
    lost = age.at(last_ns + round(0.51e9)).withheld
    assert lost == (REFERENCES_LOST, 'no reference fluxes for 0.51 s, 0.5 s at most')


def test_what_rests_keeps_its_certainty_until_it_is_given_up():
    model, age = certain_model(), ModelAge(LONGEST_S, TrackedVolume())
    assert age.at(7).model is None and age.at(7).withheld is None, 'it never followed anything'
    few = Withheld(REFERENCES_LOST, 'too few')
    assert age.at(7, few).withheld == few
    for frame in range(100):
        age.answered(1 + frame * STEP_NS, model)
    assert age.at(age.newest_ns + 400_000_000).model is model
    assert 'too few' in age.at(age.newest_ns + 600_000_000, few).withheld.reason
    age.answered(age.newest_ns + 10**9, model)
    assert age.at(age.newest_ns).withheld is None, 'they are back'
    age.answered(5, model)
    assert age.at(10).withheld is None, 'a recording begins anew'
    age.forget()
    assert age.at(10**12).withheld is None


def test_the_same_answer_again_replaces_the_first():
    """Its uncertainty may come after it; two answers of one moment tell no speed."""
    age = ModelAge(LONGEST_S, TrackedVolume())
    age.answered(1, model_with_metal(0.0))
    age.answered(1, again := model_with_metal(0.1))
    assert age.at(1).model is again is age.at(2).model


@pytest.mark.long
@pytest.mark.usefixtures('shared_tables')
def test_a_session_whose_references_stop_near_metal_has_no_wrong_pose():
    session = load_session(REPO / 'bags/metal.mcap')
    model, clean = load_model(REPO / 'config/demo_model.yaml'), REPO / 'bags/factory.mcap'
    reference = session.reference
    stop_s = 4.0
    kept = reference.time < stop_s
    names = ('time', 'flux', 'valid', 'flags', 'position', 'rotation', 'has_pose')
    cut = replace(reference, **{name: getattr(reference, name)[kept] for name in names})
    found = track_session(
        replace(session, reference=cut), model, baseline=load_session(clean), refit=True
    )
    time = session.tools[0].time
    for series in found.sensors.values():
        states = np.array([e.state for e in series.estimates])
        sigma = np.array([e.sigma_position_m for e in series.estimates])
        assert (states[time > stop_s + LONGEST_S] == REFERENCES_LOST).all()
        held = time < stop_s
        assert (states[held] == 'ok').mean() > 0.98
        wrong = series.position_error > np.maximum(3.0 * sigma, 1e-3)
        assert not (wrong & (states == 'ok')).any()


@pytest.fixture(scope='module')
def recorded():
    """A simulated recording of a board with manufacturing errors, and a calibrated model of it."""
    session = load_session(REPO / 'bags' / 'factory.mcap')
    return session, load_model(REPO / 'config/demo_model.yaml')


def found(session, model, flux):
    return board_place_of(model, session.reference.sensors, session.setup).misplacement(flux)


def test_a_calibrated_model_lies_where_the_references_have_the_board(recorded):
    session, model = recorded
    one_frame = session.reference.flux[0].copy()
    one_frame[4] = np.nan
    placed = found(session, model, one_frame)
    assert np.abs(placed.shift_m).max() < 1e-4 and placed.sigma_m.max() < 1.5e-4
    assert np.abs(placed.turn_rad).max() < 1e-3
    assert not placed.is_certain
    assert found(session, model, np.full_like(one_frame, np.nan)) is None


@pytest.mark.parametrize('shift', [(2e-3, 0.0, 0.0), (0.0, -1e-3, 0.0), (0.0, 0.0, 1e-3)])
def test_a_model_that_lies_aside_is_refused_and_its_shift_is_told(recorded, shift):
    session, model = recorded
    aside = replace(model, positions=model.positions + np.array(shift))
    flux = session.reference.flux[0]
    placed = found(session, aside, flux)
    # What is told is where the board is, seen from the model.
    assert placed.shift_m == pytest.approx(-np.array(shift), abs=1.5e-4)
    assert placed.is_certain
    with pytest.raises(BagError, match='from where the references locate the board'):
        clean_flux(session, session.reference.sensors, aside)


def test_a_session_is_not_tracked_with_a_model_that_its_references_contradict(recorded):
    _, model = recorded
    near_metal = load_session(REPO / 'bags' / 'metal.mcap')
    check_place(model, near_metal)
    aside = replace(model, positions=model.positions + np.array([2e-3, 0.0, 0.0]))
    with pytest.raises(ModelFileError, match=r'2\.\d mm .* from where the references locate'):
        track_session(near_metal, aside)
    check_place(aside, replace(near_metal, reference=None))


def test_metal_is_no_board_that_lies_elsewhere(recorded):
    session, model = recorded
    recording = load_session(REPO / 'bags' / 'metal.mcap').reference
    size = np.linalg.norm(recording.flux - recording.flux[0], axis=(1, 2))
    near = recording.flux[np.argmax(size)]
    placed = found(session, model, near)
    assert np.linalg.norm(placed.shift_m) > 1e-4
    assert not placed.is_certain


def test_the_drawing_and_a_model_with_metal_are_not_asked(recorded):
    session, model = recorded
    sensors, setup = session.reference.sensors, session.setup
    assert board_place_of(model_for('nominal', session), sensors, setup) is None
    assert board_place_of(model, sensors.select(np.zeros(0, dtype=np.int64)), setup) is None
    few = session.reference.flux[0].copy()
    few[3:] = np.nan
    assert not board_place_of(model, sensors, setup).check(few)
    aside = replace(model, positions=model.positions + [0.0, 0.003, 0.0])
    with pytest.raises(FitError, match=r'lies 3\.\d mm \(.* along x, y, z\)'):
        board_place_of(aside, sensors, setup).check(session.reference.flux[0])


def test_poses_wait_for_references_that_are_announced_and_not_for_others(recorded, monkeypatch):
    from types import SimpleNamespace

    session, model = recorded
    sensors, announced = session.reference.sensors, [0]
    watch = PlaceWatch(board_place_of(model, sensors, session.setup), lambda: announced[0])
    assert watch.is_waiting, 'whoever sends references may not be known yet'
    monkeypatch.setattr(field_model_io, 'DISCOVERY_S', 0.0)
    assert not watch.is_waiting
    announced[0] = 1
    assert watch.is_waiting
    frame = SimpleNamespace(readings=session.reference.flux[0])
    window = SimpleNamespace(full=False)
    assert watch.look(frame, window) and not watch.is_waiting and not watch.misplaced
    assert not watch.look(frame, window), 'it is said once'
    none = sensors.select(np.zeros(0, int))
    bare = PlaceWatch(board_place_of(model, none, session.setup), lambda: 1)
    assert not bare.is_waiting and not PlaceWatch().is_waiting
