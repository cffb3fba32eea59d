"""The replay as a process: what arrives, in what order and when, and what of a bad bag is left."""

import re
import signal
import sys
import threading
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from conftest import Process, wait
from geometry_msgs.msg import PoseStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String
from tracking_world import flux_points

from anser_ros.errors import AnserError
from anser_ros.nodes import replay
from anser_ros.nodes.replay import name_played
from anser_ros.nodes.streams import readiness
from anser_ros.wire import cdr
from anser_ros.wire.bag import Salvage, iter_messages
from anser_ros.wire.bag_writer import BagWriter, SessionWriter
from anser_ros.wire.points import encode_flux
from anser_ros.wire.text_files import read_config

START_NS = 1_750_000_000 * 10**9
PERIOD_NS = 20_000_000


def flux_cloud(n):
    rng = np.random.default_rng(n)
    flux = 1e-6 * (rng.normal(size=(3, 8)) + 1j * rng.normal(size=(3, 8)))
    fields, step, data = encode_flux(flux_points(flux, channels=np.arange(1, 4)))
    return fields, step, 3, data


def make_session(path, count):
    with SessionWriter(path) as session:
        session.write_setup('schema: anser_setup/1\n', START_NS)
        for n in range(count):
            stamp_ns = START_NS + n * PERIOD_NS
            session.write_flux('/anser/tool/flux', stamp_ns, *flux_cloud(n))
            session.write_pose('/optical/tool_a/pose', stamp_ns, (0.0, 0.0, 0.1), (0, 0, 0, 1))
            session.write_pose('/anser/tool_a/pose', stamp_ns, (0.0, 0.0, 0.1), (0, 0, 0, 1))
    return path


@pytest.fixture
def listener(ros, request):
    """A node that takes what is replayed, with a queue of 5 or so; ``delay_s`` makes it slow."""
    node = ros.create_node('listener')
    node.stamps, node.got, node.delay_s = [], [], 0.0

    def on_flux(message):
        time.sleep(node.delay_s)
        node.stamps.append(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)
        node.data = bytes(message.data)

    def take(name):
        return lambda message: node.got.append((name, message))

    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    depth = getattr(request, 'param', 5)
    node.create_subscription(PointCloud2, '/anser/tool/flux', on_flux, depth)
    node.create_subscription(PointCloud2, '/other/tool/flux', on_flux, 5)
    node.create_subscription(String, '/anser/setup', take('setup'), latched)
    node.create_subscription(PoseStamped, '/optical/tool_a/pose', take('optical'), 1000)
    node.create_subscription(PoseStamped, '/anser/tool_a/pose', take('pose'), 1000)
    node.create_subscription(Clock, '/clock', take('clock'), 1000)
    executor = SingleThreadedExecutor()
    executor.add_node(node)

    node.spin = lambda: executor.spin_once(timeout_sec=0.05)
    node.run = lambda condition: wait(condition, node.spin)
    node.count = lambda name: sum(topic == name for topic, _ in node.got)
    yield node
    executor.shutdown()
    node.destroy_node()


@pytest.fixture
def play(ros, monkeypatch):
    """Play a bag in this process to its end, ``meanwhile`` spinning whoever listens.

    Whoever listens is there before; ``ending`` is the event by which the node is ended.
    """
    monkeypatch.setattr(readiness, 'LOOK_S', 0.0)
    nodes, executor = [], SingleThreadedExecutor()

    def run(bag, meanwhile=lambda: time.sleep(0.01), ending=None, **options):
        nodes.append(node := replay.Replay(str(bag), **options))
        node._ending = ending or node._ending
        executor.add_node(node)
        assert wait(lambda: node.exit_code is not None, meanwhile)
        return node

    thread = threading.Thread(target=executor.spin)
    thread.start()
    yield run
    for node in nodes:
        node.close()
    executor.shutdown()
    thread.join()
    for node in nodes:
        node.destroy_node()


@pytest.mark.parametrize('awaits', [True, False])
def test_a_server_whose_first_refit_is_being_made_is_not_ready(awaits):
    """Frames that came now would have no poses, but `evaluate --refit` has them."""
    look = object.__new__(readiness.Readiness)
    look._since_s, values = 0.0, {'stamp_ns': '1', 'awaits_refit': str(awaits)}
    look._reports = {'anser/field_model': (1.0, values)}
    fluxes = {'/anser/reference/flux': ['/anser/field_model']}
    assert look._is_ready('/anser/field_model', fluxes) is not awaits


@pytest.mark.parametrize('topic', ['/anser/tool/flux', '/anser/reference/flux'])
def test_a_server_is_ready_unheard_where_no_reference_is_played(topic):
    look = object.__new__(readiness.Readiness)
    look._since_s, look._reports = 0.0, {'anser/field_model': (1.0, {'stamp_ns': '1'})}
    assert look._is_ready('/anser/field_model', {topic: []}) is topic.endswith('tool/flux')


@pytest.mark.parametrize('listener', [100], indirect=True)
def test_everything_arrives_with_its_stamps(start, listener, tmp_path):
    bag = make_session(tmp_path / 'a.mcap', 100)
    process = start('replay', bag, '--rate', '2')
    assert listener.run(lambda: len(listener.stamps) == 100), process.output
    assert listener.stamps == [START_NS + n * PERIOD_NS for n in range(100)]
    assert listener.data == flux_cloud(99)[3]
    assert listener.run(lambda: process.popen.poll() is not None)
    assert process.popen.returncode == 0
    assert 'published 201 of 201 messages' in process.output
    assert (listener.count('setup'), listener.count('optical')) == (1, 100)
    assert listener.count('pose') == 0  # the tracker's own
    clocks = [m.clock.sec * 10**9 + m.clock.nanosec for name, m in listener.got if name == 'clock']
    assert clocks[0] == START_NS and clocks == sorted(clocks) and len(clocks) == 100


def test_as_fast_as_taken_loses_nothing(play, listener, tmp_path):
    """The listener's queue holds five, and it needs longer than the bag's publisher."""
    listener.delay_s = 0.002
    play(make_session(tmp_path / 'a.mcap', 150), listener.spin, rate=0.0, all_topics=True)
    assert listener.stamps == [START_NS + n * PERIOD_NS for n in range(150)]
    assert listener.run(lambda: listener.count('pose') == 150)


def test_who_listens_to_poses_may_be_slower_than_the_tracker(ros, play, tmp_path):
    """A relay stands in for the tracker; the queue of who listens holds five."""
    bag, topic, count = tmp_path / 'a.mcap', 'tool_a_0/x/pose', 50
    with SessionWriter(bag) as session:
        session.write_setup(read_config('demo_setup.yaml'), START_NS)
        for n in range(count):
            session.write_flux('/anser/tool/flux', START_NS + n * PERIOD_NS, *flux_cloud(n))
    relay, slow = ros.create_node('relay', namespace='anser'), ros.create_node('slow')
    poses = relay.create_publisher(PoseStamped, topic, 100)
    relay.create_subscription(
        PointCloud2, 'tool/flux', lambda m: poses.publish(PoseStamped(header=m.header)), 100
    )
    got = []

    def take(message):
        time.sleep(0.03)
        got.append(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)

    slow.create_subscription(PoseStamped, f'/anser/{topic}', take, 5)
    executors = [SingleThreadedExecutor(), SingleThreadedExecutor()]
    executors[0].add_node(relay)
    executors[1].add_node(slow)
    thread = threading.Thread(target=executors[0].spin)
    thread.start()
    try:
        play(bag, lambda: executors[1].spin_once(timeout_sec=0.05), rate=0.0)
    finally:
        executors[0].shutdown()
        thread.join()
        executors[1].shutdown()
        relay.destroy_node()
        slow.destroy_node()
    assert got == [START_NS + n * PERIOD_NS for n in range(count)]


def test_loop_in_another_namespace_ends_at_a_signal(start, listener, tmp_path):
    bag = make_session(tmp_path / 'a.mcap', 10)
    words = ['--loop', '--rate', '5', '--wait', '0.1', '--ros-args', '-r', '__ns:=/other']
    process = start('replay', bag, *words)
    assert listener.run(lambda: len(listener.stamps) > 25), process.output
    assert process.interrupt(signal.SIGINT) == 0
    said = r'published the bag (\d+) times, and (\d+) of 21 messages once more'
    passes, part = map(int, re.search(said, process.output).groups())
    assert part <= 21, 'a pass has the setup, ten frames and ten optical poses'
    assert 10 * passes + part / 2 >= len(listener.stamps)


@pytest.mark.parametrize(
    ('topic', 'home', 'name'),
    [
        ('/anser/tool/flux', '/anser/', 'tool/flux'),
        ('/left/tool/flux', '/left/', 'tool/flux'),
        ('/optical/tool_a/pose', '/anser/', '/here/tool_a/pose'),
        ('/left/optical/tool_a/pose', '/left/', '/here/tool_a/pose'),
        ('/camera/image', '/left/', '/camera/image'),
        ('/tool/flux', '/', '/tool/flux'),
    ],
)
def test_what_a_bag_holds_is_played_in_this_namespace(topic, home, name):
    assert name_played(topic, home, '/here/') == name


def test_a_cut_bag_is_played_as_far_as_it_reads(play, listener, tmp_path):
    whole = make_session(tmp_path / 'a.mcap', 800).read_bytes()
    bag = tmp_path / 'cut.mcap'
    bag.write_bytes(whole[: len(whole) // 2])
    node = play(bag, listener.spin, rate=0.0)
    assert node.exit_code == 0 and 'the bag breaks off after' in node.status().message
    assert listener.stamps == [START_NS + n * PERIOD_NS for n in range(len(listener.stamps))]
    assert 100 < len(listener.stamps) < 600


def test_what_does_not_decode_is_left_out(play, listener, tmp_path, capfd):
    bag = BagWriter(tmp_path / 'bad.mcap')
    cloud, text = 'sensor_msgs/msg/PointCloud2', cdr.DEFINITIONS['sensor_msgs/msg/PointCloud2']
    flux = bag.add_topic('/anser/tool/flux', cloud, text)
    stranger = bag.add_topic('/anser/strange', 'no_msgs/msg/None', 'uint8 x\n')
    good = cdr.cloud_bytes(START_NS, 'fg', *flux_cloud(0))
    bag.write(stranger, START_NS, b'\0\1\0\0\7')
    for n, data in enumerate((good, good[:40], b'', b'\xff' * 60, good)):
        bag.write(flux, START_NS + n, data)
    bag.close()
    node = play(tmp_path / 'bad.mcap', listener.spin, rate=0.0)
    assert node.exit_code == 0 and node.counters['messages_left_out'] == 1
    said = ''.join(capfd.readouterr())
    assert '/anser/strange: type no_msgs/msg/None is not installed' in said
    assert '1 messages that do not decode left out' in said and 'of another form, not CDR' in said
    assert len(listener.stamps) == 2


def test_what_cannot_be_played_is_refused(ros, tmp_path):
    other = tmp_path / 'other.mcap'
    bag = BagWriter(other)
    chat = bag.add_topic('/chat', 'std_msgs/msg/String', 'string data\n')
    bag.write(chat, START_NS, b'\0\1\0\0\3\0\0\0hi\0')
    bag.close()
    for name, options, said in (
        ('nowhere.mcap', {}, 'no such bag'),
        ('nowhere.mcap', {'rate': -1.0}, 'rate -1.0 is neither 0 nor a positive number'),
        ('nowhere.mcap', {'wait': -1.0}, 'wait -1.0 is negative'),
        (other, {}, 'neither a setup nor fluxes that could be replayed'),
    ):
        with pytest.raises(AnserError, match=said):
            replay.Replay(str(name), **options)


def test_nobody_listens(play, tmp_path, monkeypatch):
    """It waits for listeners, and plays for the record when none comes."""
    steps = []
    monkeypatch.setattr(replay.Replay, '_acknowledged', lambda _, topic: steps.append('received'))
    monkeypatch.setattr(replay.Consumers, 'wait', lambda *_, **__: steps.append('handled'))
    node = play(make_session(tmp_path / 'a.mcap', 3), rate=0.0, wait=0.2)
    assert node.exit_code == 0 and node.counters['no_listeners'] == 1
    first = ['received', *3 * ['handled']]
    assert steps[:4] == first, 'nobody who has not received the first is asked'


class Dues(threading.Event):
    """Ends every wait at once, and keeps the moment at which it would have ended."""

    def __init__(self):
        super().__init__()
        self.until = []

    def wait(self, timeout=None):
        self.until.append(time.monotonic() + timeout)
        return super().wait(min(timeout, 1e-3))


def test_messages_are_due_at_the_pace_of_the_rate(play, tmp_path):
    """Counted in moments that are waited for, so that no busy machine makes a difference."""
    began, dues = time.monotonic(), Dues()
    play(make_session(tmp_path / 'a.mcap', 100), ending=dues, rate=0.2, wait=0.2)
    assert dues.until[-1] - began > 99 * PERIOD_NS * 1e-9 / 0.2, 'no faster than its pace'


def test_a_node_that_is_still_starting_is_waited_for_longer(ros, play, tmp_path):
    """A tracker that compiles its kernels is in the graph, and has not said a word yet."""
    starting = ros.create_node('tracker', namespace='anser')
    starting.create_subscription(PointCloud2, 'tool/flux', lambda _: None, 10)
    began = time.monotonic()
    node = play(make_session(tmp_path / 'a.mcap', 3), rate=100.0, wait=0.5)
    assert time.monotonic() - began >= replay.STARTING_FACTOR * 0.5
    assert node.exit_code == 0 and node.counters['no_listeners'] == 1
    starting.destroy_node()


BAGS = Path(__file__).resolve().parents[1] / 'bags'
# Somebody else's node: it knows nothing of this package, and has a queue as most have.
OUTSIDER = """
import signal, sys
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
ending, missing = [], {topic: set(range(200)) for topic in sys.argv[1:]}
signal.signal(signal.SIGINT, lambda *_: ending.append(1))
node = rclpy.create_node('outsider')
for topic, left in missing.items():
    take = lambda m, left=left: left.discard(
        (m.header.stamp.sec - 1700000000) * 25 + m.header.stamp.nanosec // 40_000_000
    )
    node.create_subscription(PoseStamped, f'/anser/{topic}/pose', take, 10)
executor = SingleThreadedExecutor()
executor.add_node(node)
while not ending and any(missing.values()):
    executor.spin_once(timeout_sec=0.05)
print('missing frames', *map(sorted, missing.values()))
"""


@pytest.mark.parametrize('first', ['replay', 'nodes'])
def test_all_started_in_the_same_moment_lose_no_frame(start, domain, tmp_path, first):
    """Nodes, replay and somebody who counts the poses of some sensors, with no wait in between.

    The board of the bag is not the drawn one, so the gate stands open: poses are only counted.
    """
    topics = ('tool_a_0/x', 'tool_a_2/z', 'tool_a')

    def nodes():
        start('field_model', '--ros-args', '-p', 'allow_uncalibrated:=true')
        # A frame waits for the model of its instant, however long a busy machine takes.
        gate = '-p', 'gate:=1e5', '-p', 'max_sigma_m:=1.0'
        start('tracker', '--ros-args', *gate, '-p', 'model_wait_s:=10.0')
        return start('recorder', '--ros-args', '-p', f'directory:={tmp_path}', '-p', 'name:=bag')

    recorder = nodes() if first == 'nodes' else None
    play = start('replay', BAGS / 'moving.mcap', '--rate', '0', '--wait', '200')
    outsider = Process([sys.executable, '-c', OUTSIDER, *topics], tmp_path / 'outsider.log')
    try:
        recorder = recorder or nodes()
        assert play.wait() == 0, play.output
        wait(lambda: outsider.popen.poll() is not None)
        assert outsider.interrupt() == 0
        assert outsider.output == 'missing frames [] [] []\n', play.output
    finally:
        outsider.kill_group()
    assert recorder.interrupt() == 0
    counts = Counter(m.topic for m in iter_messages(str(tmp_path / 'bag'), Salvage()))
    for topic in ('tool/flux', 'reference/flux', 'tool_a/pose', 'tool_a_1/y/pose'):
        assert counts[f'/anser/{topic}'] == 200, topic
