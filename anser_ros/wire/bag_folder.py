"""Writes bags as folders, split and with latched topics repeated, and keeps the last minute.

Names are those of rosbag2: `max_bagfile_size`, `max_bagfile_duration`, `max_cache_size`, snapshot.
"""

import shutil
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from anser_ros.stamps import SECOND_NS
from anser_ros.wire.bag_writer import (
    FLUSHED_CHUNK_BYTES,
    BagRecord,
    BagWriter,
    together,
    write_metadata,
)

SNAPSHOT = 'snapshot_'
"""How the names of folders with a snapshot begin; date and time follow."""
# Each publisher of this latched type says something else, so that many are kept.
MANY_LATCHED = {'tf2_msgs/msg/TFMessage': 100}


class Topic(NamedTuple):
    """Describes a topic as `BagWriter.add_topic` takes it."""

    name: str
    type_name: str
    definition: str
    qos: list[dict[str, Any]]
    type_hash: str

    @property
    def is_latched(self) -> bool:
        return any(profile['durability'] == 'transient_local' for profile in self.qos)


class Message(NamedTuple):
    """Holds one message as it came; times are ns, of its arrival and of its publication."""

    topic: Topic
    log_time_ns: int
    data: bytes
    publish_time_ns: int | None


class Latched:
    """Keeps what latched topics said last."""

    def __init__(self) -> None:
        self._last: dict[str, deque[Message]] = {}

    def add(self, message: Message) -> None:
        """Take a message of any topic."""
        topic = message.topic
        if topic.is_latched:
            most = MANY_LATCHED.get(topic.type_name, 1)
            kept = self._last.setdefault(topic.name, deque(maxlen=most))
            if all(one.data != message.data for one in kept):
                kept.append(message)

    def at(self, log_time_ns: int) -> Iterator[Message]:
        """Return what is kept, as if it came at a time."""
        for kept in self._last.values():
            yield from (one._replace(log_time_ns=log_time_ns) for one in kept)


class Ring:
    """Keeps the messages of the last seconds, within a number of bytes."""

    def __init__(self, duration_s: float, max_bytes: int) -> None:
        self._duration_ns, self._max_bytes = round(duration_s * SECOND_NS), max_bytes
        self._messages: deque[Message] = deque()
        self.bytes = 0  # of all messages
        self._before = Latched()  # of what has left the ring

    def add(self, message: Message) -> None:
        """Take the newest message, and forget the oldest."""
        self._messages.append(message)
        self.bytes += len(message.data)
        begin_ns = message.log_time_ns - self._duration_ns
        while self._messages and (
            self.bytes > self._max_bytes or self._messages[0].log_time_ns <= begin_ns
        ):
            self._forget()

    def take(self, now_ns: int) -> list[Message]:
        """Return all messages, with the latched ones from before them, and begin anew."""
        kept = list(self._messages)
        found = [*self._before.at(kept[0].log_time_ns if kept else now_ns), *kept]
        while self._messages:
            self._forget()
        return found

    def latched(self, log_time_ns: int) -> list[Message]:
        """Return what latched topics said last, as if it came at a time."""
        last = Latched()
        for message in (*self._before.at(log_time_ns), *self._messages):
            last.add(message)
        return list(last.at(log_time_ns))

    def _forget(self) -> None:
        message = self._messages.popleft()
        self.bytes -= len(message.data)
        self._before.add(message)


class BagFolder:
    """Writes one bag: a folder with files NAME_0.mcap, NAME_1.mcap and their ``metadata.yaml``.

    A file with so many bytes or seconds, if that is not 0, is followed by another. Each begins
    with what latched topics said last, so that it can be read alone. Raises `BagError`: a file
    cannot be made; OSError: it cannot be written.
    """

    def __init__(
        self, path: Path, ros_distro: str, max_bytes: int = 0, max_duration_s: float = 0.0
    ) -> None:
        self.path, self._distro = path, ros_distro
        self._max_bytes, self._max_duration_s = max_bytes, max_duration_s
        self._files: dict[str, BagRecord] = {}
        self._topics: list[Topic] = []
        self._channels: dict[str, int] = {}
        self._latched = Latched()
        self._open()

    def _open(self) -> None:
        name = f'{self.path.name}_{len(self._files)}.mcap'
        self._bag = BagWriter(self.path / name, chunk_bytes=FLUSHED_CHUNK_BYTES)
        self._files[name] = self._bag.record
        for topic in self._topics:
            self._channels[topic.name] = self._bag.add_topic(*topic)

    @property
    def record(self) -> BagRecord:
        """Return what all files hold together."""
        return together(list(self._files.values()))

    def add_topic(self, topic: Topic) -> None:
        """Announce a topic."""
        self._topics.append(topic)
        self._channels[topic.name] = self._bag.add_topic(*topic)

    def write(self, message: Message) -> None:
        """Add a message of a topic that was announced."""
        topic, log_time_ns, data, publish_time_ns = message
        self._latched.add(message)
        self._bag.write(self._channels[topic.name], log_time_ns, data, publish_time_ns)

    def flush(self) -> None:
        """Hand all messages to the system, and go on in a new file where this one is full."""
        self._bag.flush()
        record = self._bag.record
        is_long = 0 < self._max_duration_s <= record.duration_s
        if is_long or 0 < self._max_bytes <= self._bag.path.stat().st_size:
            self._bag.close()
            self._open()
            for message in list(self._latched.at(record.last_ns)):
                self.write(message)

    def describe(self, is_closed: bool = False) -> None:
        """Write ``metadata.yaml`` of what the bag holds so far."""
        write_metadata(self.path, self._files, self._distro, is_closed)

    def close(self) -> None:
        """Close the last file and describe the bag."""
        self._bag.close()
        self.describe(is_closed=True)


def make_room(directory: Path, most_bytes: int) -> list[Path]:
    """Remove the oldest snapshots of a folder until the rest have at most so many bytes.

    Returns the folders that were removed.
    """
    folders = sorted(directory.glob(f'{SNAPSHOT}[0-9]*_[0-9]*/'), reverse=True)
    removed, total = [], 0
    for folder in folders:
        total += sum(file.stat().st_size for file in folder.glob('*.mcap'))
        if total > most_bytes:
            shutil.rmtree(folder)
            removed.append(folder)
    return removed
