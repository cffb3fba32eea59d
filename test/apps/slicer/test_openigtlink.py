"""Poses and states over TCP to real OpenIGTLink clients, the compiled library among them."""

import contextlib
import re
import shutil
import socket
import struct
import subprocess
import threading
import time
from pathlib import Path

import numpy as np
import pyigtl
import pytest
from conftest import spin_until, wait
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String

from anser_ros.apps.slicer import igtl
from anser_ros.apps.slicer.nodes.openigtlink import (
    MOST_CLIENTS,
    IgtlServer,
    OpenIGTLink,
    OpenIGTLinkParameters,
    check_templates,
    named_in,
)
from anser_ros.errors import ParameterError, PortError
from anser_ros.wire.setup import parse_setup
from anser_ros.wire.setup_values import TipSpec

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
def server():
    """A server that answers a request with its kind."""
    made = IgtlServer('127.0.0.1', 0, lambda header: header.kind.encode())
    yield made
    made.close()


@pytest.fixture
def tracker(ros):
    """A node that publishes what a tracker does."""
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
    process = start('openigtlink', '--ros-args', '-p', 'port:=0', '-p', 'version:=2')
    port = read_port(process)
    first, second = connect(port), connect(port)
    assert spin_until(tracker, lambda: tracker.listeners() == 1)
    waiting = first.wait_for_message('tool_a/0/x/state', timeout=60)
    assert waiting.string == 'no pose yet'
    second.wait_for_message('tool_a/0/x/state', timeout=60)
    tracker.send(w=float(np.sqrt(0.5)))
    for client in (first, second):
        pose = client.wait_for_message('tool_a/0/x', timeout=60)
        assert pose.message_type == 'TRANSFORM'
        assert pose.header_version == 2 and pose.metadata == {'TransformStatus': 'OK'}
        assert pose.timestamp == pytest.approx(1_750_000_000.25, abs=1e-6)
        expected = [[0, -1, 0, 100], [1, 0, 0, 0], [0, 0, 1, 200], [0, 0, 0, 1]]
        np.testing.assert_allclose(pose.matrix, expected, atol=1e-4)
    heard = []

    def say():
        tracker.say('residual')
        message = first.wait_for_message('tool_a/0/x/state', timeout=0.2)
        heard.extend([message] if message else [])

    assert wait(lambda: 'residual' in [message.string for message in heard], say)
    states, message = [message.string for message in heard], heard[-1]
    assert message.timestamp == pytest.approx(1_750_000_000.25, abs=300), "the pose's clock"
    assert states[-1] == 'residual' and set(states) <= {'ok', 'stale', 'residual'}
    tracker.send()
    assert first.wait_for_message('tool_a/0/x', timeout=60).matrix[0, 3] == pytest.approx(100)
    assert process.interrupt() == 0


class TestServer:
    def test_it_listens_to_this_host_only_and_a_taken_port_is_said_in_one_line(self, start):
        assert OpenIGTLinkParameters.host == '127.0.0.1'
        with socket.create_server(('127.0.0.1', 0)) as taken:
            port = taken.getsockname()[1]
            process = start('openigtlink', '--ros-args', '-p', f'port:={port}')
            assert process.wait() == 2
            assert f'cannot listen on 127.0.0.1:{port}: Address already' in process.output
            assert 'Traceback' not in process.output
            with pytest.raises(PortError, match='Address already in use'):
                IgtlServer('127.0.0.1', port, lambda _: b'')

    def test_what_a_client_asks_is_answered(self, server):
        """Requests may come in pieces, and between messages that are none of ours."""
        other = igtl.message('IMAGE', 'x', 1.0, bytes(5000))
        asked = [igtl.message(kind, '', 1.0, b'') for kind in ('GET_CAPABIL', 'STP_TDATA')]
        begin = igtl.message('STT_TDATA', '', 1.0, struct.pack('>i32s', 20, b''), {})
        with socket.create_connection(('127.0.0.1', server.port)) as client:
            client.settimeout(60.0)
            for byte in asked[0][:30], asked[0][30:] + other, begin:
                client.sendall(byte)
                time.sleep(0.02)
            assert read(client, 20) == b'GET_CAPABILSTT_TDATA'
            server.send(b'old', b'new')
            assert read(client, 3) == b'new', 'it has asked in version 2'
            for now_s in (10.0, 10.01, 10.021, 10.022):
                server.send_tracking(lambda: b'tracked', now_s)
            assert read(client, 14) == 2 * b'tracked'
            client.sendall(asked[1])
            assert read(client, 9) == b'STP_TDATA'
            server.send_tracking(lambda: pytest.fail('nobody wants it'), 20.0)

    @pytest.mark.long
    def test_a_client_that_reads_nothing_holds_nobody_up(self, server):
        with socket.create_connection(('127.0.0.1', server.port)):
            assert wait(lambda: server.n_clients == 1)
            for _ in range(2000):
                server.send(bytes(100_000))
            assert server.dropped > 0
            assert wait(lambda: server.n_clients == 0)

    def test_more_clients_than_there_may_be_are_refused(self, server):
        with contextlib.ExitStack() as stack:

            def connect():
                client = socket.create_connection(('127.0.0.1', server.port))
                return stack.enter_context(client)

            clients = [connect() for _ in range(MOST_CLIENTS + 3)]
            assert wait(lambda: server.refused == 3)
            assert server.n_clients == MOST_CLIENTS
            assert clients[-1].recv(1) == b'', 'a refused connection is closed'
            clients[0].close()
            assert wait(lambda: server.n_clients == MOST_CLIENTS - 1)
            connect()
            assert wait(lambda: server.n_clients == MOST_CLIENTS)

    def test_a_client_that_never_stops_talking_still_gets_its_poses(self, server):
        with socket.create_connection(('127.0.0.1', server.port)) as client:
            assert wait(lambda: server.n_clients == 1)
            client.setblocking(False)
            sent = 0
            while sent <= 2_000_000:
                with contextlib.suppress(BlockingIOError):
                    sent += client.send(bytes(65536))
                server.send(b'pose')
                time.sleep(0.001)
            client.settimeout(60.0)
            assert client.recv(4) == b'pose'


def read(client, count):
    data = b''
    while len(data) < count:
        piece = client.recv(count - len(data))
        assert piece, data
        data += piece
    return data


def test_replies_of_the_node(ros, tracker):
    """What it can, how it is, and the poses of all that are tracked, but none that is no pose."""
    body_name = '{body}InTheOperatingRoom'
    values = {'port': 0, 'coil_name': '{sensor}Of{body}', 'body_name': body_name}
    node = OpenIGTLink(parameter_overrides=[Parameter(k, value=v) for k, v in values.items()])
    try:
        with socket.create_connection(('127.0.0.1', node._server.port)) as client:
            client.settimeout(60.0)
            for kind in ('GET_CAPABIL', 'GET_STATUS', 'STT_TDATA'):
                client.sendall(igtl.message(kind, '', 1.0, b''))
            found = [take(client) for _ in range(3)]
            assert [kind for kind, _, _ in found] == ['CAPABILITY', 'STATUS', 'RTS_TDATA']
            words = [w.rstrip(b'\0').decode() for (w,) in struct.iter_unpack('12s', found[0][2])]
            assert words == list(igtl.CAPABILITIES)
            code, _, name = struct.unpack('>Hq20s', found[1][2][:30])
            assert code == igtl.NOT_READY and name.startswith(b'WARN')
            assert found[1][2][30:] == b'no setup yet\0'
            assert spin_until(node, lambda: tracker.listeners() == 1)
            assert spin_until(node, lambda: node._n_clients == 1)
            tracker.send(x=float('nan'))
            assert spin_until(node, lambda: node.counters['poses_refused'] == 1)
            assert node.counters['transforms'] == 0
            tracker.send()
            assert spin_until(node, lambda: node.counters['transforms'] == 1)
            kinds = {}
            while 'TDATA' not in kinds:
                kind, device, body = take(client)
                kinds.setdefault(kind, []).append((device, body))
            assert kinds['TRANSFORM'][0][0] == '0/xOftool_a'
            states = [(d, struct.unpack('>H', b[:2])[0]) for d, b in kinds['STATUS']]
            assert states[-1] == ('0/xOftool_a', igtl.OK)
            assert ('_aInTheOperatingRoom', igtl.NOT_READY) in states
            assert node.counters['tool_a_cut'], 'and not the coil, whose name has room'
            assert not node.counters['tool_a/0/x_cut']
            ((_, data),) = kinds['TDATA']
            assert len(kinds['TRANSFORM'][0][1]) == 48, 'no metadata: it has asked in version 1'
            assert len(data) == 70, 'one instrument: the body has no pose'
            place = np.frombuffer(data[22:], '>f4').reshape(4, 3)[3]
            np.testing.assert_allclose(place, [100.0, 0.0, 200.0], rtol=1e-6)
    finally:
        node.close()
        node.destroy_node()


def take(client):
    header = igtl.read_header(first := read(client, igtl.HEADER_BYTES))
    body = read(client, header.body_bytes)
    assert struct.unpack('>Q', first[50:])[0] == igtl.crc64(body)
    return header.kind, header.device, body


class TestNames:
    def named(self, text=SETUP, **values):
        return igtl.device_names(named_in(parse_setup(text), OpenIGTLinkParameters(**values)))

    def test_templates_name_coils_bodies_and_tips(self):
        assert self.named() == {'tool_a/0/x': 'tool_a/0/x', 'tool_a': 'tool_a'}
        assert self.named(body_name='{body}ToTracker', coils=False) == {
            'tool_a': 'tool_aToTracker'
        }
        with pytest.raises(ParameterError, match=r'body_name may have \{body\}'):
            check_templates(OpenIGTLinkParameters(body_name='{tool}'))
        setup = parse_setup(SETUP).with_tips({'tool_a': TipSpec((0.01, -0.02, -0.15), (0.0,) * 6)})
        table = OpenIGTLinkParameters(coils=False)
        assert set(named_in(setup, table)) == {'tool_a', 'tool_a/tip'}

    def test_two_devices_of_one_name_are_refused(self):
        with pytest.raises(ParameterError, match="both become the device 'pen'"):
            self.named(body_name='pen', coil_name='pen')
        assert igtl.device_names({'a': 'a_long_instrument/sensor_0/x'}) == {
            'a': 'nstrument/sensor_0/x'
        }
        long = ['left_distal/coil/x', 'right_distal/coil/x']
        with pytest.raises(ParameterError, match='ight_distal/coil/x'):
            igtl.device_names({n: f'instrument/inner_{n}' for n in ['right_' + m for m in long]})
        with pytest.raises(ParameterError, match='cannot be the name of a device'):
            igtl.device_names({'a': 'Größe'})
        with pytest.raises(ParameterError, match="'pen/state'"):
            igtl.device_names({'a': 'pen', 'b': 'pen/state'})


def test_the_bytes_are_those_of_the_protocol():
    """As pyigtl packs them: headers of both versions, texts, and the check sum."""
    matrix = np.eye(4)
    matrix[:3, 3] = [1.0, 2.0, 3.0]
    for version, metadata in ((1, {}), (2, {'TransformStatus': 'OK'})):
        other = pyigtl.TransformMessage(matrix, timestamp=2.5, device_name='pen')
        other.header_version, other.metadata = version, metadata
        ours = igtl.transform('pen', 2.5, (1e-3, 2e-3, 3e-3), (0, 0, 0, 1), version)
        assert ours == other.pack()
    text = pyigtl.StringMessage('stale', timestamp=1.0, device_name='pen/state')
    assert igtl.string('pen/state', 1.0, 'stale') == text.pack()


def heard(client, server):
    """What a client gets of a server that says the same again and again."""
    for _ in range(100):
        server.send(b'pose')
        try:
            return client.recv(4)
        except TimeoutError:
            continue
    return b''


def test_whatever_a_client_says(server):
    for path in sorted(Path(__file__).with_name('corpus').iterdir()):
        with socket.create_connection(('127.0.0.1', server.port), timeout=60.0) as client:
            client.sendall(path.read_bytes())
            client.settimeout(0.05)
            assert heard(client, server) == b'pose', path


HEADERS = Path('/usr/include/openigtlink')
HALF = 0.5**0.5


@pytest.fixture(scope='module')
def client(tmp_path_factory):
    """The client, compiled, as a path."""
    compiler = shutil.which('g++')
    if compiler is None or not HEADERS.is_dir():
        pytest.skip('no g++ or no headers (apt install g++ libopenigtlink-dev)')
    path = tmp_path_factory.mktemp('igtl') / 'client'
    source = Path(__file__).with_name('client.cpp')
    command = [compiler, '-w', f'-I{HEADERS}', str(source), '-o', str(path), '-lOpenIGTLink']
    done = subprocess.run([*command, '-lpthread'], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return path


@pytest.mark.long
@pytest.mark.processes
def test_the_library_reads_poses_states_and_replies(client):
    def answer(header):
        if header.kind == 'GET_CAPABIL':
            return igtl.capability(1.0)
        return igtl.tracking_reply(2.0)

    place, turn = (0.1, -0.02, 0.2), (0.0, 0.0, HALF, HALF)  # a quarter turn about z
    told = [
        igtl.transform('penToTracker', 1_750_000_000.25, place, turn, 1),
        igtl.string('pen/state', 3.5, 'stale'),
        igtl.status('pen', 4.5, 13, 'residual', '4.2 times what is expected'),
    ]
    server = IgtlServer('127.0.0.1', 0, answer)
    done = threading.Event()

    def serve():
        now_s = 0.0
        while not done.wait(0.05):
            now_s += 0.05
            for one in told:
                server.send(one, one)
            server.send_tracking(igtl.tracking(5.0, [igtl.Tracked('pen', place, turn)]), now_s)

    sender = threading.Thread(target=serve)
    sender.start()
    try:
        command = [str(client), str(server.port), '40']
        read = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    finally:
        done.set()
        sender.join()
        server.close()
    assert read.returncode == 0, read.stdout + read.stderr
    lines = set(read.stdout.splitlines())
    matrix = '0.0000 -1.0000 0.0000 100.0000 1.0000 0.0000 0.0000 -20.0000 0.0000 0.0000 1.0000 '
    matrix += '200.0000'
    assert {line.replace('-0.0000', '0.0000') for line in lines} == {
        f'TRANSFORM penToTracker 1750000000.250 matrix {matrix}',
        'STRING pen/state 3.500 stale',
        'STATUS pen 4.500 13 residual 4.2 times what is expected',
        f'CAPABILITY  1.000 {" ".join(igtl.CAPABILITIES)}',
        'RTS_TDATA  2.000 0',
        f'TDATA  5.000 pen {matrix}',
    }
