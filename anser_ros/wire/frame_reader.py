"""Searches for records in a byte stream, also after garbage."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

from anser_ros.errors import FrameError
from anser_ros.wire.frames import (
    CRC,
    HEADER,
    MAGIC,
    OVERHEAD,
    VERSION,
    decode_payload,
    header_check,
    knows,
)
from anser_ros.wire.records import MAX_PAYLOAD, Hello, Record

_SHORTEST_PAYLOAD = 4096
"""Bytes that are waited for at least: a status with its text is longer than small blocks."""


@dataclass
class FrameCounters:
    """Counts what the reader met, in records unless the name has another unit."""

    records: int = 0
    bad_header: int = 0
    bad_crc: int = 0
    bad_payload: int = 0
    wrong_version: int = 0
    unknown_type: int = 0
    skipped_bytes: int = 0


class FrameReader:
    """Turns received bytes into records; everything else is counted and skipped.

    After a header or CRC that is wrong the search goes on one byte behind that record's magic, so
    a good record inside or right behind a damaged one is never lost. Bytes are copied only while a
    record is incomplete; sample blocks are views into the received bytes. Once a hello has stated
    the block size, the reader does not wait for a longer payload, so that a forged length cannot
    hold back the records behind it.

    Parameters
    ----------
    max_payload : longest payload to wait for before a hello, bytes
    """

    def __init__(self, max_payload: int = MAX_PAYLOAD) -> None:
        self._longest = self.max_payload = max_payload
        self.counters = FrameCounters()
        self.last_refusal = ''
        self._pending = b''

    def reset(self) -> None:
        """Forget a half-received record and the block size, after the port was closed."""
        self._pending = b''
        self.max_payload = self._longest

    def fault_counters(self) -> dict[str, int]:
        """Return names and values of the counters, in the order of declaration."""
        return dict(vars(self.counters))

    def feed(self, data: bytes) -> list[Record]:
        """Take bytes as they come and return the records that they complete."""
        buffer = self._pending + data if self._pending else bytes(data)
        view = memoryview(buffer)
        records: list[Record] = []
        counters = self.counters
        position = 0
        while True:
            start = buffer.find(MAGIC, position)
            if start < 0:
                keep = _magic_prefix(buffer, position)
                counters.skipped_bytes += len(buffer) - keep - position
                position = len(buffer) - keep
                break
            counters.skipped_bytes += start - position
            position = start
            if len(buffer) - start < HEADER.size:
                break
            _, version, number, length, tag, check = HEADER.unpack_from(buffer, start)
            if check != header_check(view[start : start + 10]) or length > self.max_payload:
                counters.bad_header += 1
                position = self._skip(start)
                continue
            end = start + OVERHEAD + length
            if len(buffer) < end:
                break
            body_end = end - CRC.size
            if zlib.crc32(view[start:body_end]) != CRC.unpack_from(buffer, body_end)[0]:
                counters.bad_crc += 1
                position = self._skip(start)
                continue
            position = end
            record = self._decode(version, number, tag, view[start + HEADER.size : body_end])
            if record is not None:
                records.append(record)
        self._pending = buffer[position:]
        return records

    def _skip(self, start: int) -> int:
        self.counters.skipped_bytes += 1
        return start + 1

    def _decode(self, version: int, number: int, tag: int, body: memoryview) -> Record | None:
        if version != VERSION:
            self.counters.wrong_version += 1
            self.last_refusal = f'protocol version {version}, this is version {VERSION}'
            return None
        if not knows(number):
            self.counters.unknown_type += 1
            return None
        try:
            payload = decode_payload(number, body)
        except FrameError as error:
            self.counters.bad_payload += 1
            self.last_refusal = str(error)
            return None
        if isinstance(payload, Hello):
            self.max_payload = max(_SHORTEST_PAYLOAD, payload.samples_size())
        self.counters.records += 1
        return Record(payload, tag)


def _magic_prefix(buffer: bytes, position: int) -> int:
    """Return how many bytes at the end of the buffer may begin a record's magic number."""
    for length in range(min(len(MAGIC) - 1, len(buffer) - position), 0, -1):
        if buffer.endswith(MAGIC[:length]):
            return length
    return 0
