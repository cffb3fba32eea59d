"""Encodes and decodes the records of the control unit's serial protocol, version 1.

It is written down in `docs/cu_protocol.md`; the two must agree. Everything is little endian.
`protocols` finds records in a stream; this module knows what is inside one.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import FrameError

MAX_PAYLOAD = 0xFFFF
"""Largest payload of a record, bytes: its length is an unsigned 16-bit number."""
MAX_CHANNELS = 1024
"""Most channels that a hello may state; more are taken for a damaged record."""
FASTEST_SAMPLE_RATE_HZ = 4e5
"""Highest sample rate that a hello may state, Hz; a higher one is taken for a damaged record."""
TICK_RATES_HZ = (1e3, 1e10)
"""Lowest and highest rate of the device's timestamp counter that a hello may state, Hz."""
FULL_SCALE_CODE = 32768
"""Code of a full-scale signal: one beyond the largest signed 16-bit number."""
SAMPLES_HEAD = struct.Struct('<IQHHHH')
"""Layout of what precedes the codes in a block of samples."""


class ChannelKind(IntEnum):
    """Names what an ADC channel measures: a sensor coil, or the sum of the emitters' currents."""

    SENSE = 0
    CURRENT = 1


class DeviceState(IntEnum):
    """Names what the control unit is doing."""

    IDLE = 0
    STREAMING = 1
    FAULT = 2


class StatusFlag(IntFlag):
    """Names conditions that the control unit reports about itself."""

    SYNTHESISER_UNLOCKED = 1
    DRIVER_OVERHEATED = 2
    COIL_OPEN = 4
    ADC_CLOCK_LOST = 8
    OVERRUN = 16


class SamplesFlag(IntFlag):
    """Names conditions of one block of samples."""

    LOST_BEFORE = 1


class ReplyCode(IntEnum):
    """Names the control unit's answers to a command."""

    OK = 0
    UNKNOWN_COMMAND = 1
    BAD_ARGUMENT = 2
    WRONG_STATE = 3
    BROKEN = 4


@dataclass(frozen=True)
class Channel:
    """Describes one column of the sample blocks by its channel number in the setup document.

    The full scale is in volts (sense) or amperes (current), at code 32768.
    """

    number: int
    kind: ChannelKind
    full_scale: float


@dataclass(frozen=True)
class Hello:
    """States what the control unit is and how it samples, once a second and after each change.

    Rates are those of sampling, a channel, and of the device's timestamp counter; channels are the
    columns of a block, and tones and nominal peak currents those of the emitter coils.
    """

    device: str
    sample_rate_hz: float
    tick_hz: float
    block_samples: int
    channels: tuple[Channel, ...]
    frequencies_hz: tuple[float, ...]
    currents_a: tuple[float, ...]
    minor: int = 0

    def samples_size(self) -> int:
        """Return the payload size of one block of samples, bytes."""
        return SAMPLES_HEAD.size + 2 * self.block_samples * len(self.channels)


@dataclass(frozen=True)
class SampleBlock:
    """Holds consecutive samples of all channels: codes (n, C), a view into the received bytes.

    Blocks are numbered since START, modulo 2^32; ticks are the device's time of the first sample.
    """

    sequence: int
    timestamp_ticks: int
    codes: NDArray[np.int16]
    flags: int = 0


@dataclass(frozen=True)
class DeviceStatus:
    """States the control unit's health, once a second and when it changes."""

    state: DeviceState
    flags: StatusFlag
    uptime_ticks: int
    dropped_blocks: int
    refused_records: int
    temperature_deg_c: float


@dataclass(frozen=True)
class Reply:
    """Answers the command that carried the same tag."""

    command: int
    code: ReplyCode
    text: str = ''


@dataclass(frozen=True)
class Identify:
    """Commands the control unit to send a hello now."""


@dataclass(frozen=True)
class Start:
    """Commands the control unit to stream sample blocks, from sequence number 0."""


@dataclass(frozen=True)
class Stop:
    """Commands the control unit to stop streaming."""


@dataclass(frozen=True)
class SetFrequencies:
    """Commands to drive the coils at these tones; answered, then followed by a new hello."""

    frequencies_hz: tuple[float, ...]


Payload = Hello | SampleBlock | DeviceStatus | Reply | Identify | Start | Stop | SetFrequencies


@dataclass(frozen=True)
class Record:
    """Holds one record of the stream: its payload, and the tag that ties a reply to a command."""

    payload: Payload
    tag: int = 0


def check_hello(hello: Hello) -> None:
    """Refuse a hello that no receiver could use; raises `FrameError` with what is wrong."""
    scales = [channel.full_scale for channel in hello.channels]
    positive = [hello.sample_rate_hz, hello.tick_hz, *scales, *hello.frequencies_hz]
    if not all(isfinite(value) and value > 0 for value in [*positive, *hello.currents_a]):
        raise FrameError('hello holds a rate, full scale, tone or current that is not positive')
    if hello.sample_rate_hz > FASTEST_SAMPLE_RATE_HZ or len(hello.channels) > MAX_CHANNELS:
        raise FrameError(
            f'hello of {len(hello.channels)} channels at {hello.sample_rate_hz:g} S/s is beyond '
            f'{MAX_CHANNELS} at {FASTEST_SAMPLE_RATE_HZ:g}'
        )
    if not TICK_RATES_HZ[0] <= hello.tick_hz <= TICK_RATES_HZ[1]:
        raise FrameError(f'hello of {hello.tick_hz:g} ticks a second, out of 1e3 to 1e10')
    if any(2 * tone >= hello.sample_rate_hz for tone in hello.frequencies_hz):
        raise FrameError(f'hello holds a tone above half of {hello.sample_rate_hz:g} S/s')
    numbers = [channel.number for channel in hello.channels]
    if len(set(numbers)) != len(numbers):
        raise FrameError('hello names a channel twice')
    if sum(channel.kind is ChannelKind.CURRENT for channel in hello.channels) != 1:
        raise FrameError('hello must name exactly one current channel')
    if not hello.frequencies_hz:
        raise FrameError('hello names no emitter coil')
    if not 0 < hello.samples_size() <= MAX_PAYLOAD or hello.block_samples < 1:
        raise FrameError(f'a block of {hello.block_samples} samples does not fit one record')


MAGIC = b'\xa5\x41\x4e\xda'
VERSION = 1
"""Version of the protocol in docs/cu_protocol.md."""
HEADER = struct.Struct('<4sBBHHH')
CRC = struct.Struct('<I')
OVERHEAD = HEADER.size + CRC.size

_HELLO = struct.Struct('<HddHHHB')
_CHANNEL = struct.Struct('<HBBf')
_COIL = struct.Struct('<df')
_STATUS = struct.Struct('<BBHQIIf')
_REPLY = struct.Struct('<BB')


def _text(raw: memoryview) -> str:
    try:
        return bytes(raw).decode('utf-8')
    except UnicodeDecodeError as error:
        raise FrameError(f'text is not UTF-8: {error.reason}') from error


def _encode_hello(hello: Hello) -> bytes:
    device = hello.device.encode('utf-8')[:255]
    rates = hello.sample_rate_hz, hello.tick_hz, hello.block_samples
    counts = len(hello.channels), len(hello.frequencies_hz), len(device)
    channels = [_CHANNEL.pack(c.number, c.kind, 0, c.full_scale) for c in hello.channels]
    tones = zip(hello.frequencies_hz, hello.currents_a, strict=True)
    coils = [_COIL.pack(frequency, current) for frequency, current in tones]
    return b''.join([_HELLO.pack(hello.minor, *rates, *counts), device, *channels, *coils])


def _decode_hello(raw: memoryview) -> Hello:
    minor, rate, tick, block, n_channels, n_coils, n_text = _HELLO.unpack_from(raw)
    start = _HELLO.size + n_text
    coil_start = start + n_channels * _CHANNEL.size
    end = coil_start + n_coils * _COIL.size
    if len(raw) < end:
        raise FrameError(f'hello of {len(raw)} bytes announces {end}')
    channels = tuple(
        Channel(number, ChannelKind(kind), full_scale)
        for number, kind, _, full_scale in _CHANNEL.iter_unpack(raw[start:coil_start])
    )
    coils = list(_COIL.iter_unpack(raw[coil_start:end]))
    tones, currents = (tuple(coil[i] for coil in coils) for i in (0, 1))
    device = _text(raw[_HELLO.size : start])
    hello = Hello(device, rate, tick, block, channels, tones, currents, minor)
    check_hello(hello)
    return hello


def _encode_samples(block: SampleBlock) -> bytes:
    n, columns = block.codes.shape
    head = SAMPLES_HEAD.pack(block.sequence, block.timestamp_ticks, n, columns, block.flags, 0)
    return head + np.ascontiguousarray(block.codes, dtype='<i2').tobytes()


def _decode_samples(raw: memoryview) -> SampleBlock:
    sequence, ticks, n, columns, flags, _ = SAMPLES_HEAD.unpack_from(raw)
    if n * columns == 0 or len(raw) != SAMPLES_HEAD.size + 2 * n * columns:
        raise FrameError(f'block of {n} x {columns} samples in {len(raw)} bytes')
    codes = np.frombuffer(raw, '<i2', n * columns, SAMPLES_HEAD.size).reshape(n, columns)
    return SampleBlock(sequence, ticks, codes, flags)


def _encode_status(status: DeviceStatus) -> bytes:
    counts = status.uptime_ticks, status.dropped_blocks, status.refused_records
    return _STATUS.pack(status.state, 0, int(status.flags), *counts, status.temperature_deg_c)


def _decode_status(raw: memoryview) -> DeviceStatus:
    state, _, flags, *rest = _STATUS.unpack_from(raw)
    return DeviceStatus(DeviceState(state), StatusFlag(flags & 31), *rest)


def _encode_reply(reply: Reply) -> bytes:
    return _REPLY.pack(reply.command, reply.code) + reply.text.encode('utf-8')


def _decode_reply(raw: memoryview) -> Reply:
    command, code = _REPLY.unpack_from(raw)
    return Reply(command, ReplyCode(code), _text(raw[_REPLY.size :]))


def _encode_frequencies(command: SetFrequencies) -> bytes:
    return struct.pack(f'<{len(command.frequencies_hz)}d', *command.frequencies_hz)


def _decode_frequencies(raw: memoryview) -> SetFrequencies:
    if len(raw) == 0 or len(raw) % 8:
        raise FrameError(f'frequencies in {len(raw)} bytes, not a multiple of 8')
    tones = struct.unpack(f'<{len(raw) // 8}d', raw)
    if not all(isfinite(tone) and tone > 0 for tone in tones):
        raise FrameError('a frequency is not finite and positive')
    return SetFrequencies(tones)


_LAYOUTS: dict[int, tuple[type, Callable[..., bytes], Callable[[memoryview], Payload]]] = {
    0x01: (Hello, _encode_hello, _decode_hello),
    0x02: (SampleBlock, _encode_samples, _decode_samples),
    0x03: (DeviceStatus, _encode_status, _decode_status),
    0x04: (Reply, _encode_reply, _decode_reply),
    0x81: (Identify, lambda _: b'', lambda _: Identify()),
    0x82: (Start, lambda _: b'', lambda _: Start()),
    0x83: (Stop, lambda _: b'', lambda _: Stop()),
    0x84: (SetFrequencies, _encode_frequencies, _decode_frequencies),
}
"""Type, encoder and decoder of the payload of each record, by the number of its type."""
TYPE_OF = {layout[0]: number for number, layout in _LAYOUTS.items()}
"""Number of the record type of each class of payload."""


def encode(payload: Payload, tag: int = 0) -> bytes:
    """Encode one record, header and CRC included; raises `FrameError` when it is too long."""
    number = TYPE_OF[type(payload)]
    body = _LAYOUTS[number][1](payload)
    if len(body) > MAX_PAYLOAD:
        raise FrameError(f'payload of {len(body)} bytes does not fit one record')
    bare = HEADER.pack(MAGIC, VERSION, number, len(body), tag, 0)
    head = bare[:10] + struct.pack('<H', header_check(bare))
    raw = head + body
    return raw + CRC.pack(zlib.crc32(raw))


def header_check(head: bytes | memoryview) -> int:
    """Return the check value of a header, the low half of the CRC-32 of its first ten bytes."""
    return zlib.crc32(head[:10]) & 0xFFFF


def decode_payload(number: int, raw: memoryview) -> Payload:
    """Decode the payload of a record whose CRC was right; raises `FrameError`."""
    if number not in _LAYOUTS:
        raise FrameError(f'unknown record type {number:#04x}')
    try:
        return _LAYOUTS[number][2](raw)
    except (struct.error, ValueError) as error:
        raise FrameError(f'record type {number:#04x}: {error}') from error
