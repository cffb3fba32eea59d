"""A refit with some of a session's reference sensors, or with none of them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from anser_ros.cli.main import main
from anser_ros.errors import BagError, ParameterError
from anser_ros.sessions.follower import parse_references, with_references
from anser_ros.sessions.session import load_session
from anser_ros.sessions.starting_model import load_model
from anser_ros.sessions.tracked_session import track_session

REPO = Path(__file__).resolve().parents[1]
MODEL = REPO / 'config' / 'demo_model.yaml'
METAL = REPO / 'bags' / 'metal.mcap'


@pytest.fixture(scope='module')
def metal():
    """A few frames with metal near."""
    session = load_session(METAL)
    late = slice(-12, None)
    tools = tuple(tool.frames(late) for tool in session.tools)
    return replace(session, tools=tools, reference=session.reference.frames(late))


@pytest.mark.parametrize('text', ['', '1,1', '3,x', '3;4', 'None', '-1'])
def test_a_list_that_is_none_is_refused(text):
    with pytest.raises(ParameterError, match='references'):
        parse_references(text)


def test_a_list_of_channels_is_read():
    assert parse_references('17, 20') == (17, 20)
    assert parse_references('none') == ()


def test_the_chosen_references_are_all_that_a_session_has(metal):
    channels = metal.reference.sensors.channel
    chosen = with_references(metal, channels[[5, 2]].tolist()).reference
    assert chosen.sensors.channel.tolist() == channels[[2, 5]].tolist()
    np.testing.assert_array_equal(chosen.flux, metal.reference.flux[:, [2, 5]])
    with pytest.raises(BagError, match='no reference sensor on channel 9999'):
        with_references(metal, [int(channels[0]), 9999])
    with pytest.raises(BagError, match='no reference fluxes'):
        with_references(replace(metal, reference=None), [1])


@pytest.mark.long
@pytest.mark.usefixtures('shared_tables')
def test_without_enough_references_there_is_no_pose_near_metal(metal):
    model, clean = load_model(MODEL), load_session(REPO / 'bags' / 'factory.mcap')
    few, none = (
        track_session(
            with_references(metal, metal.reference.sensors.channel[:count].tolist()), model,
            baseline=clean, refit=True,
        )
        for count in (2, 0)
    )  # fmt: skip
    assert {e.state for s in few.sensors.values() for e in s.estimates} == {'references_lost'}
    alone = track_session(metal, model)
    for name, series in alone.sensors.items():
        states = [e.state for e in series.estimates]
        assert [e.state for e in none.sensors[name].estimates] == states
        assert 'residual' in states and 'ok' not in states, 'metal is noticed without references'


def test_references_without_a_refit_are_bad_usage(tmp_path, capsys):
    arguments = ['evaluate', str(METAL), '--model', str(MODEL), '--references', 'none']
    assert main([*arguments, '--out', str(tmp_path)]) == 2
    assert '--refit' in capsys.readouterr().err
