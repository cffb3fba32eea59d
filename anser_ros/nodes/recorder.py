"""Records the topics into an MCAP bag that a crash or a full disk can't spoil.

The steps: definitions of types are looked up, a log of what was lost is kept for each topic, and
the node subscribes to topics as they appear.
"""

import importlib
import math
import os
import statistics
import struct
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from std_srvs.srv import Trigger

from anser_ros.errors import AnserError, BagError
from anser_ros.nodes.runtime.diagnostics import LastStatus, statuses_in
from anser_ros.nodes.runtime.node import AnserNode, Level, Status
from anser_ros.nodes.runtime.parameters import optical_parameter, parameter, tracked_parameter
from anser_ros.nodes.runtime.process import main
from anser_ros.pose_states import FRAMES_IN, OK
from anser_ros.stamps import SECOND_NS
from anser_ros.wire.bag_folder import SNAPSHOT, BagFolder, Message, Ring, Topic, make_room
from anser_ros.wire.bag_writer import BagRecord, qos_profile

# What rosbag2 and mcap put between the definitions of a message and of its parts.
SEPARATOR = '=' * 80


def message_class(type_name: str) -> type:
    """Return the class of a type such as ``std_msgs/msg/String``.

    Raises `BagError` where it is not installed.
    """
    package, kind, name = _split(type_name)
    try:
        found: type = getattr(importlib.import_module(f'{package}.{kind}'), name)
    except (ImportError, AttributeError) as error:
        raise BagError(f'type {type_name} is not installed') from error
    return found


def definition(type_name: str) -> str:
    """Return the text of a type followed by those of all types in it, as rosbag2 stores them.

    Raises `BagError` where a definition is not installed.
    """
    parts: list[str] = []
    names = [type_name]
    for current in names:  # which grows meanwhile
        package, _, name = _split(current)
        title = f'{SEPARATOR}\nMSG: {package}/{name}\n' if parts else ''
        parts.append(title + _file(current).read_text(encoding='utf-8'))
        names += [one for one in _contained(message_class(current)) if one not in names]
    return '\n'.join(parts)


def _split(type_name: str) -> tuple[str, str, str]:
    tokens = type_name.split('/')
    if len(tokens) != 3 or not all(tokens):
        raise BagError(f'{type_name!r} is not a message type')
    return tokens[0], tokens[1], tokens[2]


def _file(type_name: str) -> Path:
    package, kind, name = _split(type_name)
    prefixes = os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)
    for prefix in [*filter(None, prefixes), sys.prefix]:
        path = Path(prefix, 'share', package, kind, f'{name}.msg')
        if path.is_file():
            return path
    raise BagError(f'no definition of {type_name} is installed')


def _contained(message: Any) -> list[str]:
    """Return the full names of the types of a message's fields, each once."""
    parts = [getattr(kind, 'value_type', kind) for kind in message.SLOT_TYPES]  # of sequences
    names = ['/'.join(p.namespaced_name()) for p in parts if hasattr(p, 'namespaced_name')]
    return list(dict.fromkeys(names))


# Intervals from which a topic's own period is learnt.
LEARNING = 25
# An interval of more than so many usual ones is a gap: less than the two of one lost message.
GAP_FACTOR = 1.5


@dataclass
class TopicLog:
    """Records what arrived of one topic."""

    n_publishers: int = 1  # how many nodes publish it
    # messages that the publisher numbered and that never came; known while there is only one
    lost: int = 0
    gaps: int = 0  # intervals between stamps longer than one and a half of the topic's usual ones
    longest_gap_s: float = 0.0
    jumps_back: int = 0  # stamps that lie before the one that came before them
    _sequence: int | None = None
    _stamp_ns: int | None = None
    _intervals_s: list[float] = field(default_factory=list)
    _period_s: float = 0.0

    @property
    def faults(self) -> str:
        """Return what is wrong with the topic, in words; empty when nothing is."""
        gaps = f'{self.gaps} gaps up to {self.longest_gap_s:.3g} s'
        found = [f'{self.lost} lost', gaps, f'{self.jumps_back} jumps back in time']
        return ', '.join(words for words in found if not words.startswith('0 '))

    def add(self, sequence: int | None, stamp_ns: int | None) -> None:
        """Note one message by its publisher's number and its stamp, where it has them."""
        if sequence is not None and self.n_publishers == 1:
            # A smaller number is a publisher that was started again.
            if self._sequence is not None and sequence > self._sequence + 1:
                self.lost += sequence - self._sequence - 1
            self._sequence = sequence
        if stamp_ns is not None:
            if self._stamp_ns is not None:
                self._add_interval((stamp_ns - self._stamp_ns) * 1e-9)
            self._stamp_ns = stamp_ns

    def _add_interval(self, interval_s: float) -> None:
        if interval_s < 0.0:
            self.jumps_back += 1
            return
        self._intervals_s.append(interval_s)
        if not self._period_s:
            if len(self._intervals_s) < LEARNING:
                return
            self._period_s = statistics.median(self._intervals_s)
        gaps = [s for s in self._intervals_s if s > GAP_FACTOR * self._period_s]
        self.gaps += len(gaps)
        self.longest_gap_s = max(self.longest_gap_s, *gaps, 0.0)
        self._intervals_s.clear()


def report(
    folder: Path, record: BagRecord, logs: Mapping[str, TopicLog]
) -> tuple[str, tuple[str, ...]]:
    """Return the counts of a bag in one short line, and a line for each topic with faults."""
    text = (
        f'{folder}: {record.messages} messages of {len(record.topics)} topics '
        f'in {record.duration_s:.1f} s'
    )
    faulty = {name: log for name, log in sorted(logs.items()) if log.faults}
    if not faulty:
        return f'{text}; no gaps', ()
    found = [
        f'{sum(log.lost for log in faulty.values())} messages lost',
        f'{sum(log.gaps > 0 for log in faulty.values())} topics with gaps',
        f'{sum(log.jumps_back > 0 for log in faulty.values())} that jump back in time',
    ]
    words = ', '.join(word for word in found if not word.startswith('0 '))
    faults = tuple(f'{name} {log.faults}' for name, log in faulty.items())
    return f'{text}; {words} (named in the log)', faults


SENDERS = 'acquisition', 'replay'
"""Nodes that send fluxes: what others lack after their end is no fault."""


class Faults:
    """Finds what has gone wrong between two messages of ``/diagnostics`` of one namespace."""

    def __init__(self, namespace: str, own: str) -> None:
        self._begin = f'{namespace}/'.lstrip('/')
        self._own = self._begin + own  # what the recorder says of itself is no fault
        self._last: dict[str, LastStatus] = {}

    def look(self, statuses: Mapping[str, LastStatus]) -> str:
        """Return the first fault in words; empty for none.

        It is a fault when a node or a part that was fine is so no more, when a pose was withheld
        meanwhile, and when a node finds something new; nothing is where the senders of fluxes have
        ended, as they do when asked to.
        """
        faults = [
            f'{name}: {"poses were withheld" if now.level == Level.OK else now.message}'
            for name, now in statuses.items()
            if name.startswith(self._begin) and name != self._own and self._is_new(name, now)
        ]
        self._last.update(statuses)
        senders = [self._last.get(f'{self._begin}{name}') for name in SENDERS]
        is_over = {one.message for one in senders if one is not None} == {'ended'}
        return faults[0] if faults and not is_over else ''

    def _is_new(self, name: str, now: LastStatus) -> bool:
        before = self._last.get(name)
        if now.message == 'ended':
            return False
        if before is None:  # a node that starts lacks much
            return now.level in (Level.WARN, Level.ERROR) and name.partition(': ')[0] in self._last
        was_fine = before.level == Level.OK
        return was_fine and (now.level != Level.OK or _withheld(now) > _withheld(before))


def _withheld(status: LastStatus) -> int:
    """Return in how many frames a pose was withheld."""
    counts = {key: value for key, value in status.values.items() if key.startswith(FRAMES_IN)}
    return sum(int(value) for key, value in counts.items() if key != f'{FRAMES_IN}{OK}')


# How often new topics are looked for, s: what they say before they are found is lost.
DISCOVERY_PERIOD_S = 0.25
# How old metadata.yaml may be when the process is killed.
METADATA_PERIOD_S = 2.0
# Deep enough for a pause of seconds on a slow disk.
DEPTH = 2000
ROS_DISTRO = os.environ.get('ROS_DISTRO', 'jazzy')
COMMON_TOPICS = ('/diagnostics', '/tf', '/tf_static')
STAMPED = (
    'sensor_msgs/msg/PointCloud2',
    'geometry_msgs/msg/PoseStamped',
    'geometry_msgs/msg/PoseWithCovarianceStamped',
)


FROM_0 = 0, math.inf  # bounds of what has no upper one


@dataclass(frozen=True)
class RecorderParameters:
    directory: str = parameter('recordings', 'folder that gets one folder per bag')
    name: str = parameter(
        '', "name of the bag's folder, with _1, _2 appended if it exists; empty: date and time"
    )
    autostart: bool = parameter(True, 'record from the start on')
    flush_period_s: float = parameter(
        0.25, 'longest time that a crash may lose, s', within=(0.05, 1.0)
    )
    optical: str = optical_parameter()
    tracked: str = tracked_parameter()
    topics: tuple[str, ...] = parameter((), 'topics to record besides those of docs/interfaces.md')
    without: tuple[str, ...] = parameter(
        ('field_model_error',),
        'last parts of names of topics that are not recorded; the default takes 100 kB each '
        'time that metal moves, and evaluate computes it from the fluxes',
    )
    max_bagfile_size: int = parameter(0, 'size of a file of a bag, bytes; 0: any', within=FROM_0)
    max_bagfile_duration: float = parameter(
        0.0, 'duration of a file of a bag, s; 0: any', within=FROM_0
    )
    snapshot_duration: float = parameter(
        60.0, 'seconds before a fault in a snapshot; 0: no snapshots', within=FROM_0
    )
    snapshot_duration_after: float = parameter(5.0, 'seconds after a fault in it', within=FROM_0)
    max_cache_size: int = parameter(
        100 * 2**20, 'most memory for the seconds before a fault, bytes', within=FROM_0
    )
    max_total_storage_mb: float = parameter(
        500.0, 'most disk for snapshots, MB: the oldest are removed', within=FROM_0
    )


class Recorder(AnserNode):
    """Subscribes to the topics of docs/interfaces.md as they appear and writes their raw bytes."""

    NAME = 'recorder'
    EXAMPLE = '--ros-args -p directory:=recordings -p name:=scan'
    PARAMETERS = RecorderParameters
    PAUSE_S = 0.05  # the middleware notes when each message came, and the poses' readers wait less

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._bag: BagFolder | None = None
        self._snapshot: BagFolder | None = None  # being written
        self._snapshot_ends_s = 0.0
        self._ring = Ring(self.parameters.snapshot_duration, self.parameters.max_cache_size)
        self._faults = Faults(self.get_namespace(), self.NAME)
        self._topics: dict[str, Topic] = {}
        self._logs: dict[str, TopicLog] = {}
        self._topic_subscriptions: dict[str, Any] = {}
        self._subscribe: dict[str, partial[Any]] = {}  # makes a subscription to a topic
        self._counts: dict[str, int] = {}  # publishers of a topic now
        self._error = self._last_report = ''
        self._described_s = 0.0
        self.create_service(Trigger, 'recorder/start', self._on_start)
        self.create_service(Trigger, 'recorder/stop', self._on_stop)
        self.create_service(Trigger, 'recorder/snapshot', self._on_snapshot)
        clock = self.steady_clock
        self.create_timer(DISCOVERY_PERIOD_S, self._discover, clock=clock)
        self.create_timer(self.parameters.flush_period_s, self._flush, clock=clock)
        if self.parameters.autostart:
            self.start()

    def status(self) -> Status:
        if self._bag is None:
            if self._error:
                return Status('', Level.ERROR, f'recording stopped: {self._error}')
            return Status('', Level.OK, 'not recording', {'last': self._last_report})
        record = self._bag.record
        values = {
            'bag': str(self._bag.path),
            'messages': record.messages,
            'topics': len(record.topics),
            'duration_s': record.duration_s,
            'lost_messages': sum(log.lost for log in self._logs.values()),
        }
        return Status('', Level.OK, 'recording', values)

    def start(self) -> Path:
        """Begin a bag and return its folder.

        Raises `BagError`: the bag cannot be made.
        """
        folder = self._new_folder(self.parameters.name or time.strftime('anser_%Y%m%d_%H%M%S'))
        table, self._error = self.parameters, ''
        self._bag = BagFolder(
            folder, ROS_DISTRO, table.max_bagfile_size, table.max_bagfile_duration
        )
        self._logs = {name: TopicLog(max(log.n_publishers, 1)) for name, log in self._logs.items()}
        self._fill(self._bag, self._ring.latched(time.time_ns()))
        self.get_logger().info(f'recording to {folder}')
        self._discover()
        return folder

    def stop_recording(self) -> str:
        """End the bag and return its counts in a line; the log has the gaps of each topic."""
        bag, self._bag = self._bag, None
        if bag is None:
            return 'not recording'
        try:
            bag.close()
        except OSError as error:
            self._error = self._error or _reason(error)
        self._last_report, faults = report(bag.path, bag.record, self._logs)
        self.get_logger().info('\n    '.join((self._last_report, *faults)))
        return self._last_report

    def snapshot(self, why: str) -> tuple[bool, str]:
        """Begin a bag of the last seconds, which those after now are added to.

        Returns whether there is one, and its folder or what hinders it; one that is being written
        is the answer too.
        """
        if self._snapshot is None:
            try:
                self._begin_snapshot(Path(self.parameters.directory).expanduser(), why)
            except (BagError, OSError) as error:
                self._end_snapshot()
                self.warn('snapshot_errors', _reason(error))
                return False, _reason(error)
        assert self._snapshot is not None
        return True, str(self._snapshot.path)

    def _begin_snapshot(self, directory: Path, why: str) -> None:
        most_mb = self.parameters.max_total_storage_mb
        # The new one has at most as much as the memory, as what is written is compressed.
        removed = make_room(directory, round(most_mb * 1e6) - self._ring.bytes)
        if removed:
            names = ', '.join(folder.name for folder in removed)
            self.get_logger().warning(f'more than {most_mb:g} MB of snapshots: {names} removed')
        folder = self._new_folder(time.strftime(f'{SNAPSHOT}%Y%m%d_%H%M%S'))
        self._snapshot = BagFolder(folder, ROS_DISTRO)
        self._fill(self._snapshot, self._ring.take(time.time_ns()))
        self._snapshot_ends_s = time.monotonic() + self.parameters.snapshot_duration_after
        self.count('snapshots')
        self.get_logger().warning(f'snapshot to {folder}: {why}')

    def _fill(self, bag: BagFolder, messages: list[Message]) -> None:
        for topic in self._topics.values():
            bag.add_topic(topic)
        for message in messages:
            bag.write(message)
        bag.flush()

    def _end_snapshot(self) -> None:
        bag, self._snapshot = self._snapshot, None
        if bag is not None:
            try:
                bag.close()
            except OSError as error:
                self.warn('snapshot_errors', f'{bag.path}: {_reason(error)}')

    def close(self) -> None:
        self.stop_recording()
        self._end_snapshot()

    # Callbacks ----------------------------------------------------------------------------

    def _on_start(self, _request: Any, response: Any) -> Any:
        response.success = self._bag is None
        response.message = str(self.start()) if self._bag is None else 'records already'
        return response

    def _on_stop(self, _request: Any, response: Any) -> Any:
        was_recording, words = self._bag is not None, self.stop_recording()
        response.success = was_recording and not self._error
        response.message = f'{self._error}; {words}' if self._error else words
        return response

    def _on_snapshot(self, _request: Any, response: Any) -> Any:
        response.success, response.message = self.snapshot('asked for')
        return response

    def _look(self, data: bytes) -> None:
        """Take a message of /diagnostics, and begin a snapshot on a fault."""
        fault = self._faults.look(statuses_in(deserialize_message(data, DiagnosticArray)))
        if fault and self.parameters.snapshot_duration:
            self.snapshot(fault)

    def _flush(self) -> None:
        if self._snapshot is not None and time.monotonic() >= self._snapshot_ends_s:
            self._end_snapshot()
        if self._bag is None:
            return
        try:
            self._bag.flush()
        except (BagError, OSError) as error:
            self._error = _reason(error)
            self.count('write_errors')
            self.get_logger().error(f'recording stopped: {self._error}')
            self.stop_recording()
            self.publish_diagnostics()
            return
        if time.monotonic() - self._described_s >= METADATA_PERIOD_S:
            self._describe(self._bag)

    def _describe(self, bag: BagFolder) -> None:
        """Write what the running bag holds so far, for whoever finds it after a crash."""
        self._described_s = time.monotonic()
        try:
            bag.describe()
        except OSError as error:  # the next flush will stop the recording
            self.warn('metadata_errors', _reason(error))

    def _discover(self) -> None:
        added = False
        for topic, type_names in self.get_topic_names_and_types():
            if topic in self._topic_subscriptions:
                log, count = self._logs[topic], self.count_publishers(topic)
                log.n_publishers = max(log.n_publishers, count)
                if self._counts.get(topic) != count:
                    self._counts[topic] = self._match(topic)
            elif self._wanted(topic) and len(type_names) == 1:
                added = self._add(topic, type_names[0]) or added
        if added and self._bag is not None:
            self._describe(self._bag)

    def _wanted(self, topic: str) -> bool:
        own = self.get_namespace().rstrip('/') + '/'
        if topic in self.parameters.topics:
            return True
        if topic.rsplit('/', 1)[-1] in self.parameters.without:
            return False
        others = (self.parameters.optical, self.parameters.tracked)
        folders = (own, *(name.rstrip('/') + '/' for name in others))
        return topic.startswith(folders) or topic in COMMON_TOPICS

    def _add(self, topic: str, type_name: str) -> bool:
        """Subscribe to one topic; return whether it is recorded from now on."""
        publishers = self.get_publishers_info_by_topic(topic)
        offered = [info.qos_profile for info in publishers]
        if not offered:
            return False  # only somebody who listens
        try:
            message, text = message_class(type_name), definition(type_name)
        except AnserError as error:
            self.warn('topics_without_definition', f'{topic}: {error}')
            self._logs[topic] = TopicLog()
            self._topic_subscriptions[topic] = None
            return False
        profiles = [
            qos_profile(
                reliable=profile.reliability == ReliabilityPolicy.RELIABLE,
                latched=profile.durability == DurabilityPolicy.TRANSIENT_LOCAL,
                depth=max(profile.depth, 1),  # the graph does not state the depth
            )
            for profile in offered
        ]
        type_hash = str(publishers[0].topic_type_hash)
        known_hash = type_hash if type_hash.startswith('RIHS') else ''
        described = Topic(topic, type_name, text, profiles, known_hash)
        self._topics[topic] = described
        for bag in filter(None, (self._bag, self._snapshot)):
            bag.add_topic(described)
        self._logs[topic] = TopicLog(len(offered))
        is_stamped = type_name in STAMPED

        def write(data: bytes, info: dict[str, int]) -> None:
            received_ns = info.get('received_timestamp') or time.time_ns()
            self._take(Message(described, received_ns, data, info.get('source_timestamp') or None))
            stamp_ns = _stamp_ns(data) if is_stamped else None
            self._logs[topic].add(info.get('publication_sequence_number'), stamp_ns)

        self._subscribe[topic] = partial(self.create_subscription, message, topic, write, raw=True)
        self._topic_subscriptions[topic] = self._subscribe[topic](qos_profile=_matching(offered))
        return True

    def _take(self, message: Message) -> None:
        """Put a message into the ring and into the bags that are open."""
        self._ring.add(message)
        for bag in filter(None, (self._bag, self._snapshot)):
            bag.write(message)
        if message.topic.name == '/diagnostics':
            self._look(message.data)

    def _match(self, topic: str) -> int:
        """Subscribe anew where a publisher has come that the subscription does not match; return
        how many publishers were asked: the graph may count one before it states what it offers.
        """
        known = self._topic_subscriptions[topic]
        offered = [info.qos_profile for info in self.get_publishers_info_by_topic(topic)]
        if known is not None and offered:
            wanted, had = _matching(offered), known.qos_profile  # what asks for more is less
            if wanted.reliability > had.reliability or wanted.durability > had.durability:
                self.destroy_subscription(known)
                self._topic_subscriptions[topic] = self._subscribe[topic](qos_profile=wanted)
        return len(offered)

    def _new_folder(self, name: str) -> Path:
        parent = Path(self.parameters.directory).expanduser()
        folder, number = parent / name, 0
        while folder.exists():
            number += 1
            folder = parent / f'{name}_{number}'
        return folder


def _matching(offered: list[QoSProfile]) -> QoSProfile:
    """Return a profile that matches all publishers and asks for all that they have."""
    latched = all(p.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in offered)
    reliable = all(p.reliability == ReliabilityPolicy.RELIABLE for p in offered)
    return QoSProfile(
        depth=DEPTH,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
    )


def _stamp_ns(data: bytes) -> int | None:
    if len(data) < 12:
        return None
    order = '<' if data[1] & 1 else '>'
    sec, nanosec = struct.unpack_from(f'{order}iI', data, 4)
    return int(sec) * SECOND_NS + int(nanosec)


def _reason(error: Exception) -> str:
    return getattr(error, 'strerror', None) or str(error) or type(error).__name__


if __name__ == '__main__':
    sys.exit(main(Recorder))
