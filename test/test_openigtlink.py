"""Poses and states over TCP to a real OpenIGTLink client."""

import contextlib
import re
import socket
import time

import numpy as np
import pyigtl
import pytest
from conftest import spin_until

from anser_ros.errors import PortError
from anser_ros.nodes.igtl_server import (
    MOST_CLIENTS,
    IgtlServer,
    device_name,
    transform_bytes,
)

pytestmark = pytest.mark.light

SETUP = """
schema: anser_setup/1
frame_id: fg
flux_rate_hz: 50
flux_unit: T
emitter:
  kind: square_spiral_pcb
  turns: 25
  side_m: 0.07
  pitch_m: 0.00075
  layers: 2
  thickness_m: 0.0016
  current_a: 0.1
  coils:
    - {name: coil0, centre_m: [0.0, 0.0, 0.0], rotation_deg: 0.0, frequency_hz: 20500.0}
sensors:
  - {channel: 1, name: tool_a/0/x, body: tool_a, position_m: [0.0, 0.0, 0.0],
     axis: [1.0, 0.0, 0.0], length_m: 0.008}
"""


@pytest.fixture
def tracker(ros):
    """A node that publishes what a tracker does."""
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
    from geometry_msgs.msg import PoseStamped
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from std_msgs.msg import String

    node = ros.create_node('tracker', namespace='anser')
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    setup = node.create_publisher(String, 'setup', latched)
    setup.publish(String(data=SETUP))
    pose = node.create_publisher(PoseStamped, 'tool_a_0/x/pose', 10)
    diagnostics = node.create_publisher(DiagnosticArray, '/diagnostics', 10)

    def send(x=0.1, w=1.0):
        message = PoseStamped()
        message.header.stamp.sec, message.header.stamp.nanosec = 1_750_000_000, 250_000_000
        message.pose.position.x, message.pose.position.z = x, 0.2
        # A quarter turn about z when w is the root of one half.
        message.pose.orientation.w = w
        message.pose.orientation.z = float(np.sqrt(1.0 - w * w))
        pose.publish(message)

    def say(state):
        status = DiagnosticStatus(name='anser/tracker: tool_a/0/x', message=state)
        diagnostics.publish(DiagnosticArray(status=[status]))

    node.send, node.say = send, say
    node.listeners = pose.get_subscription_count
    yield node
    node.destroy_node()


@pytest.fixture
def connect():
    """Connect real clients."""
    clients = []

    def make(port):
        clients.append(pyigtl.OpenIGTLinkClient('127.0.0.1', port))
        return clients[-1]

    yield make
    for client in clients:
        client.stop()


def read_port(process):
    process.wait_for('listening on 127.0.0.1:')
    return int(re.search(r'listening on 127\.0\.0\.1:(\d+)', process.output)[1])


def test_poses_and_states_reach_clients(start, tracker, connect):
    process = start('openigtlink', '--ros-args', '-p', 'port:=0')
    port = read_port(process)
    first, second = connect(port), connect(port)
    assert spin_until(tracker, lambda: tracker.listeners() == 1, 20)
    waiting = first.wait_for_message('tool_a/0/x/state', timeout=10)
    assert waiting.string == 'no pose yet'
    second.wait_for_message('tool_a/0/x/state', timeout=10)
    tracker.send(w=float(np.sqrt(0.5)))
    for client in (first, second):
        pose = client.wait_for_message('tool_a/0/x', timeout=10)
        assert pose.message_type == 'TRANSFORM'
        assert pose.timestamp == pytest.approx(1_750_000_000.25, abs=1e-6)
        expected = [[0, -1, 0, 100], [1, 0, 0, 0], [0, 0, 1, 200], [0, 0, 0, 1]]
        np.testing.assert_allclose(pose.matrix, expected, atol=1e-4)
    began = time.monotonic()
    states = []
    while 'residual' not in states and time.monotonic() - began < 10:
        tracker.say('residual')
        message = first.wait_for_message('tool_a/0/x/state', timeout=0.2)
        states += [message.string] if message else []
    assert states[-1] == 'residual' and set(states) <= {'ok', 'stale', 'residual'}
    tracker.send()
    assert first.wait_for_message('tool_a/0/x', timeout=10).matrix[0, 3] == pytest.approx(100)
    assert process.interrupt() == 0


def test_a_pose_that_is_none_is_refused(ros, tracker):
    from rclpy.parameter import Parameter

    from anser_ros.nodes.openigtlink import OpenIGTLink

    node = OpenIGTLink(parameter_overrides=[Parameter('port', value=0)])
    try:
        assert spin_until(node, lambda: tracker.listeners() == 1)
        tracker.send(x=float('nan'))
        assert spin_until(node, lambda: node.counters['poses_refused'] == 1)
        assert node.counters['transforms'] == 0
    finally:
        node.close()
        node.destroy_node()


class TestServer:
    def test_a_taken_port_is_said_in_one_line(self, start):
        with socket.create_server(('127.0.0.1', 0)) as taken:
            port = taken.getsockname()[1]
            process = start('openigtlink', '--ros-args', '-p', f'port:={port}')
            assert process.popen.wait(20) == 2
            assert f'can not listen on 127.0.0.1:{port}: Address already' in process.output
            assert 'Traceback' not in process.output
            with pytest.raises(PortError, match='Address already in use'):
                IgtlServer('127.0.0.1', port)

    def test_clients_come_and_go(self):
        server = IgtlServer('127.0.0.1', 0)
        try:
            client = socket.create_connection(('127.0.0.1', server.port))
            wait_until(lambda: server.n_clients == 1)
            client.sendall(b'whatever a client may say')
            server.send(b'hello')
            assert client.recv(5) == b'hello'
            client.close()
            wait_until(lambda: server.n_clients == 0)
            server.send(b'to nobody')
        finally:
            server.close()

    def test_a_client_that_reads_nothing_holds_nobody_up(self):
        server = IgtlServer('127.0.0.1', 0)
        try:
            with socket.create_connection(('127.0.0.1', server.port)):
                wait_until(lambda: server.n_clients == 1)
                began = time.monotonic()
                for _ in range(2000):
                    server.send(bytes(100_000))
                assert time.monotonic() - began < 2.0
                assert server.dropped > 0
                wait_until(lambda: server.n_clients == 0)
        finally:
            server.close()

    def test_more_clients_than_there_may_be_are_refused(self):
        server = IgtlServer('127.0.0.1', 0)
        clients = []
        try:
            for _ in range(MOST_CLIENTS + 3):
                clients.append(socket.create_connection(('127.0.0.1', server.port)))
            wait_until(lambda: server.refused == 3)
            assert server.n_clients == MOST_CLIENTS
            assert clients[-1].recv(1) == b'', 'a refused connection is closed'
            clients[0].close()
            wait_until(lambda: server.n_clients == MOST_CLIENTS - 1)
            clients.append(socket.create_connection(('127.0.0.1', server.port)))
            wait_until(lambda: server.n_clients == MOST_CLIENTS)
        finally:
            for client in clients:
                client.close()
            server.close()

    def test_a_client_that_never_stops_talking_still_gets_its_poses(self):
        server = IgtlServer('127.0.0.1', 0)
        try:
            with socket.create_connection(('127.0.0.1', server.port)) as client:
                wait_until(lambda: server.n_clients == 1)
                client.setblocking(False)
                end, sent = time.monotonic() + 0.5, 0
                while time.monotonic() < end:
                    with contextlib.suppress(BlockingIOError):
                        sent += client.send(bytes(65536))
                    server.send(b'pose')
                    time.sleep(0.001)
                client.settimeout(2.0)
                assert client.recv(4) == b'pose' and sent > 65536
        finally:
            server.close()


def test_device_names_keep_their_end():
    assert device_name('tool_a/0/x', '/state') == 'tool_a/0/x/state'
    assert device_name('a_long_instrument/sensor_0/x') == 'nstrument/sensor_0/x'
    assert len(transform_bytes('x' * 30, 1.0, (0, 0, 0), (0, 0, 0, 1))) == 58 + 48


def wait_until(condition, timeout_s=8.0):
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)
