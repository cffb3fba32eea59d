"""Several nodes in one process: what they hand over, and that they are the nodes they were."""

import signal
import socket
import threading
import time
from collections import Counter
from dataclasses import make_dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import ask, diagnostics, skip_if_too_slow, spin_until
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.srv import GetParameters
from rclpy.parameter import Parameter
from refit_world import anser_world
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String
from std_srvs.srv import SetBool
from tracking_world import setup_of, triaxial_tool

from anser_ros.chain.frame import ChainFrame, FrameReadings
from anser_ros.errors import ParameterError
from anser_ros.nodes.acquisition import Acquisition
from anser_ros.nodes.field_model import FieldModelNode
from anser_ros.nodes.live import CHAIN, join
from anser_ros.nodes.runtime import process, qos
from anser_ros.nodes.runtime.parameters import is_known, names_for
from anser_ros.nodes.streams.one_source import Backlog
from anser_ros.nodes.tracker import TrackerNode
from anser_ros.sessions.starting_model import save_model
from anser_ros.wire.points import FluxPoints, as_sent, decode_flux, encode_flux
from anser_ros.wire.setup import dump_setup


def test_handed_fluxes_are_those_that_are_published():
    rng = np.random.default_rng(3)
    flux = rng.standard_normal((4, 8)) + 1j * rng.standard_normal((4, 8))
    points = FluxPoints(
        np.arange(4), np.array([0, 1, 2, 4]), 1e-7 * flux, np.full((4, 3), np.nan), np.eye(4, 3)
    )
    fields, step, data = encode_flux(points)
    read, handed = decode_flux(fields, step, 4, data), as_sent(points)
    assert (handed.flux == read.flux).all() and not (handed.flux == points.flux).all()
    assert (handed.channel == read.channel).all() and (handed.flags == read.flags).all()


def test_parameters_of_one_node_are_given_to_it_alone():
    tracker, server = (
        type('T', (), {'NAME': name, 'PARAMETERS': make_dataclass('P', [(known, float, 0.0)])})
        for name, known in (('tracker', 'gate'), ('field_model', 'refit'))
    )
    arguments = ['live', '--ros-args', '-p', 'tracker:gate:=4', '-p', 'model_file:=a:b', '-r',
                 'tracker:__node:=other', '--param', 'field_model:refit:=false']  # fmt: skip
    common, meant = process._meant_for((server, tracker), arguments)
    assert common == ['live', '--ros-args', '-p', 'model_file:=a:b', '-r', 'tracker:__node:=other']
    assert meant == {
        'tracker': ['--ros-args', '-p', 'gate:=4'],
        'field_model': ['--ros-args', '--param', 'refit:=false'],
    }
    assert process._meant_for((tracker,), arguments)[0] == arguments
    for wrong, said in (
        ('tracker:refit:=true', 'tracker has no parameter refit; field_model has it'),
        ('tracker:nothing:=1', 'tracker has no parameter nothing$'),
    ):
        with pytest.raises(ParameterError, match=said):
            process._meant_for((server, tracker), ['live', '--ros-args', '-p', wrong])


def test_a_file_tells_which_values_it_has_for_one_node(tmp_path):
    file = tmp_path / 'p.yaml'
    file.write_text(
        '/**:\n  ros__parameters: {common: 1}\n'
        '/anser/tracker:\n  ros__parameters: {gate: 4.0, refit: true}\n'
        '/anser:\n  field_model:\n    ros__parameters: {refit: true}\n'
    )
    arguments = ['live', '--ros-args', '--params-file', str(file)]
    assert list(names_for(arguments, 'tracker')) == ['gate', 'refit']
    assert list(names_for(arguments, 'field_model')) == ['refit']
    assert list(names_for(arguments, 'acquisition')) == []


TOOL = triaxial_tool(first=50)


@pytest.fixture
def joined(ros, shared_tables, tmp_path):
    """Field model and tracker of one process, and the chain through both."""
    world = anser_world()
    save_model(tmp_path / 'model.yaml', world.model)
    values = {'model_file': str(tmp_path / 'model.yaml'), 'refit': False, 'keep_state': False}
    text = dump_setup(setup_of(TOOL, setup_of(world.references).sensors))
    nodes = []
    for kind in (FieldModelNode, TrackerNode):
        own = {name: value for name, value in values.items() if is_known(kind.PARAMETERS, name)}
        given = [Parameter(name, value=value) for name, value in own.items()]
        nodes.append(kind(beside=CHAIN, parameter_overrides=given))
        nodes[-1]._on_setup(String(data=text))
    yield SimpleNamespace(model=nodes[0], tracker=nodes[1], world=world, chain=None)
    for node in nodes:
        node.destroy_node()


def frame_of(joined, stamp_ns):
    """A frame of the tool at rest and of the references, new noise in each."""
    rng, place = np.random.default_rng(stamp_ns), TOOL.position + [0.0, 0.0, 0.2]
    flux = joined.world.model.flux(place, TOOL.axis, TOOL.length)
    tools, references = (
        FrameReadings(table.channel, exact + joined.world.noise(rng)[: len(exact)],
                      np.zeros(len(exact), dtype=int))
        for table, exact in ((TOOL, flux), (joined.world.references, joined.world.baseline))
    )  # fmt: skip
    return ChainFrame(stamp_ns, tools, references)


def test_frames_pass_the_nodes_of_one_process_as_objects(joined, ros):
    """Each is tracked by the model of the one before; a second sender is still told."""
    join(acquisition := SimpleNamespace(), joined.model, joined.tracker)
    first_ns = time.time_ns()
    states = [
        {one.state for one in acquisition.chain.step(frame_of(joined, first_ns + n * 20_000_000))}
        for n in range(3)
    ]
    assert joined.model.counters['frames'] == 3 == joined.tracker.counters['frames']
    assert joined.tracker.counters['callback_faults'] == 0
    assert states[-1] == {'ok'}
    for node in (joined.model, joined.tracker):
        assert node._fluxes.subscription is None, 'it would process everything twice'
    assert joined.tracker._given is joined.model._output.newest
    stranger = ros.create_node('stranger')
    for _ in range(2):
        stranger.create_publisher(PointCloud2, '/anser/tool/flux', qos.STREAM)
    source = joined.tracker._fluxes
    assert spin_until(stranger, lambda: '2 publishers' in source.complaint)
    found = acquisition.chain.step(frame_of(joined, first_ns + 60_000_000))
    assert {one.state for one in found} == {'two_sources'}
    stranger.destroy_node()


def test_a_late_frame_passes_without_its_references_at_most_twice():
    """So that a slow machine loses no window."""
    passed, counted = [], Counter()
    unheard = SimpleNamespace(get_subscription_count=lambda: 0)
    node = SimpleNamespace(
        _accuracy=SimpleNamespace(must_republish=lambda *_: False),
        _wall_clock=SimpleNamespace(offset_ns=lambda: 5), _backlog=Backlog(0.02),
        _reference_publisher=unheard, _tool_publisher=unheard,
        _interval=SimpleNamespace(add=lambda *_: None), chain=SimpleNamespace(step=passed.append),
        count=lambda name, by: counted.update({name: by}),
    )  # fmt: skip
    points = FluxPoints(np.arange(1), np.zeros(1, int), np.ones((1, 8), complex), *2 * [None])
    frame = SimpleNamespace(tool=points, reference=points, host_ns=1)
    stream = SimpleNamespace(clock=SimpleNamespace(sigma_s=0.0))
    refitted = [
        Acquisition._publish_frame(node, stream, frame, time.monotonic_ns() - round(age_s * 1e9))
        for age_s in (0.0, 0.1, 0.1, 0.1, 0.0)
    ]
    assert refitted == [True, False, False, True, True]
    assert [one.reference is None for one in passed] == [False, True, True, False, False]
    assert all(one.tools is not None and one.stamp_ns == 6 for one in passed)
    assert counted == {'refits_left_out': 2}


def test_the_chain_in_one_process_is_the_same_three_nodes(ros, start, tmp_path):
    link, node, poses = tmp_path / 'cu', ros.create_node('peer'), []
    lines = diagnostics(node)
    node.create_subscription(PoseStamped, '/x/tool_a/pose', poses.append, 50)
    start('cu_simulator', '--ros-args', '-p', f'link:={link}', '-p', 'sample_rate_hz:=20e3')
    words = ['-r', '__ns:=/x', '-r', 'tracker:__node:=guide', '-p', f'device:={link}']
    words += ['-p', 'tracker:gate:=4.0', '-p', 'allow_uncalibrated:=true']
    live = start('live', '--ros-args', *words)
    wanted = {'/x/acquisition', '/x/field_model', '/x/guide'}

    def names():
        return {f'{space}/{name}' for name, space in node.get_node_names_and_namespaces()}

    assert spin_until(node, lambda: wanted <= names()), live.output
    # Each speaks once a second, and in a pause between two frames.
    assert spin_until(node, lambda: {'x/acquisition', 'x/field_model', 'x/guide'} <= set(lines))
    reply = ask(node, GetParameters, '/x/guide/get_parameters', names=['gate'])
    assert reply.values[0].double_value == 4.0
    assert ask(node, SetBool, '/x/field_model/freeze', data=True).success
    tracked = spin_until(node, lambda: len(poses) > 50)
    assert live.interrupt() == 0, live.output
    if not tracked:
        skip_if_too_slow(live.output)
    assert tracked, live.output


def test_what_several_nodes_cannot_be_given_is_one_line(start, capsys):
    assert process.main(CHAIN, ['live', '--ros-args', '-r', '__node:=other'], name='live') == 2
    said = 'live: one node is renamed by -r tracker:__node:=NAME\n'
    assert capsys.readouterr().err == said
    live = start('live', '--ros-args', '-p', 'nobody:=1')
    assert live.wait() == 2
    assert 'no parameter nobody' in live.output and 'Traceback' not in live.output


@pytest.mark.parametrize('is_noticed', [True, False])
def test_who_is_given_up_says_good_bye_to_devices_first(monkeypatch, is_noticed):
    """A process too busy to notice Ctrl-C ends all the same; the unit must not stream on."""
    done = []

    def fail():
        done.append('broken')
        raise OSError('unplugged')

    monkeypatch.setattr(process, 'NOTICE_S', 10.0 if is_noticed else 0.02)
    monkeypatch.setattr(process.os, '_exit', lambda code: done.append(code))
    signals = process._Signals.__new__(process._Signals)
    signals._noticed = threading.Event()
    calls = fail, lambda: done.append('stopped')
    signals.nodes = [SimpleNamespace(on_abandon=call) for call in calls]
    signals._reader, writer = socket.socketpair()
    writer.send(bytes([signal.SIGINT]))
    if is_noticed:
        signals._noticed.set()
    signals._watch()
    assert done == ([] if is_noticed else ['broken', 'stopped', 0])
    writer.close()
    signals._reader.close()
