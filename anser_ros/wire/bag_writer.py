"""Writes MCAP bags that survive a crash and a full disk, with or without ROS.

Whatever happens, the data up to the last flush stay readable: a flush ends a chunk and hands all
of it to the system in one go, and a write that fails is taken back. So that even a full disk
leaves a bag with an index, a file without a name keeps the space for it.
"""

import contextlib
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self

from mcap.well_known import Profile, SchemaEncoding
from mcap.writer import CompressionType, Writer

from anser_ros.errors import BagError
from anser_ros.wire.bag_metadata import BagRecord, TopicRecord, plain_yaml

CHUNK_BYTES = 256 * 1024
"""Size of a chunk, bytes. A recording that is cut off loses at most its last chunk; smaller chunks
make larger files."""
RESERVE_BYTES = 1024 * 1024
"""Disk space that is reserved at the start, bytes, for the end of a recording on a full disk."""
LIBRARY = 'anser_ros'


class _Segments:
    """The stream under the MCAP writer: collects, and writes a whole segment at each flush."""

    def __init__(self, raw: BinaryIO) -> None:
        self._raw = raw
        self._waiting = bytearray()
        self._written = 0

    def write(self, data: bytes) -> int:
        self._waiting += data
        return len(data)

    def tell(self) -> int:
        return self._written + len(self._waiting)

    def flush(self) -> None:
        """Write all that waits; when that fails, the file has none of it and all of it waits."""
        view = memoryview(bytes(self._waiting))
        try:
            done = 0
            while done < len(view):
                done += self._raw.write(view[done:])
            self._raw.flush()
        except OSError:
            with contextlib.suppress(OSError):
                self._raw.seek(self._written)
                self._raw.truncate()
            raise
        self._written += len(view)
        self._waiting.clear()


class BagWriter:
    """Writes messages into one MCAP file, which is closed at the end of a ``with`` block.

    The file must not exist yet; its folder is made. An unbuffered binary stream may be given to be
    written to instead. A block that fails leaves no file, as half of one would be taken for a
    whole session. Until the end the index of all chunks is in memory, 40 MB for an hour of forty
    topics.

    Raises
    ------
    BagError
        The file exists already, or cannot be made.
    """

    def __init__(self, path: str | Path, raw: BinaryIO | None = None) -> None:
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
        self._writer = Writer(
            self._segments,  # type: ignore[arg-type]
            chunk_size=CHUNK_BYTES,
            compression=CompressionType.ZSTD,
        )
        self._schemas: dict[str, int] = {}
        self._writer.start(profile=Profile.ROS2, library=LIBRARY)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
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
        publishers offer (:func:`qos_profile`), and the hash, of REP 2011, empty when it is not
        known.
        """
        if type_name not in self._schemas:
            self._schemas[type_name] = self._writer.register_schema(
                type_name, SchemaEncoding.ROS2, definition.encode()
            )
        channel: int = self._writer.register_channel(
            name,
            'cdr',
            self._schemas[type_name],
            {
                'offered_qos_profiles': plain_yaml([dict(profile) for profile in qos]),
                'topic_type_hash': type_hash,
            },
        )
        self.record.topics[channel] = TopicRecord(name, type_name, type_hash, tuple(qos))
        return channel

    def write(
        self, channel: int, log_time_ns: int, data: bytes, publish_time_ns: int | None = None
    ) -> None:
        """Add a message to the running chunk; nothing reaches the disk before :meth:`flush`."""
        published_ns = log_time_ns if publish_time_ns is None else publish_time_ns
        self._writer.add_message(channel, log_time_ns, data, published_ns)
        record = self.record
        record.first_ns = min(record.first_ns, log_time_ns) if record.messages else log_time_ns
        record.last_ns = max(record.last_ns, log_time_ns)
        record.messages += 1
        record.topics[channel].messages += 1

    def flush(self) -> None:
        """End the running chunk and hand it to the system; raises OSError on a full disk."""
        self._writer.flush()

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
