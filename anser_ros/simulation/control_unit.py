"""Simulates a control unit that turns the bytes of commands into the bytes of records.

It has no clock: its owner passes it the elapsed time as a number of samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from anser_ros.simulation.raw_effects import RawEffect
from anser_ros.simulation.sampling import FrontEnd, Sampler
from anser_ros.simulation.world import World
from anser_ros.wire.channel_calibration import ChannelCalibration
from anser_ros.wire.frame_reader import FrameReader
from anser_ros.wire.frames import TYPE_OF, encode
from anser_ros.wire.records import (
    Channel,
    ChannelKind,
    DeviceState,
    DeviceStatus,
    Hello,
    Identify,
    Payload,
    Record,
    Reply,
    ReplyCode,
    SampleBlock,
    SamplesFlag,
    SetFrequencies,
    Start,
    StatusFlag,
    Stop,
)

NAME = 'anser_ros simulated control unit'
"""Name by which the device introduces itself."""
TICK_HZ = 1e6
"""Rate of the device's timestamp counter, Hz: microseconds, as usual in microcontrollers."""
BLOCK_SAMPLES = 40
"""Sampling instants a block, unless a setting says another: 1 ms at the usual rate."""
_COMMANDS = (Identify, Start, Stop, SetFrequencies)


@dataclass(frozen=True)
class Piece:
    """Holds the bytes of one record, with what a port needs to know of it."""

    data: bytes  # the record
    # whether it carries samples; such a record may be dropped when the line is full
    is_block: bool = False
    # number of samples since power-up after which a block is complete; 0 for other records
    end_sample: int = 0


class ControlUnit:
    """Speaks the protocol of `docs/cu_protocol.md` as a control unit does.

    ``world`` has the true fluxes of the sensors that it is connected to, ``calibration`` the true
    response of its channels.
    """

    def __init__(
        self,
        world: World,
        calibration: ChannelCalibration,
        front_end: FrontEnd | None = None,
        *,
        block_samples: int = BLOCK_SAMPLES,
        effects: Sequence[RawEffect] = (),
        seed: int = 0,
    ) -> None:
        front = front_end or FrontEnd()
        nominal_a = float(world.setup.emitter.geometry.get('current_a', 0.25))
        self._effects = tuple(effects)
        self._sampler = Sampler(
            world, calibration, front, nominal_a, effects=self._effects, seed=seed
        )
        self._hello = _hello(world, front, block_samples, nominal_a)
        self._reader = FrameReader()
        self._sample = 0
        self._stream_begin = 0
        self._sequence = 0
        self._state = DeviceState.IDLE
        self._dropped = 0
        self._lost_before = False
        self._next_hello = 0

    @property
    def sample_rate_hz(self) -> float:
        """Return the number of samples a second and channel."""
        return self._hello.sample_rate_hz

    @property
    def samples(self) -> int:
        """Return the number of samples since power-up."""
        return self._sample

    @property
    def streaming(self) -> bool:
        """Return whether the unit sends samples."""
        return self._state is DeviceState.STREAMING

    def receive(self, data: bytes) -> list[Piece]:
        """Take bytes from the host and return the records that answer."""
        answers: list[Piece] = []
        for record in self._reader.feed(data):
            answers += self._obey(record)
        return answers

    def drop(self) -> None:
        """Count a block that was lost because the line was full."""
        self._dropped += 1
        self._lost_before = True

    def overload(self, is_on: bool) -> None:
        """Switch the overload of the first channel's amplifier on or off."""
        self._sampler.is_overloaded = is_on

    def skip(self, samples: int) -> None:
        """Let time pass in which the device could not send and whole blocks are lost."""
        block = self._hello.block_samples
        if self.streaming:
            end = self._sample + samples - self._stream_begin
            lost = max(0, end // block - self._sequence)
            self._sequence += lost
            self._dropped += lost
            self._lost_before = self._lost_before or lost > 0
        self._sample += samples

    def advance(self, samples: int) -> list[Piece]:
        """Let time pass and return the records of that time, in order.

        ``samples``: time in sampling instants; a block is sent once its last sample is taken.
        """
        pieces: list[Piece] = []
        if self._sample >= self._next_hello:
            self._next_hello = self._sample + int(self.sample_rate_hz)
            pieces += [self._piece(self._hello), self._piece(self._status())]
        if self.streaming:
            pieces += self._blocks(samples)
        self._sample += samples
        return pieces

    def _blocks(self, samples: int) -> list[Piece]:
        block = self._hello.block_samples
        begin = self._stream_begin + self._sequence * block
        count = (self._sample + samples - begin) // block
        if count <= 0:
            return []
        codes = self._sampler.codes(begin, count * block)
        pieces = []
        for rank in range(count):
            part = SampleBlock(
                self._sequence % 2**32,
                self._ticks(begin + rank * block),
                codes[rank * block : (rank + 1) * block],
                int(SamplesFlag.LOST_BEFORE) if self._lost_before else 0,
            )
            self._lost_before = False
            self._sequence += 1
            pieces.append(Piece(encode(part), True, begin + (rank + 1) * block))
        return pieces

    def _obey(self, record: Record) -> list[Piece]:
        command = record.payload
        if not isinstance(command, _COMMANDS):
            return []
        code, text, more = ReplyCode.OK, '', []
        if isinstance(command, Start):
            self._state = DeviceState.STREAMING
            self._stream_begin, self._sequence = self._sample, 0
            self._dropped, self._lost_before = 0, False
            self._sampler.drive(self._sample / self.sample_rate_hz)
        elif isinstance(command, Stop):
            self._state = DeviceState.IDLE
        elif isinstance(command, Identify):
            more = [self._piece(self._hello)]
        else:
            code, text = self._set_frequencies(command)
            more = [self._piece(self._hello)] if code is ReplyCode.OK else []
        reply = encode(Reply(TYPE_OF[type(command)], code, text), record.tag)
        return [Piece(reply), *more]

    def _set_frequencies(self, command: SetFrequencies) -> tuple[ReplyCode, str]:
        tones = command.frequencies_hz
        count = len(self._hello.frequencies_hz)
        if len(tones) != count:
            return ReplyCode.BAD_ARGUMENT, f'{count} coils, {len(tones)} frequencies'
        if max(tones) >= self.sample_rate_hz / 2:
            return ReplyCode.BAD_ARGUMENT, 'a frequency above half the sample rate'
        self._hello = replace(self._hello, frequencies_hz=tones)
        self._sampler.set_frequencies(np.array(tones))
        return ReplyCode.OK, ''

    def _status(self) -> DeviceStatus:
        refused = self._reader.counters
        return DeviceStatus(
            self._state,
            StatusFlag.OVERRUN if self._dropped else StatusFlag(0),
            self._ticks(self._sample),
            self._dropped,
            refused.bad_header + refused.bad_crc + refused.bad_payload + refused.unknown_type,
            31.5,
        )

    def _ticks(self, sample: int) -> int:
        return round(sample / self.sample_rate_hz * TICK_HZ)

    def _piece(self, payload: Payload) -> Piece:
        return Piece(encode(payload))


def _hello(world: World, front: FrontEnd, block_samples: int, nominal_a: float) -> Hello:
    numbers = [sensor.channel for sensor in world.sensors]
    channels = [Channel(n, ChannelKind.SENSE, front.full_scale_v) for n in numbers]
    current = Channel(max(numbers) + 1, ChannelKind.CURRENT, front.full_scale_a)
    tones = world.setup.frequencies_hz
    return Hello(
        NAME,
        front.sample_rate_hz,
        TICK_HZ,
        block_samples,
        (*channels, current),
        tones,
        (nominal_a,) * len(tones),
    )
