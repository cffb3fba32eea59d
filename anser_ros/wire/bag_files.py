"""Reads the files of a bag, message by message, as far as they can be read.

They are files in MCAP or sqlite3, also packed by zstd. One that is complete is read through its
index, in the order of its log times. Of one that was cut (a crash, a full disk) or damaged all is
kept that can be read, and `Salvage.lost` states in words what is lost.
"""

import io
import re
import shutil
import sqlite3
import struct
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, field
from itertools import pairwise
from mmap import ACCESS_READ, mmap
from operator import itemgetter
from pathlib import Path
from typing import Any

import yaml
import zstandard
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, DataEnd, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk

from anser_ros.errors import BagError
from anser_ros.wire.number_tables import ENDINGS
from anser_ros.wire.text_files import read_yaml

_BROKEN = (
    McapError, ValueError, struct.error, EOFError, IndexError, KeyError, MemoryError,
    OverflowError, OSError, zstandard.ZstdError, RuntimeError,
)  # fmt: skip
_RECORD_LIMIT = 256 * 2**20
"""Largest record, and unpacked chunk, that is read, bytes: more is damage, or hostile."""

MAGIC = b'\x89MCAP0\r\n'
"""How a file of MCAP begins and ends."""
HEADER = b'\x01'
"""What follows at its begin: the opcode of its header."""
CHUNK = b'\x06'
"""Opcode of a chunk."""
PAGE = 4096
"""Bytes that sqlite3 writes as one, by default."""
LOGGED = b'\2'
"""Nineteenth byte of a file of sqlite3 that is written by way of a log."""
LOGS = ('-wal', '-journal')
"""Endings of files with what sqlite3 has not yet written, or may have to take back."""
ZSTD, _ZSTD_MAGIC = '.zstd', b'\x28\xb5\x2f\xfd'
"""Ending of a file that rosbag2 has compressed as a whole, and how compressed bytes begin."""


Found = tuple[Schema | None, Channel, int, bytes]
"""Type, channel, time of recording, ns, and bytes of a message."""


@dataclass
class Salvage:
    """Holds what a reader has met and lost, filled in while the messages are iterated."""

    lost: str = ''
    topics: dict[str, str] = field(default_factory=dict)  # types by topic

    def add(self, words: str) -> None:
        """State a further loss."""
        self.lost = '; '.join(filter(None, (self.lost, words)))

    def topic_words(self) -> str:
        """Return which topics there are, with their types."""
        words = (f'{topic} ({kind})' for topic, kind in sorted(self.topics.items()))
        return ', '.join(words) or 'no topics'


def _indexed(stream: io.BufferedReader) -> Iterator[Found] | None:
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
        (schema, channel, message.log_time, message.data)
        for schema, channel, message in reader.iter_messages(log_time_order=True)
    )


def _streamed(stream: io.BufferedReader, salvage: Salvage, size: int) -> list[Found]:
    """The messages of a bag without index, chunk by chunk, as far as it can be read."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    messages = []
    for one in _records(stream, salvage, size):
        if isinstance(one, Schema):
            schemas[one.id] = one
        elif isinstance(one, Channel):
            channels[one.id] = one
        elif isinstance(one, Message) and one.channel_id in channels:
            channel = channels[one.channel_id]
            schema = schemas.get(channel.schema_id)
            messages.append((schema, channel, one.log_time, one.data))
    return sorted(messages, key=itemgetter(2))


def _records(stream: io.BufferedReader, salvage: Salvage, size: int) -> Iterator[Any]:
    """The records of a bag in and between chunks, to where it breaks off."""
    whole, bad_chunks = 0, 0
    try:
        reader = StreamReader(stream, emit_chunks=True, record_size_limit=_RECORD_LIMIT)
        for record in reader.records:
            whole = stream.tell()
            if isinstance(record, DataEnd):
                break
            inner, bad = _unchunked(record)
            bad_chunks += bad
            yield from inner
    except _BROKEN as error:
        why = ': '.join(filter(None, (type(error).__name__, ' '.join(str(error).split())[:120])))
        stream.seek(whole)
        rest = list(_rest_of_chunk(stream.read(_RECORD_LIMIT)))
        count = sum(isinstance(record, Message) for record in rest)
        more = f', and {count} messages of the next chunk are read' if count else ''
        salvage.add(f'the bag breaks off after {whole} of {size} bytes ({why}){more}')
        yield from rest
    if bad_chunks:
        salvage.add(f'{bad_chunks} chunks with a bad checksum or size left out')


def _rest_of_chunk(data: bytes) -> Iterator[Any]:
    """The records in a chunk that breaks off, as far as they can be unpacked."""
    size = int.from_bytes(data[37:41], 'little')  # of the compression's name
    form, packed = data[41 : 41 + size], data[49 + size :]
    if data[:1] != CHUNK or form not in (b'', b'zstd'):
        return
    with suppress(*_BROKEN):
        if form:
            packed = zstandard.ZstdDecompressor().stream_reader(packed).read(_RECORD_LIMIT)
        yield from StreamReader(io.BytesIO(packed), skip_magic=True).records


def _unchunked(record: Any) -> tuple[list[Any], bool]:
    """What is in a record, and whether it is a chunk that is damaged."""
    if not isinstance(record, Chunk):
        return [record], False
    try:
        if record.uncompressed_size > _RECORD_LIMIT:
            return [], True
        return breakup_chunk(record, validate_crc=True), False
    except _BROKEN:
        return [], True


def _mcap(path: Path, salvage: Salvage) -> Iterator[Found]:
    """Yield the messages of a file; raises `BagError` when it is no MCAP file."""
    with path.open('rb') as stream:
        if stream.read(8) != MAGIC:
            words = 'not an MCAP file' if path.stat().st_size else 'the file is empty'
            raise BagError(f'{path}: {words}')
        stream.seek(0)
        last, messages = -1, _indexed(stream)
        try:
            for message in messages or ():
                yield message
                last = message[2]
            if messages is not None:
                return
        except _BROKEN as error:
            salvage.add(f'{type(error).__name__}: {error}')
        stream.seek(0)
        rest = _streamed(stream, salvage, path.stat().st_size)
        yield from (message for message in rest if message[2] > last)


def files_of(path: Path, salvage: Salvage) -> tuple[list[Path], int]:
    """The files of a bag, in order, and how many messages its description counts."""
    if path.is_file():
        return [path], 0
    if not path.is_dir():
        raise BagError(f'{path}: no such bag')
    there = sorted(f for f in path.iterdir() if _kind(f) in ('.db3', '.mcap'))
    names, counted = [f.name for f in there], 0
    described = path / 'metadata.yaml'
    try:
        if described.is_file():
            about = read_yaml(described.read_text(encoding='utf-8'))['rosbag2_bagfile_information']
            counted = int(about.get('message_count') or 0)
            # Older versions of rosbag2 write the folder too.
            names = [Path(str(name)).name for name in about['relative_file_paths']]
    except (OSError, ValueError, yaml.YAMLError, TypeError, KeyError, AttributeError):
        salvage.add('metadata.yaml cannot be read, and its files are taken by name')
    if len(names) > 1 and not described.is_file():
        salvage.add(f'{len(names)} files are joined without metadata.yaml: {", ".join(names)}')
    files = []
    for name in names:
        near = [f for f in there if f.name.removesuffix(ZSTD) == name.removesuffix(ZSTD)]
        files += near[:1]
        if not near:
            salvage.add(f'{name} of the bag is missing')
    if not files:
        lost = salvage.lost or 'a folder without .db3 and .mcap files'
        raise BagError(f'{path}: {lost}')
    return files, counted


def _kind(path: Path) -> str:
    return Path(path.name.removesuffix(ZSTD)).suffix.lower()


def messages_in(path: Path, stack: ExitStack, salvage: Salvage) -> Iterator[Found]:
    """The messages of a file, which is unpacked if need be."""
    if _kind(path) not in ('.db3', '.mcap'):
        remedy = '; rosbags-convert turns bags of ROS 1 into those' * (path.suffix == '.bag')
        if path.suffix.lower() in ENDINGS:
            remedy = '; of a table anser import_poses makes one, or anser import of a tables.yaml'
        raise BagError(f'{path}: neither .db3 nor .mcap{remedy}')
    logs = [log for end in LOGS if (log := Path(f'{path}{end}')).is_file()]
    plain, size = path, 0 if _kind(path) == '.mcap' else _stated_size(path)
    if path.suffix == ZSTD or (size and (logs or size > path.stat().st_size)):
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        plain = folder / path.name.removesuffix(ZSTD)
        for log in logs:  # sqlite3 takes in what it has not yet written into the file itself
            shutil.copyfile(log, folder / log.name)
        if path.suffix == ZSTD:
            _unzip(path, plain, salvage)
        else:
            shutil.copyfile(path, plain)
        if (whole := plain.stat().st_size // PAGE * PAGE) < size:
            # sqlite3 reads nothing at all of a file that was cut; bytes of ones are no page.
            with plain.open('r+b') as stream:
                stream.seek(whole)
                stream.write(b'\xff' * (size - whole))
    for log in logs:
        if log.name.endswith(LOGS[0]) and _breaks_off(log.read_bytes()):
            salvage.add(f'{log.name} breaks off: what was written last is lost')
    try:
        if _kind(plain) == '.db3':
            yield from _sqlite(plain, salvage)
        for part in _apart(plain, stack, salvage) if _kind(plain) == '.mcap' else ():
            yield from _mcap(part, salvage)
    except BagError as error:  # about what was unpacked, which nobody knows
        raise BagError(str(error).replace(str(plain), str(path))) from error


def _breaks_off(log: bytes) -> bool:
    """Whether a log of sqlite3 ends in the middle of a page, or of what belongs together.

    Frames of another salt are older ones that were not written over yet (sqlite.org/fileformat).
    """
    frame, salt = 24 + int.from_bytes(log[8:12], 'big'), log[16:24]
    heads = [log[at : at + 24] for at in range(32, len(log), frame)]
    own = [head for head in heads if head[8:16] == salt]
    is_whole = len(log) < 32 or (len(log) - 32) % frame == 0
    return not is_whole or bool(own and own[-1][4:8] == b'\0\0\0\0')


def _apart(path: Path, stack: ExitStack, salvage: Salvage) -> Iterator[Path]:
    """A file of MCAP, or each of several that were joined: the index of the last knows only it."""
    with path.open('rb') as stream:
        if not path.stat().st_size:
            yield path
            return
        data = stack.enter_context(mmap(stream.fileno(), 0, access=ACCESS_READ))
    begins = [found.start() for found in re.finditer(re.escape(MAGIC + HEADER), data)]
    if begins in ([], [0]):
        yield path
        return
    if begins[0]:
        salvage.add(f'{begins[0]} bytes before {path.name} begins are left out')
    if len(begins) > 1:
        words = 'files are joined in'
        salvage.add(f'{len(begins)} {words} {path.name}, and are read one after the other')
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
    for number, (begin, end) in enumerate(pairwise([*begins, len(data)])):
        part = folder / f'{number}_{path.name}'
        part.write_bytes(data[begin:end])
        yield part


def _stated_size(path: Path) -> int:
    """How long a file of sqlite3 is by its own header, bytes; 0 for another one."""
    with path.open('rb') as stream:
        head = stream.read(32)
    if not head.startswith(b'SQLite format 3\0'):
        return 0
    pages, size = int.from_bytes(head[28:32], 'big'), int.from_bytes(head[16:18], 'big')
    return min(pages * (65536 if size == 1 else size), path.stat().st_size + _RECORD_LIMIT)


def _unzip(path: Path, plain: Path, salvage: Salvage) -> None:
    """Unpack a file as far as it goes; raises `BagError` when nothing can be unpacked."""
    unzip = zstandard.ZstdDecompressor().decompressobj()
    why = 'it breaks off'
    with path.open('rb') as packed, plain.open('wb') as out:
        try:
            while block := packed.read(1 << 16):
                out.write(unzip.decompress(block))
        except zstandard.ZstdError as error:
            why = str(error)
    if not plain.stat().st_size:
        raise BagError(f'{path}: cannot be unpacked: {why}')
    if not unzip.eof:
        salvage.add(f'{path.name} is unpacked in part only: {why}')


def unpacked(data: bytes) -> bytes:
    """A message that rosbag2 may have compressed by itself."""
    if not data.startswith(_ZSTD_MAGIC):  # as no message in CDR does
        return bytes(data)
    try:
        with zstandard.ZstdDecompressor().stream_reader(data) as reader:
            found = reader.read(_RECORD_LIMIT + 1)
    except zstandard.ZstdError as error:
        raise BagError(f'a message cannot be unpacked: {error}') from error
    if len(found) > _RECORD_LIMIT:
        raise BagError(f'a message has more than {_RECORD_LIMIT} bytes')
    return bytes(found)


def _sqlite(path: Path, salvage: Salvage) -> Iterator[Found]:
    # A log beside it has to be taken in, for which the copy may be written.
    is_copy = any(Path(f'{path}{end}').is_file() for end in LOGS)
    address = path.resolve().as_uri() + ('' if is_copy else '?mode=ro&immutable=1')
    try:
        with closing(sqlite3.connect(address, uri=True)) as base:
            rows: list[tuple[Any, ...]] = base.execute(
                'SELECT id, name, type, serialization_format FROM topics'
            ).fetchall()
            texts = _definitions(base)
            topics = {
                number: (
                    Schema(number, texts.get(str(kind), '').encode(), 'ros2msg', str(kind)),
                    Channel(number, str(name), str(form), {}, number),
                )
                for number, name, kind, form in rows
            }
            for topic_id, stamp, data in _stored(base, salvage):
                yield *topics[topic_id], int(stamp), bytes(data)
    except (sqlite3.Error, KeyError) as error:
        why = 'a message of no topic' if isinstance(error, KeyError) else str(error)
        if path.read_bytes()[18:19] == LOGGED and not is_copy:
            why += f'; {path.name}-wal, which it was written with, is missing'
        raise BagError(f'{path}: not a bag in sqlite3: {why}') from error


def _stored(base: sqlite3.Connection, salvage: Salvage) -> Iterator[tuple[int, int, bytes]]:
    """The messages of a file by their times; of a damaged one those before and behind the gap."""
    select = 'SELECT topic_id, timestamp, data, id FROM messages ORDER BY'
    done: set[int] = set()
    try:
        for row in base.execute(f'{select} timestamp, id'):
            if None not in row:
                yield row[:3]
                done.add(row[3])
        return
    except sqlite3.DatabaseError as error:
        why = str(error)
    rest: dict[int, tuple[int, int, bytes]] = {}
    for order in ('id', 'id DESC'):
        with suppress(sqlite3.DatabaseError):
            for row in base.execute(f'{select} {order}'):
                if row[3] in rest:
                    break
                rest[row[3]] = row[:3]
    rest = {n: row for n, row in rest.items() if n not in done and None not in row}
    salvage.add(f'{len(done) + len(rest)} messages of a damaged file are read ({why})')
    yield from sorted(rest.values(), key=itemgetter(1))


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
