"""Simulates a control unit: the world's fluxes become samples, and commands become records.

`Sampler` samples the fluxes into the codes of an analogue-to-digital converter; `ControlUnit`
turns the bytes of commands into the bytes of records. It has no clock: its owner passes it the
elapsed time as a number of samples.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.arrays import Array, ComplexArray
from anser_ros.simulation.effects import RawEffect
from anser_ros.simulation.world import World
from anser_ros.wire import frames
from anser_ros.wire.channel_calibration import ChannelCalibration
from anser_ros.wire.protocols import FrameReader

OVERLOAD_GAIN = 1e4
"""Gain of an amplifier under overload: so large that any signal reaches the converter's limits."""


@dataclass(frozen=True)
class FrontEnd:
    """Describes the analogue side of a control unit with its converter."""

    sample_rate_hz: float = 40e3  # samples a second and channel
    full_scale_v: float = 5.0  # voltage at code 32768
    full_scale_a: float = 2.5  # current at code 32768
    noise_codes: float = 2.4  # white noise before the converter, codes rms a sample
    current_noise_codes: float = 0.5  # the same of the currents
    current_drift: float = 0.02  # fraction by which the currents fall while the coils warm up
    warm_up_s: float = 60.0  # time constant of the warming, from the first start on, s


class Sampler:
    """Samples all sensors and the sum of the currents, one stretch of time after the other.

    Within a stretch the phasors change linearly, so that stretches of 5 ms follow a tool at 0.1
    m/s to some 10 pT. ``calibration`` is the channels' true response, ``nominal_current_a`` the
    peak current that the world's fluxes are given for, A.
    """

    def __init__(
        self,
        world: World,
        calibration: ChannelCalibration,
        front_end: FrontEnd,
        nominal_current_a: float,
        *,
        effects: Sequence[RawEffect] = (),
        seed: int = 0,
    ) -> None:
        self._world = world
        self._front_end = front_end
        self._nominal_a = nominal_current_a
        self._effects = tuple(effects)
        self._rng = np.random.default_rng(seed)
        numbers = [sensor.channel for sensor in world.sensors]
        self._areas = calibration.areas_m2(numbers)[:, None]
        self._delays = calibration.delays_s(numbers)[:, None]
        self._current_delay = calibration.current_delay_s
        self._driven_from_s: float | None = None
        self.is_overloaded = False
        self.set_frequencies(np.array(world.setup.frequencies_hz))
        self._last: tuple[float, ComplexArray] | None = None

    def set_frequencies(self, frequencies_hz: Array) -> None:
        """Drive the coils at other tones, shape (K,), Hz, from the next stretch on."""
        self.frequencies_hz = frequencies_hz
        omega = 2 * np.pi * frequencies_hz
        self._volts_per_tesla = 1j * omega * self._areas * np.exp(-1j * omega * self._delays)
        self._current_response = np.exp(-1j * omega * self._current_delay)
        # Each synthesiser starts at another phase, and each coil has another impedance.
        self._start = np.exp(1j * np.arange(1, frequencies_hz.size + 1) ** 2)
        self._last = None

    def drive(self, time_s: float) -> None:
        """Begin to drive the coils at a time (s); later calls change nothing."""
        if self._driven_from_s is None:
            self._driven_from_s = time_s
            self._last = None

    def codes(self, first_sample: int, count: int) -> NDArray[np.int16]:
        """Return the converter codes of `count` samples from `first_sample` since power-up on.

        Returns sensors in the order of the setup, then the sum of currents.
        """
        rate = self._front_end.sample_rate_hz
        begin_s, end_s = first_sample / rate, (first_sample + count) / rate
        begin = (
            self._last[1] if self._last and self._last[0] == begin_s else self._phasors(begin_s)
        )
        end = self._phasors(end_s)
        self._last = (end_s, end)
        time_s = (first_sample + np.arange(count)) / rate
        share = np.arange(count)[:, None] / count
        waves = np.exp(2j * np.pi * time_s[:, None] * self.frequencies_hz)
        basis = np.hstack([waves.real, -waves.imag, share * waves.real, -share * waves.imag])
        change = end - begin
        signals = basis @ np.vstack([begin.T.real, begin.T.imag, change.T.real, change.T.imag])
        volts, current = signals[:, :-1], signals[:, -1]
        for effect in self._effects:
            volts = effect.volts(time_s - self._start_s, volts)
        if self.is_overloaded:
            volts = volts * np.where(np.arange(volts.shape[1]) == 0, OVERLOAD_GAIN, 1.0)
        return self._convert(volts, current)

    @property
    def _start_s(self) -> float:
        """Time at which the coils were first driven, from which warming and effects count."""
        return self._driven_from_s or 0.0

    def _phasors(self, time_s: float) -> ComplexArray:
        """Return the voltages of the sensors and, in the last row, currents; shape (S + 1, K)."""
        flux = self._world.flux(time_s)
        for effect in self._effects:
            flux = effect.flux(time_s - self._start_s, flux)
        current = self.current(time_s)
        volts = flux * self._volts_per_tesla * (current / self._nominal_a)
        return np.vstack([volts, current * self._current_response])

    def current(self, time_s: float) -> ComplexArray:
        """Return the true complex currents of the coils at a time, shape (K,), A."""
        warm = 1 - np.exp((self._start_s - time_s) / self._front_end.warm_up_s)
        return np.asarray(
            self._nominal_a * (1 - self._front_end.current_drift * warm) * self._start
        )

    def _convert(self, volts: Array, current: Array) -> NDArray[np.int16]:
        front = self._front_end
        codes = self._rng.standard_normal((len(volts), volts.shape[1] + 1), np.float32)
        codes[:, :-1] *= front.noise_codes
        codes[:, -1] *= front.current_noise_codes
        codes[:, :-1] += volts * (frames.FULL_SCALE_CODE / front.full_scale_v)
        codes[:, -1] += current * (frames.FULL_SCALE_CODE / front.full_scale_a)
        np.rint(codes, out=codes)
        np.clip(codes, -frames.FULL_SCALE_CODE, frames.FULL_SCALE_CODE - 1, out=codes)
        return codes.astype('<i2')


NAME = 'anser_ros simulated control unit'
"""Name by which the device introduces itself."""
TICK_HZ = 1e6
"""Rate of the device's timestamp counter, Hz: microseconds, as usual in microcontrollers."""
BLOCK_SAMPLES = 40
"""Sampling instants a block, unless a setting says another: 1 ms at the usual rate."""
_COMMANDS = (frames.Identify, frames.Start, frames.Stop, frames.SetFrequencies)


@dataclass(frozen=True)
class Piece:
    """Holds the bytes of one record, with what a port needs to know of it."""

    data: bytes  # the record
    # whether it carries samples; such a record may be dropped when the line is full
    is_block: bool = False
    # number of samples since power-up after which a block is complete; 0 for other records
    end_sample: int = 0


class ControlUnit:
    """Speaks the protocol of `docs/cu_protocol.md`, by its channels' true ``calibration``.

    ``samples`` is the number of samples since power-up.
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
        self._sampler = Sampler(world, calibration, front, nominal_a, effects=effects, seed=seed)
        self._hello = _hello(world, front, block_samples, nominal_a)
        self._reader = FrameReader()
        self.samples = 0
        self._stream_begin = 0
        self._sequence = 0
        self._state = frames.DeviceState.IDLE
        self._dropped = 0
        self._lost_before = False
        self._next_hello = 0

    @property
    def sample_rate_hz(self) -> float:
        """Return the number of samples a second and channel."""
        return self._hello.sample_rate_hz

    @property
    def streaming(self) -> bool:
        """Return whether the unit sends samples."""
        return self._state is frames.DeviceState.STREAMING

    def receive(self, data: bytes) -> list[Piece]:
        """Take bytes from the host and return the records that answer."""
        return [piece for record in self._reader.feed(data) for piece in self._obey(record)]

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
            end = self.samples + samples - self._stream_begin
            lost = max(0, end // block - self._sequence)
            self._sequence += lost
            self._dropped += lost
            self._lost_before = self._lost_before or lost > 0
        self.samples += samples

    def advance(self, samples: int) -> list[Piece]:
        """Let time pass and return the records of that time, in order.

        ``samples``: time in sampling instants; a block is sent once its last sample is taken.
        """
        pieces: list[Piece] = []
        if self.samples >= self._next_hello:
            self._next_hello = self.samples + int(self.sample_rate_hz)
            pieces += [Piece(frames.encode(self._hello)), Piece(frames.encode(self._status()))]
        if self.streaming:
            pieces += self._blocks(samples)
        self.samples += samples
        return pieces

    def _blocks(self, samples: int) -> list[Piece]:
        block = self._hello.block_samples
        begin = self._stream_begin + self._sequence * block
        count = (self.samples + samples - begin) // block
        if count <= 0:
            return []
        codes = self._sampler.codes(begin, count * block)
        pieces = []
        for rank in range(count):
            part = frames.SampleBlock(
                self._sequence % 2**32,
                self._ticks(begin + rank * block),
                codes[rank * block : (rank + 1) * block],
                int(frames.SamplesFlag.LOST_BEFORE) if self._lost_before else 0,
            )
            self._lost_before = False
            self._sequence += 1
            pieces.append(Piece(frames.encode(part), True, begin + (rank + 1) * block))
        return pieces

    def _obey(self, record: frames.Record) -> list[Piece]:
        command = record.payload
        if not isinstance(command, _COMMANDS):
            return []
        code, text, more = frames.ReplyCode.OK, '', []
        if isinstance(command, frames.Start):
            self._state = frames.DeviceState.STREAMING
            self._stream_begin, self._sequence = self.samples, 0
            self._dropped, self._lost_before = 0, False
            self._sampler.drive(self.samples / self.sample_rate_hz)
        elif isinstance(command, frames.Stop):
            self._state = frames.DeviceState.IDLE
        elif isinstance(command, frames.Identify):
            more = [Piece(frames.encode(self._hello))]
        else:
            code, text = self._set_frequencies(command)
            more = [Piece(frames.encode(self._hello))] if code is frames.ReplyCode.OK else []
        reply = frames.encode(frames.Reply(frames.TYPE_OF[type(command)], code, text), record.tag)
        return [Piece(reply), *more]

    def _set_frequencies(self, command: frames.SetFrequencies) -> tuple[frames.ReplyCode, str]:
        tones = command.frequencies_hz
        count = len(self._hello.frequencies_hz)
        if len(tones) != count:
            return frames.ReplyCode.BAD_ARGUMENT, f'{count} coils, {len(tones)} frequencies'
        if max(tones) >= self.sample_rate_hz / 2:
            return frames.ReplyCode.BAD_ARGUMENT, 'a frequency above half the sample rate'
        self._hello = replace(self._hello, frequencies_hz=tones)
        self._sampler.set_frequencies(np.array(tones))
        return frames.ReplyCode.OK, ''

    def _status(self) -> frames.DeviceStatus:
        refused = self._reader.counters
        return frames.DeviceStatus(
            self._state,
            frames.StatusFlag.OVERRUN if self._dropped else frames.StatusFlag(0),
            self._ticks(self.samples),
            self._dropped,
            refused.bad_header + refused.bad_crc + refused.bad_payload + refused.unknown_type,
            31.5,
        )

    def _ticks(self, sample: int) -> int:
        return round(sample / self.sample_rate_hz * TICK_HZ)


def _hello(world: World, front: FrontEnd, block_samples: int, nominal_a: float) -> frames.Hello:
    numbers = [sensor.channel for sensor in world.sensors]
    channels = [frames.Channel(n, frames.ChannelKind.SENSE, front.full_scale_v) for n in numbers]
    current = frames.Channel(max(numbers) + 1, frames.ChannelKind.CURRENT, front.full_scale_a)
    tones = world.setup.frequencies_hz
    return frames.Hello(
        NAME,
        front.sample_rate_hz,
        TICK_HZ,
        block_samples,
        (*channels, current),
        tones,
        (nominal_a,) * len(tones),
    )
