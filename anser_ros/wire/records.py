"""Defines what the control unit and the host exchange: hellos, samples, commands.

`frames` turns these records into bytes and back; `docs/cu_protocol.md` says what each field means.
"""

from __future__ import annotations

import struct
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
    """Refuse a hello that no receiver could use.

    Raises
    ------
    FrameError
        When a rate, scale or tone is not finite and positive or absurdly large, a tone is not
        below half the sample rate, a channel number appears twice, there is not exactly one
        current channel, or a block does not fit one record.
    """
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
