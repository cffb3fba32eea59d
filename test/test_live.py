"""Several nodes in one process: what they hand over, and that they are the nodes they were."""

import threading

import numpy as np
import pytest
from conftest import spin_until

from anser_ros.nodes.handover import Aside, HandedFlux, Handover, Taking
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
        assert goes_on.wait(10)
        done.append(what)
        if what == 'b4':
            finished.set()

    finished = threading.Event()
    aside = Aside(lambda: skipped.append(1))
    aside.put('/a', slow, 'a1')
    assert began.wait(10)
    for k in range(2, 5):
        aside.put('/a', slow, f'a{k}')
        aside.put('/b', slow, f'b{k}')
    goes_on.set()
    assert finished.wait(10)
    aside.end(10)
    assert done == ['a1', 'a4', 'b4'] and len(skipped) == 4


def test_what_is_put_off_is_done_one_thing_a_pause_while_there_are_pauses():
    handover, done, can = Handover(), [], [False, True]

    def first():
        done.append('first')
        return can.pop(0)

    def second():
        done.append('second')
        return True

    assert not handover.put_off(second)
    handover.pause()
    assert all(handover.put_off(work) for work in (first, second, first))
    assert not done
    for _ in range(4):
        handover.pause()
    assert done == ['first', 'second', 'first']


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
    process = pytest.importorskip('anser_ros.nodes.process')
    tracker, server = type('T', (), {'NAME': 'tracker'}), type('S', (), {'NAME': 'field_model'})
    arguments = ['live', '--ros-args', '-p', 'tracker:gate:=4', '-p', 'model_file:=a:b', '-r',
                 'tracker:__node:=other', '--param', 'field_model:refit:=false']  # fmt: skip
    common, meant = process._meant_for((server, tracker), arguments)
    assert common == ['live', '--ros-args', '-p', 'model_file:=a:b', '-r', 'tracker:__node:=other']
    assert meant == {
        'tracker': ['--ros-args', '-p', 'gate:=4'],
        'field_model': ['--ros-args', '--param', 'refit:=false'],
    }
    assert process._meant_for((tracker,), arguments)[0] == arguments


def test_frames_are_handed_over_as_objects_while_two_senders_are_still_told(ros):
    from sensor_msgs.msg import PointCloud2

    from anser_ros.nodes import qos
    from anser_ros.nodes.node import AnserNode
    from anser_ros.nodes.one_source import OneSource

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
    assert isinstance(source.subscription, Taking)
    frame = HandedFlux(1, 'fg', FluxPoints(*5 * [np.zeros(0)]))
    giver.hand_over(publisher, frame)
    assert got == [frame] and got[0] is frame
    stranger = ros.create_node('stranger')
    stranger.create_publisher(PointCloud2, '/anser/tool/flux', qos.STREAM)
    assert spin_until(stranger, lambda: '2 publishers' in source.said)
    giver.hand_over(publisher, frame)
    assert len(got) == 1
    for node in (giver, taker, stranger):
        node.destroy_node()


@pytest.mark.realtime
def test_the_chain_in_one_process_is_the_same_three_nodes(ros, start, tmp_path):
    from geometry_msgs.msg import PoseStamped
    from rcl_interfaces.srv import GetParameters
    from std_srvs.srv import SetBool

    link, node, poses, levels = tmp_path / 'cu', ros.create_node('peer'), [], {}
    from diagnostic_msgs.msg import DiagnosticArray

    def note(message):
        levels.update({status.name: status.message for status in message.status})

    node.create_subscription(PoseStamped, '/x/tool_a/pose', poses.append, 50)
    node.create_subscription(DiagnosticArray, '/diagnostics', note, 50)
    start('cu_simulator', '--ros-args', '-p', f'link:={link}', '-p', 'sample_rate_hz:=20e3')
    words = ['-r', '__ns:=/x', '-r', 'tracker:__node:=guide', '-p', f'device:={link}']
    words += ['-p', 'tracker:gate:=4.0', '-p', 'allow_uncalibrated:=true']
    live = start('live', '--ros-args', *words)
    assert spin_until(node, lambda: len(poses) > 50, 60.0), live.output
    names = {f'{space}/{name}' for name, space in node.get_node_names_and_namespaces()}
    assert {'/x/acquisition', '/x/field_model', '/x/guide'} <= names
    assert {'x/acquisition', 'x/field_model', 'x/guide'} <= set(levels)
    client = node.create_client(GetParameters, '/x/guide/get_parameters')
    assert client.wait_for_service(10)
    future = client.call_async(GetParameters.Request(names=['gate']))
    assert spin_until(node, future.done) and future.result().values[0].double_value == 4.0
    freeze = node.create_client(SetBool, '/x/field_model/freeze')
    assert freeze.wait_for_service(10)
    future = freeze.call_async(SetBool.Request(data=True))
    assert spin_until(node, future.done) and future.result().success
    assert live.interrupt() == 0, live.output


@pytest.mark.processes
@pytest.mark.parametrize(
    ('words', 'said'),
    [
        (['-r', '__node:=other'], 'one node is renamed by -r tracker:__node:=NAME'),
        (['-p', 'nobody:=1'], 'no parameter nobody'),
    ],
)
def test_what_several_nodes_cannot_be_given_is_one_line(start, words, said):
    process = start('live', '--ros-args', *words)
    assert process.popen.wait(30) == 2
    assert said in process.output and 'Traceback' not in process.output
