"""Writes MCAP bags that survive a crash and a full disk, with or without ROS.

Whatever happens, the data up to the last flush stay readable: a flush hands all messages to the
system as a small chunk behind the file, and a write that fails is taken back. After some seconds
one large chunk takes the place of the small ones, so that the index, which is in memory until the
end, stays small. So that even a full disk leaves a bag with an index, a file without a name keeps
the space for it.
"""

import contextlib
import io
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO, Self

import numpy as np
import yaml
from mcap.well_known import Profile, SchemaEncoding
from mcap.writer import Writer

from anser_ros.arrays import ComplexArray
from anser_ros.errors import BagError
from anser_ros.wire import cdr
from anser_ros.wire.points import STALE, FluxPoints, PointFieldTuple, encode_flux
from anser_ros.wire.recorded import FLUX_TYPE, POSE_TYPE, SETUP_TYPE
from anser_ros.wire.setup import FIELD_GENERATOR, SensorRows, SensorSpec
from anser_ros.wire.text_files import DUMPER, read_yaml

METADATA_VERSION = 9
"""Version of rosbag2's metadata.yaml that is written, as ROS 2 Jazzy reads it."""
# What rosbag2 calls "for ever".
FOREVER = {'sec': 9223372036, 'nsec': 854775807}


def qos_profile(*, reliable: bool = True, latched: bool = False, depth: int = 1) -> dict[str, Any]:
    """Return an offered quality of service as rosbag2 (version 9) writes it."""
    return {
        'history': 'keep_last',
        'depth': depth,
        'reliability': 'reliable' if reliable else 'best_effort',
        'durability': 'transient_local' if latched else 'volatile',
        'deadline': FOREVER,
        'lifespan': FOREVER,
        'liveliness': 'automatic',
        'liveliness_lease_duration': FOREVER,
        'avoid_ros_namespace_conventions': False,
    }


@dataclass
class TopicRecord:
    """Records a topic of a bag and how much of it was written."""

    name: str
    type_name: str
    type_hash: str
    qos: Sequence[Mapping[str, Any]]
    messages: int = 0


@dataclass
class BagRecord:
    """Records what a bag holds so far; times are log times in ns."""

    topics: dict[int, TopicRecord] = field(default_factory=dict)
    messages: int = 0
    first_ns: int = 0
    last_ns: int = 0

    @property
    def duration_s(self) -> float:
        """Return the time between the first and the last message, s."""
        return (self.last_ns - self.first_ns) * 1e-9


def together(records: list[BagRecord]) -> BagRecord:
    """Return what the files of a bag hold together."""
    topics: dict[str, TopicRecord] = {}
    for topic in (topic for record in records for topic in record.topics.values()):
        before = topics.get(topic.name)
        topics[topic.name] = replace(
            topic, messages=topic.messages + (0 if before is None else before.messages)
        )
    full = [record for record in records if record.messages] or records[:1]
    return BagRecord(
        dict(enumerate(topics.values())),
        sum(record.messages for record in records),
        min(record.first_ns for record in full),
        max(record.last_ns for record in full),
    )


def _times(record: BagRecord) -> dict[str, Any]:
    return {
        'duration': {'nanoseconds': record.last_ns - record.first_ns},
        'starting_time': {'nanoseconds_since_epoch': record.first_ns},
        'message_count': record.messages,
    }


def write_metadata(
    folder: Path, files: Mapping[str, BagRecord], ros_distro: str, is_closed: bool = True
) -> None:
    """Write ``metadata.yaml`` of a folder with MCAP files, the last of which may not be closed."""
    record = together(list(files.values()))
    document = {
        'rosbag2_bagfile_information': {
            'version': METADATA_VERSION,
            'storage_identifier': 'mcap',
            **_times(record),
            'topics_with_message_count': [_topic(topic) for topic in record.topics.values()],
            'compression_format': '',
            'compression_mode': '',
            'relative_file_paths': list(files),
            'files': [{'path': name, **_times(record)} for name, record in files.items()],
            'custom_data': {'closed': 'true' if is_closed else 'false'},
            'ros_distro': ros_distro,
        }
    }
    draft = folder / '.metadata.yaml.new'
    try:
        draft.write_text(plain_yaml(document), encoding='utf-8')
        draft.replace(folder / 'metadata.yaml')
    finally:
        draft.unlink(missing_ok=True)


def bag_summary(folder: Path) -> dict[str, Any]:
    """Return ``duration_s``, ``messages``, ``closed`` of a bag's ``metadata.yaml``; or {}."""
    try:
        document = read_yaml((folder / 'metadata.yaml').read_text('utf-8'))
        info = document['rosbag2_bagfile_information']
        return {
            'duration_s': 1e-9 * float(info['duration']['nanoseconds']),
            'messages': int(info['message_count']),
            'closed': info['custom_data']['closed'] == 'true',
        }
    except (OSError, yaml.YAMLError, LookupError, TypeError, ValueError):
        return {}


def plain_yaml(document: Any) -> str:
    """Return a document as YAML without anchors, which not every reader follows."""
    return yaml.dump(document, Dumper=_Dumper, sort_keys=False)


class _Dumper(DUMPER):  # type: ignore[misc]
    def ignore_aliases(self, data: Any) -> bool:
        return True


def _topic(topic: TopicRecord) -> dict[str, Any]:
    return {
        'topic_metadata': {
            'name': topic.name,
            'type': topic.type_name,
            'serialization_format': 'cdr',
            'offered_qos_profiles': [dict(profile) for profile in topic.qos],
            'type_description_hash': topic.type_hash,
        },
        'message_count': topic.messages,
    }


CHUNK_BYTES = 256 * 1024
"""Size of a chunk, bytes: what a bag loses at most that is cut off."""
FLUSHED_CHUNK_BYTES = 8 * 1024 * 1024
"""The same where messages are flushed: more than `CHUNK_NS` of them take while metal moves (1.3
MB/s). With smaller chunks the index in memory grows by 35 MB an hour."""
CHUNK_NS = 6_000_000_000
"""Longest time in a chunk while messages are flushed, ns. The index of an hour takes 1.1 MB of
memory with twelve topics and 2.7 with forty."""
RESERVE_BYTES = 1024 * 1024
"""Disk space that is reserved at the start, bytes, for the end of a recording on a full disk."""


class _Segments:
    """The stream under the MCAP writer: whole segments, and drafts behind them until the next."""

    def __init__(self, raw: BinaryIO) -> None:
        self._raw = raw
        self._waiting = bytearray()
        self._drafts = bytearray()
        self._written = 0

    def write(self, data: bytes) -> int:
        self._waiting += data
        return len(data)

    def tell(self) -> int:
        return self._written + len(self._waiting)

    @property
    def is_waiting(self) -> bool:
        return bool(self._waiting)

    def flush(self) -> None:
        """Write all that waits; when that fails, the file is as before and all of it waits."""
        self._put(self._written, bytes(self._waiting))
        self._written += len(self._waiting)
        self._waiting.clear()
        self._drafts.clear()

    def add_draft(self, data: bytes) -> None:
        """Write something for the time until the next segment."""
        self._put(self._written + len(self._drafts), data)
        self._drafts += data

    def _put(self, place: int, data: bytes | bytearray) -> None:
        """Write the end of the file; when that fails, the drafts are its end again."""
        try:
            self._overwrite(place, data)
        except OSError:
            with contextlib.suppress(OSError):
                self._overwrite(self._written, self._drafts)
            raise

    def _overwrite(self, place: int, data: bytes | bytearray) -> None:
        self._raw.seek(place)
        view = memoryview(data)
        while view:
            view = view[self._raw.write(view) :]
        self._raw.truncate()


class BagWriter:
    """Writes messages into one MCAP file, which is closed at the end of a ``with`` block.

    The file must not exist yet; its folder is made. An unbuffered binary stream may be given to be
    written to instead. A block that fails leaves no file, as half of one would be taken for a
    whole session. Raises `BagError`: the file exists already, or cannot be made.
    """

    def __init__(
        self, path: str | Path, raw: BinaryIO | None = None, chunk_bytes: int = CHUNK_BYTES
    ) -> None:
        self.path = Path(path)
        self.record = BagRecord()
        self._reserve: int | None = None
        self._is_made = raw is None
        try:
            if raw is None:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                raw = open(self.path, 'xb', buffering=0)  # type: ignore[assignment]  # noqa: SIM115
                self._reserve = self._keep_space(raw)
        except FileExistsError as error:
            raise BagError(f'{self.path}: already exists') from error
        except OSError as error:
            raise BagError(f'{self.path}: {error.strerror}') from error
        assert raw is not None
        self._raw = raw
        self._segments = _Segments(raw)
        self._writer = Writer(self._segments, chunk_bytes)  # type: ignore[arg-type]
        # What came since the last flush; None where the file lacks a topic of it.
        self._draft: Writer | None = None
        self._draft_bytes = io.BytesIO()
        self._flushed = 0
        self._chunk_began_ns = 0
        self._schemas: dict[str, int] = {}
        self._writer.start(profile=Profile.ROS2, library='anser_ros')
        self._segments.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            self.close()
        finally:
            if kind is not None and self._is_made:
                self.path.unlink(missing_ok=True)

    @property
    def is_open(self) -> bool:
        """Return whether messages can still be written."""
        return not self._raw.closed

    def add_topic(
        self,
        name: str,
        type_name: str,
        definition: str,
        qos: Sequence[Mapping[str, Any]] = (),
        type_hash: str = '',
    ) -> int:
        """Announce a topic by its absolute name and return its channel.

        The definition of its type is followed by those of all types in it; ``qos`` is what its
        publishers offer (:func:`qos_profile`), the hash that of REP 2011 where it is known.
        """
        if type_name not in self._schemas:
            self._schemas[type_name] = self._writer.register_schema(
                type_name, SchemaEncoding.ROS2, definition.encode()
            )
        profiles = plain_yaml([dict(profile) for profile in qos])
        metadata = {'offered_qos_profiles': profiles, 'topic_type_hash': type_hash}
        channel: int = self._writer.register_channel(
            name, 'cdr', self._schemas[type_name], metadata
        )
        self.record.topics[channel] = TopicRecord(name, type_name, type_hash, tuple(qos))
        self._draft = None
        return channel

    def write(
        self, channel: int, log_time_ns: int, data: bytes, publish_time_ns: int | None = None
    ) -> None:
        """Add a message to the running chunk; nothing reaches the disk before :meth:`flush`."""
        published_ns = log_time_ns if publish_time_ns is None else publish_time_ns
        self._writer.add_message(channel, log_time_ns, data, published_ns)
        if self._draft is not None:
            self._draft.add_message(channel, log_time_ns, data, published_ns)
        record = self.record
        record.first_ns = min(record.first_ns, log_time_ns) if record.messages else log_time_ns
        record.last_ns = max(record.last_ns, log_time_ns)
        record.messages += 1
        record.topics[channel].messages += 1

    def flush(self) -> None:
        """Hand all messages to the system; raises OSError on a full disk."""
        record = self.record
        if record.messages == self._flushed:
            return
        draft, self._draft = self._draft, None
        is_long = record.last_ns - self._chunk_began_ns >= CHUNK_NS
        if draft is None or is_long or self._segments.is_waiting:
            self._writer.flush()
            self._chunk_began_ns = record.last_ns
        else:
            draft.flush()
            self._segments.add_draft(self._draft_bytes.getvalue())
        self._flushed = record.messages
        self._draft_bytes = io.BytesIO()
        self._draft = Writer(self._draft_bytes, CHUNK_BYTES)

    def close(self) -> None:
        """Write the index and close; raises OSError when the reserved space does not suffice.

        Also the way out after a :meth:`flush` that failed. The file holds whole chunks only,
        with the index where there was room for it.
        """
        if not self.is_open:
            return
        if self._reserve is not None:
            os.close(self._reserve)
            self._reserve = None
        try:
            self._writer.finish()
            self._segments.flush()
        finally:
            self._raw.close()

    def _keep_space(self, raw: BinaryIO) -> int:
        """Return the descriptor of a file without a name that keeps the last space free."""
        name = self.path.with_name(f'.{self.path.name}.reserve')
        descriptor = os.open(name, os.O_CREAT | os.O_WRONLY, 0o600)
        name.unlink()
        try:
            os.posix_fallocate(descriptor, 0, RESERVE_BYTES)
        except OSError:
            os.close(descriptor)
            raw.close()
            self.path.unlink()
            raise
        return descriptor


FLUX_TOPICS = {'/anser/tool/flux': False, '/anser/reference/flux': True}
"""Topics of a session's fluxes, and whether their sensors are fixed to the field generator."""


class SessionWriter(BagWriter):
    """Writes a session without ROS: setup, fluxes and poses of one frame, log time = stamp."""

    def __init__(self, path: str | Path, frame_id: str = 'fg') -> None:
        super().__init__(path)
        self._frame_id = frame_id
        self._channels: dict[str, int] = {}

    def write_setup(self, text: str, stamp_ns: int) -> None:
        """Write the setup document."""
        channel = self.channel('/anser/setup', SETUP_TYPE)
        self.write(channel, stamp_ns, cdr.string_bytes(text))

    def write_readings(
        self, sensors: Sequence[SensorSpec], stamp_ns: int, flux: ComplexArray
    ) -> None:
        """Write one window, stamped with its middle: a message of tools, and one of references.

        Fluxes are (S, K), T, of the S sensors that are given: NaN where there is no reading, and
        for emitters without current.
        """
        for topic, fixed in FLUX_TOPICS.items():
            rows = [i for i, s in enumerate(sensors) if (s.body == FIELD_GENERATOR) == fixed]
            if rows:
                points = _points([sensors[i] for i in rows], flux[rows])
                fields, step, data = encode_flux(points)
                self.write_flux(topic, stamp_ns, fields, step, len(rows), data)

    def write_flux(
        self,
        topic: str,
        stamp_ns: int,
        fields: Sequence[PointFieldTuple],
        point_step: int,
        width: int,
        data: bytes,
    ) -> None:
        """Write one window's cloud, as `anser_ros.wire.points.encode_flux` packs it."""
        channel = self.channel(topic, FLUX_TYPE)
        frame = self._frame_id
        message = cdr.cloud_bytes(stamp_ns, frame, fields, point_step, width, data)
        self.write(channel, stamp_ns, message)

    def write_pose(
        self,
        topic: str,
        stamp_ns: int,
        position: Sequence[float],
        quaternion_xyzw: Sequence[float],
    ) -> None:
        """Write one pose: position in m, unit quaternion."""
        channel = self.channel(topic, POSE_TYPE)
        message = cdr.pose_bytes(stamp_ns, self._frame_id, position, quaternion_xyzw)
        self.write(channel, stamp_ns, message)

    def channel(self, topic: str, type_name: str, definition: str = '') -> int:
        """Return the channel of a topic, announced when it is first asked for; a setup is latched.

        The types of a session need no definition.
        """
        if topic not in self._channels:
            latched = topic.endswith('/setup')
            qos = [qos_profile(latched=latched, depth=1 if latched else 100)]
            text = cdr.DEFINITIONS.get(type_name, definition)
            self._channels[topic] = self.add_topic(topic, type_name, text, qos)
        return self._channels[topic]


def _points(sensors: Sequence[SensorSpec], flux: ComplexArray) -> FluxPoints:
    """One window's cloud; a sensor lacks its reading where it has none of a driven emitter."""
    known, rows = np.isfinite(flux), SensorRows.of(sensors, fixed_only=True)
    lacks = (known != known.any(axis=0)).any(axis=1) | ~known.any()
    return FluxPoints(rows.channel, np.where(lacks, STALE, 0), flux, rows.position, rows.axis)
