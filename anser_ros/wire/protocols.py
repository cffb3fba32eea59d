"""Finds records in a byte stream, lists the protocols that do so, and chooses the next command.

The rest of the package knows a control unit only by its records (`frames.Hello`, `SampleBlock`,
`DeviceStatus`, `Reply`), so another unit needs a reader only.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from anser_ros.errors import FrameError, PortError
from anser_ros.wire import frames

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
    hold back the records behind it; before a hello it waits for ``max_payload`` bytes.
    """

    def __init__(self, max_payload: int = frames.MAX_PAYLOAD) -> None:
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

    def feed(self, data: bytes) -> list[frames.Record]:
        """Take bytes as they come and return the records that they complete."""
        buffer = self._pending + data if self._pending else bytes(data)
        view = memoryview(buffer)
        records: list[frames.Record] = []
        counters = self.counters
        position = 0
        while True:
            start = buffer.find(frames.MAGIC, position)
            if start < 0:
                keep = _magic_prefix(buffer, position)
                counters.skipped_bytes += len(buffer) - keep - position
                position = len(buffer) - keep
                break
            counters.skipped_bytes += start - position
            position = start
            if len(buffer) - start < frames.HEADER.size:
                break
            _, version, number, length, tag, check = frames.HEADER.unpack_from(buffer, start)
            if check != frames.header_check(view[start : start + 10]) or length > self.max_payload:
                counters.bad_header += 1
                position = self._skip(start)
                continue
            end = start + frames.OVERHEAD + length
            if len(buffer) < end:
                break
            body_end = end - frames.CRC.size
            if zlib.crc32(view[start:body_end]) != frames.CRC.unpack_from(buffer, body_end)[0]:
                counters.bad_crc += 1
                position = self._skip(start)
                continue
            position = end
            record = self._decode(
                version, number, tag, view[start + frames.HEADER.size : body_end]
            )
            if record is not None:
                records.append(record)
        self._pending = buffer[position:]
        return records

    def _skip(self, start: int) -> int:
        self.counters.skipped_bytes += 1
        return start + 1

    def _decode(
        self, version: int, number: int, tag: int, body: memoryview
    ) -> frames.Record | None:
        if version != frames.VERSION:
            self.counters.wrong_version += 1
            self.last_refusal = f'protocol version {version}, this is version {frames.VERSION}'
            return None
        if number not in frames.TYPE_OF.values():
            self.counters.unknown_type += 1
            return None
        try:
            payload = frames.decode_payload(number, body)
        except FrameError as error:
            self.counters.bad_payload += 1
            self.last_refusal = str(error)
            return None
        if isinstance(payload, frames.Hello):
            self.max_payload = max(_SHORTEST_PAYLOAD, payload.samples_size())
        self.counters.records += 1
        return frames.Record(payload, tag)


def _magic_prefix(buffer: bytes, position: int) -> int:
    """Return how many bytes at the end of the buffer may begin a record's magic number."""
    for length in range(min(len(frames.MAGIC) - 1, len(buffer) - position), 0, -1):
        if buffer.endswith(frames.MAGIC[:length]):
            return length
    return 0


class RecordReader(Protocol):
    """Finds records in one port's bytes; ``last_refusal`` says why the last was refused."""

    last_refusal: str

    def feed(self, data: bytes) -> list[frames.Record]:
        """Take bytes as they come and return the records that they complete.

        It must not raise, whatever the bytes are: an exception closes the port, which is opened
        again. Bytes that cannot be read are counted, and the reason is kept in ``last_refusal``.
        """

    def reset(self) -> None:
        """Forget what belongs to the connection that has ended."""

    def fault_counters(self) -> dict[str, int]:
        """Return what was met so far, by name; the names appear in ``/diagnostics``."""


@dataclass(frozen=True)
class SerialProtocol:
    """Describes how a kind of control unit speaks."""

    make_reader: Callable[[], RecordReader]  # returns a new `RecordReader`
    # bytes of a command (`frames.Identify`, `SetFrequencies`, `Start`, `Stop`) with a tag that
    # its reply repeats. A command that the unit does not have is no bytes
    encode: Callable[[frames.Payload, int], bytes]

    @property
    def sets_tones(self) -> bool:
        """Return whether the host can change the unit's tones."""
        return bool(self.encode(frames.SetFrequencies((1.0,)), 1))


def records_of(reader: RecordReader, data: bytes) -> list[frames.Record]:
    """Return the records that a reader completes with these bytes.

    Raises `PortError` when the reader fails, or gives a hello that no receiver could use.
    """
    try:
        records = reader.feed(data)
        for record in records:
            if isinstance(record.payload, frames.Hello):
                frames.check_hello(record.payload)
    except Exception as error:
        words = ' '.join(str(error).split())
        raise PortError(f'the frame reader failed: {type(error).__name__}: {words}') from error
    return records


ANSER = SerialProtocol(FrameReader, frames.encode)
"""Version 1 of the protocol of `docs/cu_protocol.md`."""

PROTOCOLS = {'anser': ANSER}
"""By the name that the parameter ``protocol`` of ``acquisition`` takes."""


_REPEAT_NS = 500_000_000
"""Time (0.5 s) after which a command without effect is sent again; an answer takes far less."""
_DOUBT_NS = 60_000_000_000
"""Time (1 min) for which the unit is asked again after its hello has changed."""
_ASK_NS = 250_000_000
"""Time (0.25 s) from one such question to the next. Each costs a hello of some hundred bytes."""
_TONE_TOLERANCE_HZ = 1.0
"""Difference up to which a unit's tone is the setup's, Hz; synthesisers round."""


class StreamControl:
    """Follows the records of one connection and determines the commands to send.

    The order is: hello, right tones (where the host may set them), start, samples. Each command is
    repeated every half second until the control unit does what it asks; a refusal is kept as text
    and not repeated. After a hello that contradicts a good one, the unit is asked again for a
    minute. Samples that arrive before the reply to the start command are left over from a buffer.
    """

    def __init__(self, frequencies_hz: tuple[float, ...], *, set_frequencies: bool = True) -> None:
        self._wanted = frequencies_hz
        self._may_set = set_frequencies
        self.reset()

    def reset(self) -> None:
        """Begin a new connection."""
        self.hello: frames.Hello | None = None
        self.refusal = ''
        self.started = False
        self._refused = False
        self._last_block_ns = 0
        self._doubted_ns: int | None = None
        self._last_sent: dict[type, int] = {}

    @property
    def tones_agree(self) -> bool:
        """Return whether the control unit drives the tones of the setup document."""
        return self.hello is not None and self._agree(self.hello)

    def take(self, record: frames.Record, arrival_ns: int) -> None:
        """Take in a received record."""
        payload = record.payload
        if isinstance(payload, frames.SampleBlock):
            self._last_block_ns = arrival_ns
        elif isinstance(payload, frames.Hello):
            if self.tones_agree and payload != self.hello:
                self._doubted_ns = arrival_ns
            self.hello = payload
            if self._agree(payload):
                self.refusal = ''
            elif not self._may_set or self._refused:
                have, want = (
                    ', '.join(f'{tone:g}' for tone in tones)
                    for tones in (payload.frequencies_hz, self._wanted)
                )
                words = f'the control unit drives {have} Hz, but the setup requires {want} Hz'
                self.refusal = self.refusal or words
        elif isinstance(payload, frames.Reply) and payload.code is frames.ReplyCode.OK:
            if payload.command == frames.TYPE_OF[frames.Start]:
                self.started = True
                self._last_block_ns = arrival_ns
        elif isinstance(payload, frames.Reply):
            self.refusal = f'the control unit refused: {payload.code.name.lower()} {payload.text}'
            if payload.command == frames.TYPE_OF[frames.SetFrequencies]:
                self._refused = True

    def due(self, now_ns: int) -> frames.Payload | None:
        """Return the command to send now, None when nothing is due."""
        command: frames.Payload
        pause_ns = _REPEAT_NS
        if self.hello is None:
            command = frames.Identify()
        elif not self._agree(self.hello):
            if not self._may_set or self._refused:
                return None
            command = frames.SetFrequencies(self._wanted)
        elif not self.started or now_ns - self._last_block_ns > _REPEAT_NS:
            command = frames.Start()
        elif self._doubted_ns is not None and now_ns - self._doubted_ns < _DOUBT_NS:
            command, pause_ns = frames.Identify(), _ASK_NS
        else:
            return None
        if now_ns - self._last_sent.get(type(command), -pause_ns) < pause_ns:
            return None
        self._last_sent[type(command)] = now_ns
        return command

    def _agree(self, hello: frames.Hello) -> bool:
        return len(hello.frequencies_hz) == len(self._wanted) and all(
            abs(have - want) <= _TONE_TOLERANCE_HZ
            for have, want in zip(hello.frequencies_hz, self._wanted, strict=True)
        )
