"""Reads the bags that other programs wrote: sqlite3, split, compressed by file or by message.

What rosbag2 describes in ``metadata.yaml`` is followed; a folder without one is taken file by file
in the order of their names. Only serialised messages (CDR) come out; nothing of ROS is needed.
"""

import os
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import yaml
import zstandard

from anser_ros.errors import BagError
from anser_ros.wire.bag import Salvage, iter_messages
from anser_ros.wire.text_files import read_yaml

ZSTD = '.zstd'
"""Ending of a file that rosbag2 has compressed as a whole."""
MOST_BYTES = 256 * 2**20
"""Largest message once it is unpacked, bytes: the bound of records in `wire.bag`."""


class ForeignMessage(NamedTuple):
    """Holds one message: its topic, type, recording time, ns, bytes (CDR), and its type's text."""

    topic: str
    type_name: str
    log_time_ns: int
    data: bytes
    definition: str


def read_foreign(path: str | os.PathLike[str], salvage: Salvage) -> Iterator[ForeignMessage]:
    """Yield the messages of a bag, one file after the other, each by its times of recording.

    The path is of a ``.db3`` or ``.mcap`` file, also with ``.zstd`` behind it, or of a bag's
    folder. What could not be read is filled into ``salvage``. Raises `BagError` when there is no
    such bag, or a file of it is no bag or cannot be unpacked.
    """
    files, by_message = _parts(Path(path))
    for file in files:
        with tempfile.TemporaryDirectory() as folder:
            plain = _unpacked(file, Path(folder))
            messages = _sqlite(plain) if plain.suffix == '.db3' else _mcap(plain, salvage)
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


def _unpack(message: ForeignMessage, path: Path) -> bytes:
    try:
        with zstandard.ZstdDecompressor().stream_reader(message.data) as reader:
            data = reader.read(MOST_BYTES + 1)
    except zstandard.ZstdError as error:
        raise BagError(f'{path}: a message of {message.topic} cannot be unpacked') from error
    if len(data) > MOST_BYTES:
        raise BagError(f'{path}: a message of {message.topic} has more than {MOST_BYTES} bytes')
    return bytes(data)


def _mcap(path: Path, salvage: Salvage) -> Iterator[ForeignMessage]:
    for raw in iter_messages(path, salvage):
        text = raw.schema.data.decode('utf-8', 'replace')
        if raw.schema.encoding != 'ros2msg':
            text = ''
        yield ForeignMessage(raw.topic, raw.type_name, raw.log_time_ns, raw.data, text)


def _sqlite(path: Path) -> Iterator[ForeignMessage]:
    address = f'{path.resolve().as_uri()}?mode=ro&immutable=1'
    try:
        with closing(sqlite3.connect(address, uri=True)) as base:
            rows: list[tuple[Any, ...]] = base.execute(
                'SELECT id, name, type, serialization_format FROM topics'
            ).fetchall()
            other = sorted({str(row[3]) for row in rows} - {'cdr'})
            if other:
                raise BagError(f'{path}: messages are written as {", ".join(other)}, not as CDR')
            topics = {row[0]: (str(row[1]), str(row[2])) for row in rows}
            texts = _definitions(base)
            order = 'SELECT topic_id, timestamp, data FROM messages ORDER BY timestamp, id'
            for topic_id, stamp, data in base.execute(order):
                name, kind = topics[topic_id]
                yield ForeignMessage(name, kind, int(stamp), bytes(data), texts.get(kind, ''))
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
