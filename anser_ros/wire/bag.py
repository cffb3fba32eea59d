"""Reads MCAP bags without ROS: raw messages for replay, and whole sessions as arrays.

A bag that is complete is read through its index, in the order of its log times. A bag that was cut
(a crash, a full disk) has no index: it is read chunk by chunk as far as it goes, every complete
chunk is kept, and `Bag.lost` states in words what is lost.

Bags that other programs wrote may be in sqlite3, split, compressed by file or by message. What
rosbag2 describes in ``metadata.yaml`` is followed; a folder without one is taken file by file in
the order of their names.
"""

import io
import os
import shutil
import sqlite3
import struct
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
import zstandard
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, DataEnd, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap_ros2.decoder import DecoderFactory

from anser_ros.errors import BagError, LayoutError, SetupError
from anser_ros.stamps import stamp_of
from anser_ros.wire import recorded
from anser_ros.wire.points import STALE, FluxPoints, decode_flux
from anser_ros.wire.setup import parse_setup
from anser_ros.wire.text_files import read_yaml

_BROKEN = (
    McapError, ValueError, struct.error, EOFError, IndexError, KeyError, MemoryError,
    OverflowError, OSError, zstandard.ZstdError, RuntimeError,
)  # fmt: skip
_RECORD_LIMIT = 256 * 2**20
"""Largest record, and unpacked chunk, that is read, bytes: more is damage, or hostile."""

FLUX_TYPE = 'sensor_msgs/msg/PointCloud2'
POSE_TYPE = 'geometry_msgs/msg/PoseStamped'


class RawMessage(NamedTuple):
    """Holds one message as it lies in the bag: serialised (CDR), with its schema for decoding."""

    topic: str
    type_name: str
    log_time_ns: int
    data: bytes
    channel: Channel
    schema: Schema

    @property
    def definition(self) -> str:
        """Return the text of its type and of all types in it; empty where it is not known."""
        is_known = self.schema.encoding == 'ros2msg'
        return self.schema.data.decode('utf-8', 'replace') if is_known else ''


@dataclass
class Salvage:
    """Counts the losses of a reader, filled in while the messages are iterated."""

    lost: str = ''
    bad_chunks: int = 0


def _import_words(name: str) -> str:
    """Return how a bag of another form becomes one of this form, where it is such a bag."""
    is_folder = os.path.isdir(name)
    files = os.listdir(name) if is_folder else [name]
    ends = ('.db3', '.zstd', '.mcap') if is_folder else ('.db3', '.zstd')
    is_other = any(file.endswith(ends) for file in files)
    return f'; make one of it by: anser import {name} --out session.mcap' if is_other else ''


def bag_file(path: str | os.PathLike[str]) -> str:
    """Return the MCAP file that ``path`` names, itself or alone in a folder; raises `BagError`."""
    name = os.fspath(path)
    if os.path.isdir(name):
        files = sorted(f for f in os.listdir(name) if f.endswith('.mcap'))
        if len(files) != 1:
            words = f'a bag folder holds one .mcap file, found {len(files)}'
            raise BagError(f'{name}: {words}{_import_words(name)}')
        name = os.path.join(name, files[0])
    if not os.path.isfile(name):
        raise BagError(f'{name}: no such bag')
    return name


def _indexed(stream: io.BufferedReader) -> Iterator[RawMessage] | None:
    """Return a complete bag's messages in log time order, or None where the index is missing."""
    reader = make_reader(stream, validate_crcs=True)
    try:
        summary = reader.get_summary()
    except _BROKEN:
        return None
    if summary is None or not summary.chunk_indexes:
        return None
    if any(
        max(chunk.uncompressed_size, chunk.compressed_size, chunk.chunk_length) > _RECORD_LIMIT
        for chunk in summary.chunk_indexes
    ):
        return None  # what is whole is found chunk by chunk
    return (
        _raw(schema, channel, message)
        for schema, channel, message in reader.iter_messages(log_time_order=True)
        if schema is not None
    )


def _raw(schema: Schema, channel: Channel, message: Message) -> RawMessage:
    return RawMessage(channel.topic, schema.name, message.log_time, message.data, channel, schema)


def _records(stream: io.BufferedReader, salvage: Salvage, size: int) -> Iterator[Any]:
    """Yield the records of a bag without index, chunk by chunk, as far as it can be read."""
    reader = StreamReader(stream, emit_chunks=True, record_size_limit=_RECORD_LIMIT)
    whole = 0
    try:
        for record in reader.records:
            whole = stream.tell()
            if isinstance(record, DataEnd):
                break
            if not isinstance(record, Chunk):
                yield record
                continue
            if record.uncompressed_size > _RECORD_LIMIT:
                salvage.bad_chunks += 1
                continue
            try:
                inner = breakup_chunk(record, validate_crc=True)
            except _BROKEN:
                salvage.bad_chunks += 1
                continue
            yield from inner
    except _BROKEN as error:
        why = ': '.join(filter(None, (type(error).__name__, ' '.join(str(error).split())[:120])))
        salvage.lost = f'the bag breaks off after {whole} of {size} bytes ({why})'
    if salvage.bad_chunks:
        text = f'{salvage.bad_chunks} chunks with a bad checksum or size left out'
        salvage.lost = f'{salvage.lost}; {text}' if salvage.lost else text


def _streamed(stream: io.BufferedReader, salvage: Salvage, size: int) -> list[RawMessage]:
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    messages = []
    for record in _records(stream, salvage, size):
        if isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, Message) and record.channel_id in channels:
            channel = channels[record.channel_id]
            schema = schemas.get(channel.schema_id)
            if schema is not None:
                messages.append(_raw(schema, channel, record))
    messages.sort(key=lambda message: message.log_time_ns)
    return messages


def iter_messages(path: str | os.PathLike[str], salvage: Salvage) -> Iterator[RawMessage]:
    """Yield the messages of a bag, or of its folder, by ascending log time.

    What could not be read is filled into ``salvage``. Raises `BagError` when there is no such
    file, it is no MCAP file, or no message can be read.
    """
    name = bag_file(path)
    with open(name, 'rb') as stream:
        if stream.read(8) != b'\x89MCAP0\r\n':
            words = 'not an MCAP file' if os.path.getsize(name) else 'the file is empty'
            raise BagError(f'{name}: {words}{_import_words(name)}')
        stream.seek(0)
        last, messages = -1, _indexed(stream)
        try:
            for message in messages or ():
                yield message
                last = message.log_time_ns
            if messages is not None:
                return
        except _BROKEN as error:
            salvage.lost = f'{type(error).__name__}: {error}'
        stream.seek(0)
        rest = _streamed(stream, salvage, os.path.getsize(name))
        rest = [message for message in rest if message.log_time_ns > last]
        if not rest and last < 0:
            raise BagError(f'{name}: no message can be read ({salvage.lost or "empty bag"})')
        yield from rest


class MessageDecoder(DecoderFactory):  # type: ignore[misc]
    """Turns raw messages into objects with the message's attributes, without ROS."""

    def decode(self, message: RawMessage) -> Any:
        """Decode one message; raises `BagError` when its bytes don't fit its schema."""
        try:
            decoder = self.decoder_for(message.channel.message_encoding, message.schema)
            if decoder is not None:
                return decoder(message.data)
        except Exception as error:  # the decoder's errors have no root of their own
            raise BagError(
                f'{message.topic}: {message.type_name} does not decode: {error}'
            ) from error
        raise BagError(f'{message.topic}: no decoder for {message.type_name}')


class _Collector:
    """Gathers what a session needs from the messages of a bag."""

    def __init__(self) -> None:
        self.decoder = MessageDecoder()
        self.setups: list[str] = []
        self.flux: dict[str, list[tuple[int, FluxPoints]]] = {'tool': [], 'reference': []}
        self.poses: dict[str, list[tuple[int, tuple[float, ...]]]] = {}
        self.refused: Counter[str] = Counter()
        self.topics: dict[str, str] = {}

    def add(self, raw: RawMessage) -> None:
        self.topics[raw.topic] = raw.type_name
        try:
            if raw.topic.endswith('/setup') and raw.type_name == 'std_msgs/msg/String':
                self.setups.append(str(self.decoder.decode(raw).data))
            elif raw.topic.endswith(('/tool/flux', '/reference/flux')):
                self._add_flux(raw)
            elif recorded.optical_stem(raw.topic) and raw.type_name == POSE_TYPE:
                self._add_pose(raw)
        except (BagError, LayoutError, AttributeError, TypeError, ValueError) as error:
            self.refused[f'{raw.topic}: {error}'] += 1

    def _add_flux(self, raw: RawMessage) -> None:
        if raw.type_name != FLUX_TYPE:
            raise LayoutError(f'type {raw.type_name} where {FLUX_TYPE} belongs')
        cloud = self.decoder.decode(raw)
        fields = [(f.name, f.offset, f.datatype, f.count) for f in cloud.fields]
        width = int(cloud.width) * int(cloud.height)
        points = decode_flux(
            fields, cloud.point_step, width, bytes(cloud.data), cloud.is_bigendian
        )
        stamp = stamp_of(cloud)
        if stamp == 0:
            raise LayoutError('stamp zero')
        self.flux[raw.topic.split('/')[-2]].append((stamp, points))

    def _add_pose(self, raw: RawMessage) -> None:
        message = self.decoder.decode(raw)
        numbers = recorded.pose_numbers(message.pose)
        values = (*numbers[:3], *recorded.unit_quaternions(numbers[3:]).tolist())
        if not np.isfinite(values).all():
            raise LayoutError('a pose with values not finite or a quaternion not of unit length')
        body = recorded.optical_stem(raw.topic)
        self.poses.setdefault(body, []).append((stamp_of(message), values))

    def flux_stream(self, which: str) -> recorded.RecordedFluxes | None:
        frames: dict[int, FluxPoints] = {}
        n_emitters = Counter(points.flux.shape[1] for _, points in self.flux[which])
        for stamp, points in self.flux[which]:
            if points.flux.shape[1] != n_emitters.most_common(1)[0][0]:
                self.refused[f'{which}/flux: another number of emitters'] += 1
            elif stamp in frames:
                self.refused[f'{which}/flux: the same stamp twice'] += 1
            else:
                frames[stamp] = points
        if not frames:
            return None
        channels = np.unique(np.concatenate([points.channel for points in frames.values()]))
        stamps = np.array(sorted(frames), dtype=np.int64)
        shape = (stamps.size, channels.size)
        flux = np.full((*shape, n_emitters.most_common(1)[0][0]), np.nan, dtype=np.complex128)
        flags = np.full(shape, STALE, dtype=np.int64)
        for f, stamp in enumerate(stamps.tolist()):
            points = frames[stamp]
            rows = np.searchsorted(channels, points.channel)
            flux[f, rows], flags[f, rows] = points.flux, points.flags
        return recorded.RecordedFluxes(stamps, channels, flags, flux)

    def pose_streams(self) -> dict[str, recorded.PoseStream]:
        streams = {}
        for body, rows in self.poses.items():
            unique = dict(rows)
            stamps = np.array(sorted(unique), dtype=np.int64)
            values = np.array([unique[stamp] for stamp in stamps.tolist()])
            streams[body] = recorded.PoseStream(stamps, values[:, :3], values[:, 3:])
        return streams


def _rename_words(topics: Mapping[str, str]) -> str:
    """Return which topics of a bag may be fluxes under another name, and what renames them."""
    known = ('/tool/flux', '/reference/flux', '/field_model', '/field_model_error')
    others = [t for t, kind in topics.items() if kind == FLUX_TYPE and not t.endswith(known)]
    if not others:
        return ''
    words = f'anser import BAG --remap {others[0]}:=/anser/tool/flux --out session.mcap'
    return f'; if {", ".join(others)} are fluxes: {words}'


def read_bag(path: str | os.PathLike[str]) -> recorded.Bag:
    """Read a recorded session; raises `BagError`, also without a setup or without fluxes."""
    salvage, collector = Salvage(), _Collector()
    for raw in iter_messages(path, salvage):
        collector.add(raw)
    if not collector.setups:
        raise BagError(f'{os.fspath(path)}: the bag has no setup; anser import --setup adds one')
    text = collector.setups[-1]  # acquisition adds rate and noise once its stream is there
    try:
        setup = parse_setup(text)
    except SetupError as error:
        raise BagError(f'{os.fspath(path)}: {error}') from error
    tool, reference = collector.flux_stream('tool'), collector.flux_stream('reference')
    if tool is None and reference is None:
        reasons = ''.join(f'; {text}' for text in list(collector.refused)[:1])
        reasons = reasons or _rename_words(collector.topics)
        raise BagError(f'{os.fspath(path)}: the bag has no readable flux{reasons}')
    return recorded.Bag(
        os.fspath(path), setup, text, tool, reference, collector.pose_streams(),
        dict(collector.refused), salvage.lost,
    )  # fmt: skip


def read_fluxes(path: str | os.PathLike[str]) -> dict[str, recorded.RecordedFluxes]:
    """Return the fluxes of a bag that need not have a setup, by ``tool`` and ``reference``."""
    collector = _Collector()
    for raw in iter_messages(path, Salvage()):
        if raw.topic.endswith(('/tool/flux', '/reference/flux')):
            collector.add(raw)
    found = {which: collector.flux_stream(which) for which in ('tool', 'reference')}
    return {which: fluxes for which, fluxes in found.items() if fluxes is not None}


ZSTD = '.zstd'
"""Ending of a file that rosbag2 has compressed as a whole."""


def read_foreign(path: str | os.PathLike[str], salvage: Salvage) -> Iterator[RawMessage]:
    """Yield the messages of a bag, one file after the other, each by its times of recording.

    The path is of a ``.db3`` or ``.mcap`` file, also with ``.zstd`` behind it, or of a bag's
    folder. What could not be read is filled into ``salvage``. Raises `BagError` when there is no
    such bag, or a file of it is no bag or cannot be unpacked.
    """
    files, by_message = _parts(Path(path))
    for file in files:
        with tempfile.TemporaryDirectory() as folder:
            plain = _unpacked(file, Path(folder))
            messages = _sqlite(plain) if plain.suffix == '.db3' else iter_messages(plain, salvage)
            try:
                for message in messages:
                    data = _unpack(message, file) if by_message else message.data
                    yield message._replace(data=data)
            except BagError as error:  # about what was unpacked, which nobody knows
                raise BagError(str(error).replace(str(plain), str(file))) from error


def _parts(path: Path) -> tuple[list[Path], bool]:
    """The files of a bag, in order, and whether each message is compressed by itself."""
    if path.is_file():
        return [path], False
    if not path.is_dir():
        raise BagError(f'{path}: no such bag')
    described = path / 'metadata.yaml'
    if not described.is_file():
        found = sorted(f for f in path.iterdir() if _kind(f) in ('.db3', '.mcap'))
        if not found:
            raise BagError(f'{path}: a folder without metadata.yaml, .db3 and .mcap files')
        return found, False
    try:
        about = read_yaml(described.read_text(encoding='utf-8'))['rosbag2_bagfile_information']
        names = [str(name) for name in about['relative_file_paths']]
        mode = str(about.get('compression_mode') or '').upper()
        form = str(about.get('compression_format') or '').lower()
    except (OSError, UnicodeDecodeError, yaml.YAMLError, TypeError, KeyError, AttributeError) as e:
        raise BagError(f'{described}: not the description of a bag ({type(e).__name__})') from e
    if form not in ('', 'zstd'):
        raise BagError(f'{described}: compressed by {form}, of which only zstd is read')
    files = []
    for name in names:
        file = path / Path(name).name  # older versions of rosbag2 write the folder too
        packed = file.with_name(file.name + ZSTD)
        files.append(packed if packed.is_file() and not file.is_file() else file)
        if not files[-1].is_file():
            raise BagError(f'{path}: {files[-1].name} of the bag is missing')
    return files, mode == 'MESSAGE'


def _kind(path: Path) -> str:
    return Path(path.name.removesuffix(ZSTD)).suffix


def _unpacked(path: Path, folder: Path) -> Path:
    """The file itself, or what is in a compressed one, unpacked into a folder."""
    if _kind(path) not in ('.db3', '.mcap'):
        raise BagError(f'{path}: neither .db3 nor .mcap')
    if path.suffix != ZSTD:
        return path
    plain = folder / path.name.removesuffix(ZSTD)
    try:
        with (
            path.open('rb') as packed,
            plain.open('wb') as out,
            zstandard.ZstdDecompressor().stream_reader(packed) as reader,
        ):
            shutil.copyfileobj(reader, out)
    except zstandard.ZstdError as error:
        raise BagError(f'{path}: cannot be unpacked: {error}') from error
    return plain


def _unpack(message: RawMessage, path: Path) -> bytes:
    try:
        with zstandard.ZstdDecompressor().stream_reader(message.data) as reader:
            data = reader.read(_RECORD_LIMIT + 1)
    except zstandard.ZstdError as error:
        raise BagError(f'{path}: a message of {message.topic} cannot be unpacked') from error
    if len(data) > _RECORD_LIMIT:
        raise BagError(f'{path}: a message of {message.topic} has more than {_RECORD_LIMIT} bytes')
    return bytes(data)


def _sqlite(path: Path) -> Iterator[RawMessage]:
    address = f'{path.resolve().as_uri()}?mode=ro&immutable=1'
    try:
        with closing(sqlite3.connect(address, uri=True)) as base:
            rows: list[tuple[Any, ...]] = base.execute(
                'SELECT id, name, type, serialization_format FROM topics'
            ).fetchall()
            other = sorted({str(row[3]) for row in rows} - {'cdr'})
            if other:
                raise BagError(f'{path}: messages are written as {", ".join(other)}, not as CDR')
            texts = _definitions(base)
            topics = {
                number: (
                    Channel(number, str(name), 'cdr', {}, number),
                    Schema(number, texts.get(str(kind), '').encode(), 'ros2msg', str(kind)),
                )
                for number, name, kind, _ in rows
            }
            order = 'SELECT topic_id, timestamp, data FROM messages ORDER BY timestamp, id'
            for topic_id, stamp, data in base.execute(order):
                channel, schema = topics[topic_id]
                yield RawMessage(
                    channel.topic, schema.name, int(stamp), bytes(data), channel, schema
                )
    except (sqlite3.Error, KeyError) as error:
        raise BagError(f'{path}: not a bag in sqlite3: {error}') from error


def _definitions(base: sqlite3.Connection) -> dict[str, str]:
    """Texts of types, which newer versions of rosbag2 store."""
    try:
        rows = base.execute(
            'SELECT topic_type, encoded_message_definition FROM message_definitions '
            "WHERE encoding = 'ros2msg'"
        )
        return {str(kind): str(text) for kind, text in rows}
    except sqlite3.Error:
        return {}


def published_poses(
    path: str | os.PathLike[str],
    topics: Sequence[str] | None = None,
    salvage: Salvage | None = None,
) -> dict[str, recorded.PoseStream]:
    """Return what each PoseStamped topic of a bag carries, of some topics or of all.

    ``salvage`` takes what could not be read.
    """
    rows: dict[str, list[tuple[float, ...]]] = {topic: [] for topic in topics or ()}
    stamps: dict[str, list[int]] = {topic: [] for topic in topics or ()}
    decoder = MessageDecoder()
    for raw in iter_messages(path, salvage or Salvage()):
        if raw.type_name == POSE_TYPE and (topics is None or raw.topic in rows):
            message = decoder.decode(raw)
            stamps.setdefault(raw.topic, []).append(stamp_of(message))
            rows.setdefault(raw.topic, []).append(recorded.pose_numbers(message.pose))
    found = {}
    for topic, values in rows.items():
        table = np.array(values, dtype=np.float64).reshape(-1, 7)
        stamp = np.array(stamps[topic], dtype=np.int64)
        found[topic] = recorded.PoseStream(stamp, table[:, :3], table[:, 3:])
    return found
