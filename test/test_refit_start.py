"""A refit is made beside the callbacks: the node answers meanwhile, and says how far it is."""

import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from conftest import PATIENCE_S
from rclpy.parameter import Parameter
from refit_rig import Rig, setup_text
from refit_world import anser_world
from std_srvs.srv import Trigger

from anser_ros.errors import FitError
from anser_ros.nodes import field_model_refit
from anser_ros.nodes.field_model_refit import RefitStart
from anser_ros.nodes.runtime.diagnostics import Level
from anser_ros.pose_states import REFERENCES_LOST, code_of
from anser_ros.refit import tables
from anser_ros.sessions.starting_model import save_model
from anser_ros.wire.setup import parse_setup

pytestmark = pytest.mark.usefixtures('shared_tables')


class Held:
    """Lets the making of a refit begin, and go on when it is told to."""

    def __init__(self, monkeypatch):
        self.let, self.share = threading.Event(), 0.4
        build, refit = tables.build_tables, field_model_refit.LiveRefit

        def held(*given, report, **named):
            report(self.share)
            assert self.let.wait(PATIENCE_S)
            return build(*given, report=report, **named)

        def held_refit(*given, **named):
            assert self.let.wait(PATIENCE_S)
            return refit(*given, **named)

        monkeypatch.setattr(tables, 'build_tables', held)
        monkeypatch.setattr(field_model_refit, 'LiveRefit', held_refit)


@pytest.fixture
def held(monkeypatch):
    return Held(monkeypatch)


@pytest.fixture
def rig(ros, tmp_path, held):
    rig = Rig(ros, tmp_path, refit_rate_hz=1000.0)
    rig.codes, write = [], rig.node._output.new_error
    rig.node._output.new_error = lambda *given: rig.codes.append(given[-1]) or write(*given)
    yield rig
    held.let.set()
    rig.close()


def test_frames_and_services_are_answered_while_the_first_refit_is_made(rig, held):
    rig.stamp_ns = time.time_ns()
    rig.give_baseline()
    rig.until(lambda: 'refit being prepared, 40%' in rig.node.status().message)
    assert rig.node.status().level == Level.WARN
    for _ in range(3):
        rig.say(0.0)
        assert rig.codes[-1] == code_of(REFERENCES_LOST), 'metal may come meanwhile'
    assert rig.node._on_reset(Trigger.Request(), Trigger.Response()).success
    assert rig.node.counters['refits'] == 0 and rig.codes[-1] == code_of(REFERENCES_LOST)
    held.let.set()
    rig.until(lambda: rig.node.counters['refit_starts'] == 1)
    assert 'prepared' not in rig.node.status().message
    rig.say(0.0)
    assert rig.node.counters['refits'] == 1 and rig.codes[-1] == 0


def test_the_former_refit_goes_on_until_that_to_a_new_baseline_is_there(rig, held):
    held.let.set()
    rig.start()
    former = rig.node._refit.current
    held.let.clear()
    rig.give_baseline()
    before = rig.node.counters['refits']
    rig.say(0.0)
    assert rig.node.counters['refits'] == before + 1 and rig.node._refit.current is former
    assert rig.node.status().message == 'frozen; the next refit being prepared, 100%'
    assert rig.codes[-1] == 0
    held.let.set()
    rig.until(lambda: rig.node.counters['refit_starts'] == 2)
    assert rig.node._refit.current is not former


def give_another_model(rig, held, tmp_path):
    held.let.set()
    rig.start()
    rig.say(0.0)
    held.let.clear()
    model = rig.world.model
    save_model(tmp_path / 'better.yaml', replace(model, moments=1.01 * model.moments))
    better = Parameter('model_file', value=str(tmp_path / 'better.yaml'))
    assert rig.node.set_parameters([better])[0].successful


def test_a_frame_of_a_recording_waits_for_the_refit(rig, held, tmp_path):
    give_another_model(rig, held, tmp_path)
    let_go = threading.Timer(0.1, held.let.set)
    let_go.start()
    rig.say(0.0)
    let_go.join()
    assert rig.node.counters['refit_starts'] == 2 and rig.codes[-1] == 0


def test_another_model_gives_no_poses_before_its_refit_is_made(rig, held, tmp_path):
    rig.stamp_ns = time.time_ns()
    give_another_model(rig, held, tmp_path)
    for _ in range(3):
        rig.say(0.0)
        assert rig.codes[-1] == code_of(REFERENCES_LOST)
    rig.until(lambda: '40%' in rig.node.status().message)
    assert rig.node.status().level == Level.WARN
    held.let.set()
    rig.until(lambda: rig.node.counters['refit_starts'] == 2)
    assert rig.codes[-1] == code_of(REFERENCES_LOST), 'no frame has been answered yet'
    rig.say(0.0)
    assert rig.codes[-1] == 0


def test_a_refit_that_cannot_be_made_is_said_and_awaited_no_longer(rig, monkeypatch):
    def none(*_given, **_named):
        raise FitError('the emitters make no field')

    monkeypatch.setattr(tables, 'build_tables', none)
    rig.give_baseline()
    rig.until(lambda: rig.node.counters['baselines_refused'] == 1)
    state = rig.node.status()
    assert state.level == Level.WARN and 'no baseline: the emitters make no field' in state.message
    assert not rig.node._refit.is_making and rig.node.counters['callback_faults'] == 0


def test_tables_that_nobody_wants_any_more_are_given_up(ros, monkeypatch):
    world, begun, goes_on = anser_world(), threading.Event(), threading.Event()

    def endless(*_given, report):
        begun.set()
        while True:
            report(0.5)
            goes_on.wait(PATIENCE_S)

    monkeypatch.setattr(tables, 'build_tables', endless)
    setup = parse_setup(setup_text(world))
    start = RefitStart(setup, world.model, world.references)
    start.begin(np.zeros((16, 8), complex))
    assert start.taken() is None and start.is_making
    assert begun.wait(PATIENCE_S)
    time.sleep(0.01)
    assert not start.end(0.01), 'it is between two words'
    goes_on.set()
    assert start.end(PATIENCE_S)
