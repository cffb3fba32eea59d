"""Turns one connection's samples into fluxes: blocks are cut into windows, these demodulated and
converted to tesla (`FluxStream`); frames wait until their stamps are good.
`MeasuredAccuracy` measures noise and the stamps' uncertainty for the setup document.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter

import numpy as np

from anser_ros.arrays import Array, Booleans, ComplexArray, Integers
from anser_ros.errors import FitError, SetupError
from anser_ros.nodes.streams.clouds import FLUX_NOISE, STAMP_SIGMA
from anser_ros.settings import Accuracy
from anser_ros.signals.clock import SampleClock
from anser_ros.signals.demodulation import (
    BegunFit,
    Demodulator,
    FluxConverter,
    FluxRates,
    FluxWindow,
)
from anser_ros.signals.repetition import RepetitionWatch
from anser_ros.signals.window import TickCheck, Window, WindowCutter
from anser_ros.wire.channel_calibration import ChannelCalibration
from anser_ros.wire.frames import FULL_SCALE_CODE, ChannelKind, Hello, SampleBlock
from anser_ros.wire.points import DROPPED, SATURATED, STALE, FluxPoints
from anser_ros.wire.setup import FIELD_GENERATOR, SensorRows, Setup

LAST_S = 4e-3
"""Time, s, before the end of a window at which the samples that are there are looked at."""
PATIENCE_NS = 300_000_000
"""Host time (0.3 s) that a frame waits for its stamp to be confirmed: the host stalls for less."""


@dataclass(frozen=True)
class Staleness:
    """Says why sensors are stale; each array has a place for each of them, shape (S,)."""

    age_s: Array
    noiseless: Booleans

    def __or__(self, later: Staleness) -> Staleness:
        """What holds of one or the other; of two ages that of the later counts."""
        age_s = np.where(later.age_s > 0, later.age_s, self.age_s)
        return Staleness(age_s, self.noiseless | later.noiseless)


@dataclass(frozen=True)
class FluxFrame:
    """Holds the fluxes of one window."""

    tool: FluxPoints
    reference: FluxPoints
    host_ns: int
    window: FluxWindow
    flags: Integers
    staleness: Staleness
    repeats: bool = False


class FluxStream:
    """Turns samples into fluxes, for one hello of the control unit.

    ``sensors`` are those of the setup that the unit has a channel for, tools first, ``missing``
    the others; ``rate_hz`` is windows a second, a whole number of samples apart; ``block_s`` is
    the length of a block, s; ``clock`` and ``ticks`` are host time of the samples, and what the
    device's own clock says beside them. Frames wait until a block that was in time has confirmed
    their stamps; on a punctual line none waits. One that nothing confirms for `PATIENCE_NS` is
    ``withheld``, which counts these.

    Raises `SetupError` when the unit has none of the channels, or other emitters than the setup,
    and `ParameterError` when the window cannot be demodulated.
    """

    def __init__(
        self, hello: Hello, setup: Setup, calibration: ChannelCalibration, window_s: float,
        rate_hz: float, mains_hz: float = 0.0,
    ) -> None:  # fmt: skip
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
        # Currents that the setup's field is given for; the control unit's where it says nothing.
        self.nominal_a = np.array(hello.currents_a, dtype=np.float64)
        current = setup.emitter.geometry.get('current_a')
        if isinstance(current, (int, float)) and current > 0:
            self.nominal_a[:] = current
        rate = hello.sample_rate_hz
        window = round(window_s * rate)
        hop = max(1, round(rate / rate_hz))
        self.rate_hz = rate / hop
        self._sample_rate_hz = rate
        self._block_samples = hello.block_samples
        self.block_s = hello.block_samples / rate
        self._demodulator = Demodulator(rate, self.tones_hz, window, mains_hz=mains_hz or None)
        self._current_column = [c.kind for c in hello.channels].index(ChannelKind.CURRENT)
        self._columns = np.array([columns[s.channel] for s in self.sensors])
        self._converter = self._converter_of(hello, calibration)
        # Windows too short to follow motion take it from the windows before.
        self._rates = None if self._demodulator.follows_motion else FluxRates()
        self._watch = RepetitionWatch(len(hello.channels), rate, self.tones_hz)
        self._repeats = False
        # What is known of the next window before it is complete, and its middle in samples
        self._begun: tuple[float, BegunFit] | None = None
        self.ticks = TickCheck(rate, hello.tick_hz)
        self._cutter = WindowCutter(window, hop, self._watch, self.ticks)
        self.counters = self._cutter.counters
        self.clock = SampleClock(rate)
        self._asked_ns: int | None = None
        # Each with its middle and end in samples, and when its last block arrived, ns.
        self._waiting: deque[tuple[FluxFrame, float, float, int]] = deque()
        self.withheld = 0
        self._split = sum(s.body != FIELD_GENERATOR for s in self.sensors)
        self._tool = SensorRows.of(self.sensors[: self._split], fixed_only=True)
        self._reference = SensorRows.of(self.sensors[self._split :], fixed_only=True)

    def counts(self) -> dict[str, int]:
        return {
            **vars(self.counters),
            'windows_withheld': self.withheld,
            'clock_jumps': self.clock.jumps,
            'tick_faults': self.ticks.disagreements,
        }

    @property
    def blocks_wanted(self) -> int:
        """Return how many blocks until a frame may be ready, one while frames wait for it; or
        until `LAST_S` before that, so that little is left to be done when the last ones come.
        """
        if self._waiting:
            return 1
        wanted = -(-self._cutter.samples_wanted // self._block_samples)
        last = math.ceil(LAST_S / self.block_s)
        return wanted - last if wanted > 2 * last else wanted

    def restart(self, sent_ns: int | None) -> None:
        """Start again: the device has answered a start, sent at a host time, with sample 0."""
        self._cutter.reset()
        self._end_stream()
        if sent_ns is not None:
            self.clock.bound(0, sent_ns)

    def answered(self, sent_ns: int) -> None:
        """Take in that the device has just answered a command that was sent at a host time.

        It took the next block's last sample later; blocks between the two may be lost.
        """
        self._asked_ns = sent_ns

    def run_length(self, blocks: Sequence[SampleBlock]) -> int:
        """Return how many blocks to push at once: they follow, up to the end of a window."""
        first, shape = blocks[0].sequence, (self._block_samples, self._cutter.columns)
        if self._cutter.expected != first:
            return 1
        for rank, block in enumerate(blocks[: self.blocks_wanted]):
            if block.sequence != first + rank or block.codes.shape != shape:
                return max(rank, 1)
        return min(len(blocks), self.blocks_wanted)

    def push(
        self, blocks: Sequence[SampleBlock], arrivals_ns: Sequence[int], *, skips: bool = False
    ) -> list[FluxFrame]:
        """Take a run of blocks and return the frames that are complete and have good stamps.

        If it ``skips``, a complete window is only counted, in favour of newer ones.
        """
        first, arrival_ns = blocks[0], arrivals_ns[-1]
        if first.codes.shape[1] != self._cutter.columns:
            return []
        restarts, before, repeated = self.counters.restarts, self._cutter.end_sample, self._repeats
        codes = np.concatenate([b.codes for b in blocks]) if len(blocks) > 1 else first.codes
        ticks = [block.timestamp_ticks for block in blocks]
        windows = self._cutter.push(first.sequence, ticks, codes)
        self._repeats = self._watch.repeats
        if self.counters.restarts != restarts:
            self._end_stream()
        if not windows:  # the rest of the window is still to come
            self._watch.search()
            self._begin()
        # What comes twice says nothing about now, and of blocks read together the newest says all.
        newest = self._cutter.end_sample
        if self._asked_ns is not None and newest != before:
            self.clock.bound(newest - (len(blocks) - 1) * self._block_samples, self._asked_ns)
            self._asked_ns = None
        for left in range(len(blocks) - 1, 0, -1):
            if arrivals_ns[-left - 1] != arrivals_ns[-left] and not repeated:
                self.clock.observe(newest - left * self._block_samples, arrivals_ns[-left - 1])
        if newest != before and not self._repeats:
            self.clock.observe(newest, arrival_ns)
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
            self._waiting.append((frame, window.middle_sample, end, arrival_ns))
        return self._released(arrival_ns)

    def _released(self, now_ns: int) -> list[FluxFrame]:
        """Return the frames that need not wait any longer, stamped."""
        clock, frames = self.clock, []
        while self._waiting:
            frame, middle, end, arrival_ns = self._waiting[0]
            # What repeats itself is marked so; its stamp need not be better than the line is.
            is_good = clock.is_good(end) or (frame.repeats and clock.is_settled)
            if not is_good and now_ns - arrival_ns < PATIENCE_NS:
                break
            self._waiting.popleft()
            if is_good:
                frames.append(replace(frame, host_ns=clock.host_ns(middle)))
            else:
                self.withheld += 1
        return frames

    def _end_stream(self) -> None:
        """Withhold all that wait, whose samples belong to a stream that has ended."""
        self.withheld += len(self._waiting)
        self._waiting.clear()
        self._begun = self._asked_ns = None
        self.clock.restart()

    def _converter_of(self, hello: Hello, calibration: ChannelCalibration) -> FluxConverter:
        per_code = np.array([channel.full_scale / FULL_SCALE_CODE for channel in hello.channels])
        numbers = [sensor.channel for sensor in self.sensors]
        return FluxConverter(
            self.tones_hz,
            self._columns,
            per_code[self._columns],
            calibration.areas_m2(numbers),
            calibration.delays_s(numbers),
            current_column=self._current_column,
            amperes_per_code=float(per_code[self._current_column]),
            nominal_currents_a=self.nominal_a,
            current_delay_s=calibration.current_delay_s,
        )

    def _begin(self) -> None:
        """Begin to demodulate the next window, once, when little of it is still to come."""
        cutter, begun = self._cutter, self._begun
        middle = cutter.end_sample + cutter.samples_wanted - cutter.window / 2
        is_near = cutter.samples_wanted <= LAST_S * self._sample_rate_hz
        if is_near and (begun is None or begun[0] != middle):
            self._begun = middle, self._demodulator.begin(cutter.coming())

    def _frame(self, window: Window) -> FluxFrame:
        middle, begun = self._begun or (0.0, None)
        begun = begun if middle == window.middle_sample else None
        fit = self._demodulator.demodulate(window.codes, window.present, begun)
        rates, middle_s = self._rates, window.middle_sample / self._sample_rate_hz
        converted = self._converter.convert(fit, None if rates is None else rates.at(middle_s))
        if rates is not None:
            rates.add(middle_s, converted.flux)
        staleness = self._staleness(window)
        saturated = window.saturated[self._columns]
        stale = window.stuck[self._columns] | window.stuck[self._current_column]
        stale |= ((staleness.age_s > 0) | staleness.noiseless) & ~saturated
        flags: Integers = saturated * SATURATED | stale * STALE
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


def _points(rows: SensorRows, flux: ComplexArray, flags: Integers) -> FluxPoints:
    return FluxPoints(rows.channel, flags, flux, rows.position, rows.axis)


EARLIEST_S = 10.0
"""Least time, s, between setup documents that only state another uncertainty of the stamps."""
_FACTOR = 2.0
"""Ratio to the published uncertainty of the stamps from which it is published again."""


class MeasuredAccuracy:
    """Follows the noise of a stream's first fluxes, and the uncertainty of its stamps."""

    def __init__(self) -> None:
        self._noise_t: float | None = None
        self._begun_s = -math.inf
        self._stated_s = Accuracy.stamp_sigma_s
        self._squares = 0.0
        self._frames = 0

    def must_republish(self, frame: FluxFrame, sigma_s: float, now_s: float) -> bool:
        """Take a frame with its stamp's uncertainty; return whether to publish the setup again."""
        if math.isfinite(sigma_s):
            self._squares += sigma_s**2
            self._frames += 1
        if self._noise_t is None:
            noise = frame.window.sigma[np.isfinite(frame.window.sigma)]
            self._noise_t = float(np.median(noise)) if noise.size else 0.0
            self._begun_s = now_s
            return True
        if now_s - self._begun_s < EARLIEST_S or not self._frames:
            return False
        mean_s = math.sqrt(self._squares / self._frames)
        self._begun_s, self._squares, self._frames = now_s, 0.0, 0
        if 1 / _FACTOR <= mean_s / self._stated_s <= _FACTOR:
            return False
        self._stated_s = float(f'{mean_s:.1g}')
        return True

    def stated_in(self, setup: Setup, rate_hz: float) -> Setup:
        """Return the setup with the stream's true rate and what was measured."""
        measured: dict[str, float] = {}
        if self._noise_t:
            measured[FLUX_NOISE] = float(f'{self._noise_t:.2g}')
        if self._stated_s != Accuracy.stamp_sigma_s:
            measured[STAMP_SIGMA] = self._stated_s
        return replace(setup, flux_rate_hz=rate_hz, extra={**setup.extra, **measured})


_TRIES = 5
"""Readings of both clocks of which the closest together counts: a thread may wait between two."""
_CLOSE_NS = 20_000
"""Time (20 us) from one reading to the next that is close enough to try no more."""
_STEP_NS = 5_000_000
"""Change of the difference (5 ms) that is a setting: a slewed clock moves 0.5 ms a second."""


class WallClock:
    """Converts monotonic times to the system's time, which may be set while we run.

    ``sets`` counts how often that happened.
    """

    def __init__(
        self,
        wall_ns: Callable[[], int] = time.time_ns,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._wall_ns, self._monotonic_ns = wall_ns, monotonic_ns
        self._offset_ns: int | None = None
        self.sets = 0

    def offset_ns(self) -> int:
        """Return the system's time minus the monotonic time now, ns."""
        best = math.inf, 0
        for _ in range(_TRIES):
            before_ns = self._monotonic_ns()
            wall_ns = self._wall_ns()
            width_ns = self._monotonic_ns() - before_ns
            best = min(best, (width_ns, wall_ns - before_ns - width_ns // 2), key=itemgetter(0))
            if width_ns <= _CLOSE_NS:
                break
        offset_ns = best[1]
        if self._offset_ns is not None and abs(offset_ns - self._offset_ns) > _STEP_NS:
            self.sets += 1
        self._offset_ns = offset_ns
        return offset_ns
