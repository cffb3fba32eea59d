"""The recorder as a process: what it writes, what a crash and a full disk cost."""

import contextlib
import os
import signal
import subprocess
import time
from importlib.util import find_spec
from pathlib import Path

import pytest
import yaml
from conftest import ask, diagnostics, spin_until, wait
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from mcap.reader import make_reader
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from std_msgs.msg import String
from std_srvs.srv import Trigger

from anser_ros.errors import BagError
from anser_ros.nodes.recorder import Faults, TopicLog, definition, message_class, report
from anser_ros.nodes.runtime.diagnostics import LastStatus, Level, Status, diagnostic_array
from anser_ros.wire.bag import Salvage, iter_messages
from anser_ros.wire.bag_writer import BagRecord
from anser_ros.wire.cdr import DEFINITIONS

pytestmark = pytest.mark.light


@pytest.fixture
def source(ros):
    """A node that publishes what the recorder is to record."""
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    node = ros.create_node('source')
    node.setup = node.create_publisher(String, '/anser/setup', latched)
    node.pose = node.create_publisher(PoseStamped, '/optical/tool_a/pose', 100)
    node.other = node.create_publisher(String, '/elsewhere', 10)
    node.sent = 0

    def send(padding=''):
        message = PoseStamped()
        node.sent += 1
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(node.sent * 10**7, 10**9)
        message.header.frame_id = 'fg' + padding
        node.pose.publish(message)

    node.send = send
    yield node
    node.destroy_node()


def begin(start, source, tmp_path, *options):
    """Start a recorder and wait until it listens."""
    source.setup.publish(String(data='schema: anser_setup/1'))
    arguments = [f'directory:={tmp_path}', 'name:=bag', *options]
    pairs = [word for argument in arguments for word in ('-p', argument)]
    process = start('recorder', '--ros-args', *pairs)
    assert spin_until(source, lambda: source.pose.get_subscription_count() == 1), process.output
    return process


def call(node, name):
    return ask(node, Trigger, name)


def test_a_bag_is_complete_and_described(start, source, tmp_path):
    """With the poses of another tracker in it, and without the error of a model."""
    lines = diagnostics(source)
    for topic in ('field_model', 'field_model_error'):
        source.create_publisher(String, f'/anser/{topic}', 10)
    source.create_publisher(PoseStamped, '/tracked/tip/pose', 10)
    process = begin(start, source, tmp_path)
    for topic in ('/tracked/tip/pose', '/anser/field_model'):
        assert spin_until(source, lambda topic=topic: source.count_subscribers(topic) == 1)
    assert source.count_subscribers('/anser/field_model_error') == 0
    late = source.create_publisher(PoseStamped, '/tracked/tip/pose', qos_profile_sensor_data)
    assert spin_until(source, lambda: late.get_subscription_count() == 1)
    late.publish(PoseStamped())
    for _ in range(50):
        source.send()
        time.sleep(0.01)
    source.sent += 30
    source.send()
    # The poses, the latched setup and a diagnostic message.
    name, nothing = 'anser/recorder', (0, '', {})
    assert spin_until(source, lambda: int(lines.get(name, nothing)[2].get('messages', 0)) > 53)
    assert process.interrupt(signal.SIGTERM) == 0
    assert '/optical/tool_a/pose 1 gaps up to 0.31 s' in process.output
    bag = tmp_path / 'bag' / 'bag_0.mcap'
    with bag.open('rb') as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == 'ros2'
        summary = reader.get_summary()
        assert {index.compression for index in summary.chunk_indexes} == {'zstd'}
        topics = {channel.topic: channel for channel in summary.channels.values()}
        counts = {
            c.topic: summary.statistics.channel_message_counts.get(i, 0)
            for i, c in summary.channels.items()
        }
        schema = summary.schemas[topics['/optical/tool_a/pose'].schema_id]
    assert counts['/optical/tool_a/pose'] == 51 and counts['/anser/setup'] == 1
    assert counts['/tracked/tip/pose'] == 1, 'of a best-effort publisher that came later'
    assert '/elsewhere' not in topics and '/diagnostics' in topics
    assert 'MSG: geometry_msgs/Quaternion' in schema.data.decode()
    assert schema.data.decode().count('MSG: builtin_interfaces/Time') == 1
    metadata = topics['/anser/setup'].metadata
    (offered,) = yaml.safe_load(metadata['offered_qos_profiles'])
    assert offered['durability'] == 'transient_local'
    assert metadata['topic_type_hash'].startswith('RIHS01_')
    info = yaml.safe_load((bag.parent / 'metadata.yaml').read_text())
    info = info['rosbag2_bagfile_information']
    assert info['message_count'] == sum(counts.values())
    assert info['custom_data'] == {'closed': 'true'}


def test_a_kill_costs_only_what_came_since_the_last_flush(start, source, tmp_path):
    process, bag = begin(start, source, tmp_path), tmp_path / 'bag'

    def there():
        salvage, messages, about = Salvage(), [], {'message_count': 0}
        with contextlib.suppress(BagError, FileNotFoundError):  # nothing is flushed yet
            messages = list(iter_messages(bag, salvage))
            text = (bag / 'metadata.yaml').read_text()
            about = yaml.safe_load(text)['rosbag2_bagfile_information']
        return messages, salvage, about

    def is_flushed():
        messages, _, about = there()
        return sum('pose' in m.topic for m in messages) > 50 and about['message_count']

    def send():
        source.send()
        time.sleep(0.02)

    assert wait(is_flushed, send)
    flushed = len(there()[0])
    process.interrupt(signal.SIGKILL)
    messages, salvage, about = there()
    assert salvage.lost and len(messages) >= flushed
    assert about['relative_file_paths'] == ['bag_0.mcap']
    assert about['custom_data'] == {'closed': 'false'}
    assert about['message_count'] <= len(messages)
    told_s = 1e-9 * about['duration']['nanoseconds']
    assert 0 < told_s <= 1e-9 * (messages[-1].log_time_ns - messages[0].log_time_ns)


def test_services_start_and_stop_and_no_bag_is_written_over(start, source, tmp_path):
    (tmp_path / 'bag').mkdir()
    (tmp_path / 'bag' / 'bag_0.mcap').write_bytes(b'precious')
    process = start('recorder', '--ros-args', '-p', f'directory:={tmp_path}', '-p', 'name:=bag')
    began = call(source, '/anser/recorder/start')
    assert (began.success, began.message) == (False, 'records already')
    assert f'recording to {tmp_path / "bag_1"}' in process.output
    ended = call(source, '/anser/recorder/stop')
    assert ended.success and 'no gaps' in ended.message
    again = call(source, '/anser/recorder/stop')
    assert (again.success, again.message) == (False, 'not recording')
    again = call(source, '/anser/recorder/start')
    assert (again.success, again.message) == (True, str(tmp_path / 'bag_2'))
    assert process.interrupt() == 0
    assert (tmp_path / 'bag_1' / 'bag_1_0.mcap').is_file()
    assert (tmp_path / 'bag_2' / 'bag_2_0.mcap').is_file()
    assert (tmp_path / 'bag' / 'bag_0.mcap').read_bytes() == b'precious'


def test_a_fault_leaves_a_bag_of_the_seconds_around_it(start, source, tmp_path):
    """Not a node that lacks much at its start, nor another system's; with what was latched."""
    reports = source.create_publisher(DiagnosticArray, '/diagnostics', 10)

    def report(*statuses):
        time = source.get_clock().now().to_msg()
        reports.publish(diagnostic_array('anser/tracker', statuses, time))

    options = 'autostart:=false', 'snapshot_duration:=30.0', 'snapshot_duration_after:=1.0'
    process = begin(start, source, tmp_path, *options)
    assert spin_until(source, lambda: reports.get_subscription_count() == 1)
    report(Status('', Level.WARN, 'no setup yet'), Status('tip', Level.STALE, 'stale'))
    for _ in range(20):
        source.send()
        report(Status('', Level.OK, '1 of 1 tracked'), Status('tip', Level.OK, 'ok'))
        time.sleep(0.02)
    assert not list(tmp_path.glob('snapshot_*'))
    report(Status('tip', Level.WARN, 'residual'))

    def there():
        for path in tmp_path.glob('snapshot_*/metadata.yaml'):
            info = yaml.safe_load(path.read_text())['rosbag2_bagfile_information']
            if info['custom_data']['closed'] == 'true':
                return path.parent
        return None

    sent = source.sent
    assert wait(there, lambda: (source.send(), time.sleep(0.02)))
    messages = list(iter_messages(there(), Salvage()))
    topics = [message.topic for message in messages]
    assert topics.count('/anser/setup') == 1
    assert topics.count('/optical/tool_a/pose') > sent == 20, 'those after it, too'
    assert 'anser/tracker: tip: residual' in process.output
    asked = call(source, '/anser/recorder/snapshot')
    assert asked.success and asked.message.startswith(str(tmp_path / 'snapshot_'))
    assert process.interrupt() == 0
    assert sum('/setup' in m.topic for m in iter_messages(Path(asked.message), Salvage())) == 1


class TestFaults:
    @pytest.mark.parametrize(
        ('before', 'now', 'words'),
        [
            ({'n: tip': (0, 'ok', {})}, {'n: tip': (1, 'no_signal', {})}, 'anser/n: tip: no_sig'),
            ({'n: tip': (3, 'stale', {})}, {'n: tip': (1, 'no_signal', {})}, ''),
            ({'n: tip': (0, 'ok', {'frames_residual': '1', 'frames_ok': '5'})},
             {'n: tip': (0, 'ok', {'frames_residual': '2', 'frames_ok': '9'})}, 'anser/n: tip'),
            ({'n: tip': (0, 'ok', {'frames_ok': '5'})},
             {'n: tip': (0, 'ok', {'frames_ok': '9'})}, ''),
            ({}, {'n': (1, 'no setup', {}), 'n: tip': (3, 'stale', {})}, ''),
            ({'n': (1, 'found', {})}, {'n: metal': (1, 'new', {})}, 'anser/n: metal: new'),
            ({'n': (0, 'ok', {})}, {'n': (3, 'ended', {})}, ''),
            ({'acquisition': (3, 'ended', {}), 'n': (0, 'ok', {})}, {'n': (1, 'stale', {})}, ''),
            ({'acquisition': (2, 'no port', {}), 'replay': (3, 'ended', {}), 'n': (0, 'ok', {})},
             {'n': (1, 'stale', {})}, 'anser/n: stale'),
            ({'recorder': (0, 'ok', {})}, {'recorder': (2, 'full', {})}, ''),
        ],
    )  # fmt: skip
    def test_what_is_one(self, before, now, words):
        faults = Faults('/anser', 'recorder')
        for statuses, expected in ((before, ''), (now, words)):
            given = {f'anser/{name}': LastStatus(*one) for name, one in statuses.items()}
            assert (faults.look(given) or ' ').startswith(expected or ' ')
        foreign = Faults('/other', 'recorder')
        assert not any(
            foreign.look({f'anser/{name}': LastStatus(*one) for name, one in statuses.items()})
            for statuses in (before, now)
        )


def test_a_full_disk_ends_only_the_recording(start, source, small_disk):
    import rclpy

    lines = diagnostics(source)
    process = begin(start, source, small_disk)

    def fill():
        source.send(os.urandom(40_000).hex())  # that much noise can't be compressed away
        rclpy.spin_once(source, timeout_sec=0.01)

    stopped = 'recording stopped: No space left on device'
    assert wait(lambda: (2, stopped) in [line[:2] for line in lines.values()], fill), lines
    assert process.popen.poll() is None
    answer = call(source, '/anser/recorder/stop')
    assert not answer.success
    assert process.interrupt() == 0
    assert 'Traceback' not in process.output
    salvage = Salvage()
    messages = list(iter_messages(small_disk / 'bag', salvage))
    assert len(messages) > 10
    assert not salvage.lost


@pytest.fixture
def small_disk(tmp_path):
    """A disk of 3 MB."""
    folder = tmp_path / 'disk'
    folder.mkdir()
    command = ['mount', '-t', 'tmpfs', '-o', 'size=3m', 'tmpfs', str(folder)]
    mounted = subprocess.run(command, capture_output=True, text=True, check=False)
    if mounted.returncode:
        pytest.skip(f'no small disk can be mounted here: {mounted.stderr.strip()}')
    yield folder
    subprocess.run(['umount', '-l', str(folder)], check=False)


class TestLog:
    def test_counts_what_a_single_publisher_numbered(self):
        log = TopicLog()
        for sequence in (1, 2, 5, 6, 1, 2):  # started again after the sixth
            log.add(sequence, None)
        assert log.lost == 2
        log = TopicLog(n_publishers=2)
        for sequence in (1, 10, 2, 11):
            log.add(sequence, None)
        assert log.lost == 0

    def test_finds_gaps_by_the_usual_period(self, tmp_path):
        log = TopicLog()
        stamps = [n * 20_000_000 for n in range(100) if n not in (5, 60, 61)] + [1]
        for stamp_ns in stamps:
            log.add(None, stamp_ns)
        assert (log.gaps, log.jumps_back) == (2, 1)
        assert log.longest_gap_s == pytest.approx(0.06)
        record = BagRecord({}, 98, 0, 2 * 10**9)
        text, details = report(tmp_path, record, {'/a': log, '/b': TopicLog(), '/c': log})
        assert text == (
            f'{tmp_path}: 98 messages of 0 topics in 2.0 s; '
            '2 topics with gaps, 2 that jump back in time (named in the log)'
        )
        assert details == tuple(
            f'{name} 2 gaps up to 0.06 s, 1 jumps back in time' for name in ('/a', '/c')
        )


class TestDefinitions:
    def test_unknown_types_are_refused(self):
        for name in ('no_msgs/msg/None', 'std_msgs/msg/Nothing', 'String'):
            with pytest.raises(BagError):
                message_class(name)
            with pytest.raises(BagError):
                definition(name)

    def test_the_embedded_texts_agree_with_the_installed_ones(self):
        """Comments aside, and in any order."""

        def essence(text):
            lines = (line.split('#')[0].split() for line in text.splitlines())
            lines = [line for line in lines if line and '=' not in ''.join(line)]
            sections, current = {}, ()
            for line in lines:
                if line[0] == 'MSG:':
                    current = tuple(line)
                else:
                    # Default values (a quaternion's w of 1) don't change the layout.
                    sections.setdefault(current, []).append(tuple(line[:2]))
            return sections

        for type_name, text in DEFINITIONS.items():
            if find_spec(type_name.split('/')[0]):  # not every installation has tf2_msgs
                assert essence(text) == essence(definition(type_name))
