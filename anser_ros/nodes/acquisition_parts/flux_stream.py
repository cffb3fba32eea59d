"""Turns one connection's samples into fluxes: windows, demodulation, tesla, flags and stamps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import FitError, SetupError
from anser_ros.nodes.acquisition_parts.flux_frame import FluxFrame, Staleness, WaitingFrames
from anser_ros.signals.clock import SampleClock
from anser_ros.signals.demodulation import Demodulator, ToneFit
from anser_ros.signals.flux import FluxConverter, FluxWindow
from anser_ros.signals.motion import FluxRates
from anser_ros.signals.repetition import RepetitionWatch
from anser_ros.signals.ticks import TickCheck
from anser_ros.signals.window import Window, WindowCutter
from anser_ros.wire.channel_calibration import ChannelCalibration
from anser_ros.wire.points import DROPPED, SATURATED, STALE, FluxPoints
from anser_ros.wire.records import FULL_SCALE_CODE, ChannelKind, Hello, SampleBlock
from anser_ros.wire.setup import FIELD_GENERATOR, SensorRows, Setup


@dataclass(frozen=True)
class StreamOptions:
    """States how to demodulate: window and rate, and what to fit besides the tones."""

    window_s: float
    rate_hz: float
    mains_hz: float = 0.0


class FluxStream:
    """Turns samples into fluxes; it is made again for every hello that differs from the one
    before.

    Raises `SetupError` when the control unit has none of the channels, or other emitters than the
    setup, and `ParameterError` when the window cannot be demodulated.

    Attributes
    ----------
    sensors : those of the setup that the control unit has a channel for, tools first
    missing : those that it has none for
    rate_hz : windows a second, a whole number of samples apart
    clock, ticks : host time of the samples, and what the device's own clock says beside them
    waiting : frames whose stamps are not confirmed yet
    """

    def __init__(
        self, hello: Hello, setup: Setup, calibration: ChannelCalibration, options: StreamOptions
    ) -> None:
        if len(hello.frequencies_hz) != len(setup.emitter.coils):
            raise SetupError(
                f'the control unit drives {len(hello.frequencies_hz)} coils, '
                f'the setup has {len(setup.emitter.coils)}'
            )
        columns = {
            channel.number: column
            for column, channel in enumerate(hello.channels)
            if channel.kind is ChannelKind.SENSE
        }
        wanted = (*setup.tool_sensors, *setup.reference_sensors)
        self.sensors = tuple(s for s in wanted if s.channel in columns)
        self.missing = tuple(s for s in wanted if s.channel not in columns)
        if not self.sensors:
            raise SetupError('the control unit has none of the channels of the setup')
        self.tones_hz = np.array(hello.frequencies_hz)
        self.nominal_a = _nominal_currents(setup, hello)
        rate = hello.sample_rate_hz
        window = round(options.window_s * rate)
        hop = max(1, round(rate / options.rate_hz))
        self.rate_hz = rate / hop
        self._sample_rate_hz = rate
        self._block_samples = hello.block_samples
        self._demodulator = Demodulator(
            rate, self.tones_hz, window, mains_hz=options.mains_hz or None
        )
        self._converter = _converter(hello, self, columns, calibration)
        self._rates = None if self._demodulator.follows_motion else FluxRates()
        watch = RepetitionWatch(len(hello.channels), rate, self.tones_hz)
        self.ticks = TickCheck(rate, hello.tick_hz)
        self._cutter = WindowCutter(window, hop, watch, self.ticks)
        self._watch = watch
        self.counters = self._cutter.counters
        self.clock = SampleClock(rate)
        self.waiting = WaitingFrames(self.clock)
        self._current_column = _current_column(hello)
        self._newest: Window | None = None
        self._columns = np.array([columns[s.channel] for s in self.sensors])
        self._split = sum(s.body != FIELD_GENERATOR for s in self.sensors)
        self._tool = SensorRows.of(self.sensors[: self._split], fixed_only=True)
        self._reference = SensorRows.of(self.sensors[self._split :], fixed_only=True)

    @property
    def blocks_wanted(self) -> int:
        """Return how many blocks until a frame may be ready: one while frames wait for it."""
        if self.waiting:
            return 1
        return -(-self._cutter.samples_wanted // self._block_samples)

    def restart(self, sent_ns: int | None) -> None:
        """Start again: the device has answered a start, sent at a host time, with sample 0."""
        self.waiting.forget()
        self._cutter.reset()
        self.clock.restart()
        if sent_ns is not None:
            self.clock.bound(0, sent_ns)

    def answered(self, sent_ns: int) -> None:
        """Take in that the device has just answered a command that was sent at a host time."""
        self.clock.bound(self._cutter.end_sample + self._block_samples, sent_ns)

    def push(self, block: SampleBlock, arrival_ns: int, *, skips: bool = False) -> list[FluxFrame]:
        """Take a block and return the frames that are complete and whose stamps are good.

        A frame may wait for its stamp, and be withheld; see `WaitingFrames`. If it ``skips``, a
        complete window is only counted, in favour of newer ones.
        """
        if block.codes.shape[1] != self._cutter.columns:
            return []
        restarts, before = self.counters.restarts, self._cutter.end_sample
        windows = self._cutter.push(block.sequence, block.timestamp_ticks, block.codes)
        if self.counters.restarts != restarts:
            self.waiting.forget()
            self.clock.restart()
        # What comes twice says nothing about now.
        if self._cutter.end_sample != before and not self._watch.repeats:
            self.clock.observe(self._cutter.end_sample, arrival_ns)
        for window in windows:
            if skips:
                self.counters.windows -= 1
                self.counters.windows_skipped += 1
                continue
            try:
                frame = self._frame(window)
            except FitError:
                self.counters.windows -= 1
                self.counters.windows_lost += 1
                continue
            end = window.middle_sample + len(window.codes) / 2
            self.waiting.add(frame, window.middle_sample, end, arrival_ns)
        return self.waiting.release(arrival_ns)

    def warm_up(self) -> None:
        """Demodulate the newest window again, only to keep caches warm; see `Acquisition`."""
        if self._newest is not None:
            fit = self._demodulator.demodulate(self._newest.codes, self._newest.present)
            self._converter.convert(fit)

    def _frame(self, window: Window) -> FluxFrame:
        self._newest = window
        fit = self._demodulator.demodulate(window.codes, window.present)
        converted = self._converted(fit, window.middle_sample / self._sample_rate_hz)
        staleness = self._staleness(window)
        saturated = window.saturated[self._columns]
        stale = window.stuck[self._columns] | window.stuck[self._current_column]
        stale |= ((staleness.age_s > 0) | staleness.noiseless) & ~saturated
        flags: NDArray[np.int64] = saturated * SATURATED | stale * STALE
        if window.dropped:
            flags |= DROPPED
        split = self._split
        return FluxFrame(
            _points(self._tool, converted.flux[:split], flags[:split]),
            _points(self._reference, converted.flux[split:], flags[split:]),
            0,
            converted,
            flags,
            staleness,
            window.repeats,
        )

    def _staleness(self, window: Window) -> Staleness:
        """Why sensors are stale: with the currents all are, since fluxes are divided by them."""
        # What is constant is stuck without further words.
        ages = np.where(window.stuck, 0, window.ages)
        noiseless = window.noiseless & ~window.stuck
        current = self._current_column
        age = np.where(ages > 0, ages, ages[current])[self._columns]
        return Staleness(
            age / self._sample_rate_hz, (noiseless | noiseless[current])[self._columns]
        )

    def _converted(self, fit: ToneFit, middle_s: float) -> FluxWindow:
        """Fluxes of a fit; one too short to follow motion takes it from the windows before."""
        if self._rates is None:
            return self._converter.convert(fit)
        converted = self._converter.convert(fit, self._rates.at(middle_s))
        self._rates.add(middle_s, converted.flux)
        return converted


def _points(
    rows: SensorRows, flux: NDArray[np.complex128], flags: NDArray[np.int64]
) -> FluxPoints:
    return FluxPoints(rows.channel, flags, flux, rows.position, rows.axis)


def _current_column(hello: Hello) -> int:
    """Column of the sum of the emitters' currents."""
    return [channel.kind for channel in hello.channels].index(ChannelKind.CURRENT)


def _nominal_currents(setup: Setup, hello: Hello) -> NDArray[np.float64]:
    """Currents that the setup's field is given for; the control unit's where it says nothing."""
    current = setup.emitter.geometry.get('current_a')
    if isinstance(current, (int, float)) and current > 0:
        return np.full(len(hello.currents_a), float(current))
    return np.array(hello.currents_a)


def _converter(
    hello: Hello, stream: FluxStream, columns: dict[int, int], calibration: ChannelCalibration
) -> FluxConverter:
    per_code = np.array([channel.full_scale / FULL_SCALE_CODE for channel in hello.channels])
    current = _current_column(hello)
    numbers = [sensor.channel for sensor in stream.sensors]
    chosen = np.array([columns[number] for number in numbers])
    return FluxConverter(
        stream.tones_hz,
        chosen,
        per_code[chosen],
        calibration.areas_m2(numbers),
        calibration.delays_s(numbers),
        current_column=current,
        amperes_per_code=float(per_code[current]),
        nominal_currents_a=stream.nominal_a,
        current_delay_s=calibration.current_delay_s,
    )
