"""Several nodes in one process: what they hand over, and that they are the nodes they were."""

import signal
import socket
import threading
from dataclasses import make_dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import PATIENCE_S, ask, diagnostics, skip_if_too_slow, spin_until
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.srv import GetParameters
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String
from std_srvs.srv import SetBool

from anser_ros.errors import ParameterError
from anser_ros.nodes.live import CHAIN
from anser_ros.nodes.runtime import process, qos
from anser_ros.nodes.runtime.handover import DirectSubscription, HandedFlux, Handover, NewestWorker
from anser_ros.nodes.runtime.node import AnserNode
from anser_ros.nodes.runtime.parameters import names_for
from anser_ros.nodes.streams.one_source import OneSource
from anser_ros.wire.points import FluxPoints, as_sent, decode_flux, encode_flux


def test_what_is_offered_goes_to_all_who_take_it_and_what_lasts_to_later_ones():
    handover, first, second, late = Handover(), [], [], []
    handover.offer('/a')
    handover.offer('/b', lasts=True)
    assert handover.offers('/a') and not handover.offers('/c')
    taking = handover.take('/a', first.append)
    handover.take('/a', second.append)
    what = object()
    handover.give('/a', what)
    handover.drop(taking)
    handover.give('/a', 2)
    assert first == [what] and second == [what, 2]
    handover.give('/b', what)
    handover.take('/b', late.append)
    assert late == [what]


def test_what_takes_long_is_done_aside_with_the_newest():
    """Who gives goes on at once; what came meanwhile gives way to the last, topic by topic."""
    began, goes_on, done, skipped = threading.Event(), threading.Event(), [], []

    def slow(what):
        began.set()
        assert goes_on.wait(PATIENCE_S)
        done.append(what)
        if what == 'b4':
            finished.set()

    finished = threading.Event()
    aside = NewestWorker(lambda: skipped.append(1))
    aside.put('/a', slow, 'a1')
    assert began.wait(PATIENCE_S)
    for k in range(2, 5):
        aside.put('/a', slow, f'a{k}')
        aside.put('/b', slow, f'b{k}')
    goes_on.set()
    assert finished.wait(PATIENCE_S)
    aside.end(10)
    assert done == ['a1', 'a4', 'b4'] and len(skipped) == 4


def test_what_is_worked_on_aside_has_nothing_to_do_with_a_node_that_is_gone(ros):
    """The thread ends with its node, and what it still does then is no fault of a callback."""
    began, goes_on = threading.Event(), threading.Event()

    class Slow(AnserNode):
        NAME = 'slow'
        WORKS_ASIDE = True

        def take(self, _what):
            began.set()
            goes_on.wait(PATIENCE_S)
            self.get_clock().now()
            raise RuntimeError('the node is gone')

    handover = Handover()
    handover.offer('/anser/news')
    node = Slow(handover=handover)
    node.create_subscription(String, 'news', node.take, qos.STREAM)
    handover.give('/anser/news', 'first')
    assert began.wait(PATIENCE_S)
    assert not node.stop_working(), 'it is still at it'
    thread = node._aside._thread
    node.destroy_node()
    goes_on.set()
    thread.join(10)
    assert not thread.is_alive() and node.counters['callback_faults'] == 0


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


def test_frames_are_handed_over_as_objects_while_two_senders_are_still_told(ros):
    class Giver(AnserNode):
        NAME = 'giver'

    class Taker(AnserNode):
        NAME = 'taker'

    handover, got = Handover(), []
    giver = Giver(handover=handover, beside=(Giver, Taker))
    publisher = giver.create_publisher(PointCloud2, 'tool/flux', qos.STREAM)
    giver.offer(publisher)
    taker = Taker(handover=handover, beside=(Giver, Taker))
    source = OneSource(taker, PointCloud2, 'tool/flux', got.append, qos.STREAM)
    assert isinstance(source.subscription, DirectSubscription)
    frame = HandedFlux(1, 'fg', FluxPoints(*5 * [np.zeros(0)]))
    giver.hand_over(publisher, frame)
    assert got == [frame] and got[0] is frame
    stranger = ros.create_node('stranger')
    stranger.create_publisher(PointCloud2, '/anser/tool/flux', qos.STREAM)
    assert spin_until(stranger, lambda: '2 publishers' in source.complaint)
    giver.hand_over(publisher, frame)
    assert len(got) == 1
    for node in (giver, taker, stranger):
        node.destroy_node()


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
