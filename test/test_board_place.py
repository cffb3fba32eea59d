"""A model that lies beside its board: found by the references, and not mistaken for metal."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import REPO

from anser_ros.errors import BagError, FitError, ModelFileError
from anser_ros.nodes import field_model_io
from anser_ros.nodes.field_model_io import PlaceWatch
from anser_ros.sessions.baseline import board_place_of, check_place, clean_flux
from anser_ros.sessions.session import load_session
from anser_ros.sessions.starting_model import load_model, model_for
from anser_ros.sessions.tracked_session import track_session


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
    watch = PlaceWatch.of(model, sensors, session.setup, lambda: announced[0])
    assert watch.is_waiting, 'whoever sends references may not be known yet'
    monkeypatch.setattr(field_model_io, 'DISCOVERY_S', 0.0)
    assert not watch.is_waiting
    announced[0] = 1
    assert watch.is_waiting
    frame = SimpleNamespace(readings=session.reference.flux[0])
    window = SimpleNamespace(full=False)
    assert watch.look(frame, window) and not watch.is_waiting and not watch.misplaced
    assert not watch.look(frame, window), 'it is said once'
    bare = PlaceWatch.of(model, sensors.select(np.zeros(0, int)), session.setup, lambda: 1)
    assert not bare.is_waiting and not PlaceWatch().is_waiting
