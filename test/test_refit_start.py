"""A refit is made beside the callbacks, and a node that starts again uses what was kept."""

import os
import threading
import time
from dataclasses import fields, replace

import numpy as np
import pytest
from conftest import PATIENCE_S
from rclpy.parameter import Parameter
from refit_rig import HEAD, Rig, setup_text
from refit_world import anser_world
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String
from std_srvs.srv import Trigger

from anser_ros.cli import warm_up
from anser_ros.errors import FitError
from anser_ros.nodes import field_model_refit
from anser_ros.nodes.field_model_io import BASELINE_S, KeptBaseline
from anser_ros.nodes.field_model_refit import RefitStart
from anser_ros.nodes.runtime import qos
from anser_ros.nodes.runtime.diagnostics import Level
from anser_ros.pose_states import REFERENCES_LOST, code_of
from anser_ros.refit import tables
from anser_ros.sessions.kept_tables import MOST_TABLES, KeptTables
from anser_ros.sessions.nominal_board import NominalBoard, stated_volume
from anser_ros.sessions.session import sensor_table
from anser_ros.sessions.starting_model import load_model, save_model
from anser_ros.wire.setup import parse_setup
from anser_ros.wire.text_files import config_path, read_config

pytestmark = pytest.mark.usefixtures('shared_tables')


class Held:
    """Lets the making of a refit begin, and go on when it is told to."""

    def __init__(self, monkeypatch):
        self.let, self.share = threading.Event(), 0.4
        build, refit = tables.build_tables, field_model_refit.LiveRefit

        def held(*given, report, **named):
            report(self.share)
            self.let.wait()
            return build(*given, report=report, **named)

        def held_refit(*given, **named):
            self.let.wait()
            return refit(*given, **named)

        monkeypatch.setattr(tables, 'build_tables', held)
        monkeypatch.setattr(field_model_refit, 'LiveRefit', held_refit)


@pytest.fixture
def held(monkeypatch):
    return Held(monkeypatch)


@pytest.fixture
def rig(ros, tmp_path, held):
    rig = Rig(ros, tmp_path, refit_rate_hz=1000.0)
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


def same(one, other):
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and np.array_equal(one, other)
    return one == other


@pytest.mark.long
def test_tables_are_read_as_they_were_written(tmp_path):
    world = anser_world()
    setup = parse_setup(setup_text(world))
    kept = KeptTables(tmp_path, setup, world.model, world.references)
    assert kept.read() is None
    made = tables.build_tables(
        world.model, world.references, setup.refit, NominalBoard.of(setup).field,
        stated_volume(setup),
    )  # fmt: skip
    kept.write(made)
    read = KeptTables(tmp_path, setup, world.model, world.references).read()
    assert len(read.priors) == len(made.priors) and len(read.factors) == len(made.factors)
    pairs = [
        *zip(made.layers, read.layers, strict=True),
        *zip(made.priors, read.priors, strict=True),
    ]
    for one, other in pairs:
        names = [f.name for f in fields(one) if f.name not in ('cloud', 'layer', '_projected')]
        assert all(same(getattr(one, name), getattr(other, name)) for name in names)
    assert all(same(*pair) for pair in zip(made.factors, read.factors, strict=True))
    stronger = replace(world.model, moments=1.001 * world.model.moments)
    assert KeptTables(tmp_path, setup, stronger, world.references).read() is None

    (path,) = tmp_path.iterdir()
    whole = path.read_bytes()
    middle = bytearray(whole)
    middle[len(whole) // 2] ^= 1
    for damaged in (whole[:-8], bytes(middle), whole[:100], b''):
        path.write_bytes(damaged)
        assert kept.read() is None
    path.unlink()
    for age in range(MOST_TABLES + 2):
        (tmp_path / f'refit_tables_{age}').write_bytes(b'')
        os.utime(tmp_path / f'refit_tables_{age}', (100.0 - age, 100.0 - age))
    kept.write(made)
    left = sorted(p.name for p in tmp_path.iterdir())
    assert len(left) == MOST_TABLES and {'refit_tables_0', 'refit_tables_1', path.name} == set(
        left
    )


def test_a_baseline_is_taken_up_soon_after_and_from_the_same_sender_only(tmp_path):
    world = anser_world()
    setup, flux = parse_setup(setup_text(world)), world.baseline

    def baseline(node='/anser/field_model', sender='01ab', model=world.model):
        kept = KeptBaseline(tmp_path, node, lambda: sender)
        kept.expect(setup, model)
        return kept

    first = baseline()
    assert first.read() is None
    first.confirm(flux)
    assert same(baseline().read(), flux)
    stronger = replace(world.model, moments=1.001 * world.model.moments)
    others = baseline(sender='02ab'), baseline(node='/other/field_model'), baseline(model=stronger)
    assert all(other.read() is None for other in (*others, baseline(sender='')))
    (path,) = tmp_path.iterdir()
    for age in (BASELINE_S + 1.0, -10.0):
        os.utime(path, (time.time() - age,) * 2)
        assert baseline().read() is None
    first.confirm(flux)
    assert same(baseline().read(), flux), 'confirmed again'
    first.drop()
    assert baseline().read() is None and not list(tmp_path.iterdir())


@pytest.fixture
def started(ros, tmp_path, monkeypatch):
    """Starts nodes one after the other, with one sender of references that goes on."""
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path))
    sender = ros.create_node('sender', namespace='anser')
    sender.create_publisher(PointCloud2, 'reference/flux', qos.STREAM)
    rigs = []

    def start():
        if rigs:
            rigs.pop().close()
        rigs.append(rig := Rig(ros, tmp_path, refit_rate_hz=1000.0, keep_state=True))
        rig.stamp_ns = time.time_ns()
        rig.until(lambda: rig.node._refit._kept._sender() != '')
        return rig

    yield start
    rigs[0].close()
    sender.destroy_node()


def test_a_node_that_is_started_near_metal_follows_the_references_again(started):
    rig = started()
    rig.start()
    for _ in range(3):
        rig.say(0.0)
    rig.node._refit.confirm()
    metal = rig.world.metal(HEAD)

    rig = started()
    rig.node._on_setup(String(data=setup_text(rig.world)))
    assert rig.node.counters['baselines_resumed'] == 1
    rig.say(metal)
    assert set(rig.codes[-2:]) == {code_of(REFERENCES_LOST)}, 'no pose before the refit is there'
    rig.until(lambda: rig.node.counters['refit_starts'] == 1)
    for _ in range(5):
        rig.say(metal)
    assert rig.node._refit.result.state == 'refit' and rig.codes[-1] == 0


def test_a_baseline_that_references_contradict_is_not_taken_up(started):
    rig = started()
    rig.start()
    for _ in range(12):
        rig.say(0.0)
    rig.node._refit.confirm()
    jump = np.zeros_like(rig.world.baseline)
    jump[3] = 0.2 * rig.world.baseline[3]
    for _ in range(3):
        rig.say(jump)
    assert 'disagrees' in {one.state for one in rig.node._refit.result.references}
    rig.node._refit.confirm()

    rig = started()
    rig.node._on_setup(String(data=setup_text(rig.world)))
    assert rig.node.counters['baselines_resumed'] == 0
    assert not getattr(rig.node._refit.start, 'words', '')


@pytest.mark.long
def test_the_warm_up_leaves_the_tables_with_which_the_demo_starts(tmp_path, monkeypatch):
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path))
    setup = parse_setup(read_config('demo_setup.yaml'))
    model = load_model(config_path('demo_model.yaml'))
    references = sensor_table(setup.reference_sensors)
    of_the_demo = KeptTables(tmp_path / 'anser_ros', setup, model, references)
    assert of_the_demo.read() is None
    warm_up._refit()
    assert of_the_demo.read() is not None
