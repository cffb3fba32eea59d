"""Reports the state of line, emitters and sensors, with what is wrong in words."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from anser_ros.nodes.acquisition_stream import FluxFrame, FluxStream, Staleness
from anser_ros.nodes.runtime.diagnostics import Level, Status, named
from anser_ros.signals.clock import LARGEST_LATENESS_S, ClockState
from anser_ros.wire.frames import DeviceStatus, StatusFlag
from anser_ros.wire.points import DROPPED, SATURATED, STALE
from anser_ros.wire.setup import Coil


@dataclass
class Interval:
    """Counts what happened since the last diagnostics."""

    begin_s: float
    frames: int = 0
    delay_sum_s: float = 0.0
    delay_max_s: float = 0.0
    flags: np.ndarray | None = None
    staleness: Staleness | None = None
    repeats: int = 0

    def add(self, frame: FluxFrame, delay_s: float) -> None:
        self.frames += 1
        self.delay_sum_s += delay_s
        self.delay_max_s = max(self.delay_max_s, delay_s)
        flags, now = self.flags, frame.staleness
        if flags is not None and flags.shape == frame.flags.shape:
            self.flags = flags | frame.flags
            self.staleness = self.staleness | now if self.staleness else now
        else:
            self.flags, self.staleness = frame.flags, now
        self.repeats += frame.repeats


MEMORY_S = 5.0
"""How long, s, a fault is remembered: several diagnostics, so that an operator sees it."""
FAULTS = {
    'unplug': 'cable pulled out',
    'silence': 'nothing arrived',
    'unwritten': 'commands that the control unit did not take',
    'wrong_baud': 'bytes but no records: wrong baud rate?',
    'overrun_blocks': 'blocks lost: this computer is too slow',
    'gap_blocks': 'blocks missing in the stream',
    'bad_crc': 'records with a wrong CRC',
    'bad_header': 'records with a damaged header',
    'bad_payload': 'records with a content that makes no sense',
    'wrong_version': 'records of another protocol version',
    'skipped_bytes': 'bytes of garbage',
    'windows_lost': 'windows not published',
    'windows_withheld': 'windows withheld: no stamp was good',
    'clock_jumps': 'the device lost time that it did not count',
    'tick_faults': "the device's ticks and samples disagree",
    'duplicate_blocks': 'blocks that came twice',
    'system_clock_set': "the system's clock was set",
}
"""Counters that only faults raise, the most serious first, with their meaning."""
GRAVE = ('unplug', 'silence', 'wrong_baud')
MOST = 3
"""Faults that are named in one line; the graver ones come first."""


class RecentFaults:
    """Remembers which counters rose, and says so for some seconds.

    Faults before the first look are ignored: a connection may begin in the middle of a record.
    """

    def __init__(self) -> None:
        self._seen: dict[str, int] | None = None
        self._recent: dict[str, tuple[float, int]] = {}

    def note(self, counters: Mapping[str, int], now_s: float) -> dict[str, int]:
        """Return by how much the counters rose since the last look."""
        seen = counters if self._seen is None else self._seen
        self._seen = dict(counters)
        self._recent = {n: r for n, r in self._recent.items() if now_s - r[0] < MEMORY_S}
        rises = {name: count - seen.get(name, 0) for name, count in counters.items()}
        for name, rise in rises.items():
            if rise > 0:
                before = self._recent.get(name, (0.0, 0))[1]
                self._recent[name] = (now_s, before + rise)
        return rises

    @property
    def words(self) -> str:
        """Return the recent faults with their counts, the most serious first; empty if none."""
        found = [name for name in FAULTS if name in self._recent]
        parts = [f'{name} {self._recent[name][1]} ({FAULTS[name]})' for name in found[:MOST]]
        return '; '.join(parts)

    @property
    def level(self) -> Level:
        """Return ERROR when the stream stood still, WARN when parts of it were lost."""
        return Level.ERROR if any(name in self._recent for name in GRAVE) else Level.WARN


def device_words(status: DeviceStatus) -> str:
    """Return what the control unit itself complains of, with the count of what it lost."""
    names = [
        str(flag.name).lower().replace('_', ' ') for flag in StatusFlag if flag & status.flags
    ]
    if StatusFlag.OVERRUN & status.flags:
        names.append(f'{status.dropped_blocks} blocks dropped (computer or line too slow)')
    return ', '.join(names)


MOST_NAMES = 4
"""Sensors that are named in one line; of the others the number is given."""
STATES = (
    (STALE, Level.ERROR, 'stuck', 'all samples of a window are the same'),
    (SATURATED, Level.WARN, 'saturated', ''),
    (DROPPED, Level.WARN, 'samples lost', ''),
)
"""Flag bits of a sensor, the most serious first, with what they mean."""


def signal_troubles(
    coils: Sequence[Coil], stream: FluxStream, frame: FluxFrame | None, past: Interval
) -> list[tuple[Level, str]]:
    """Return what is wrong with the signals, by the names of emitters and sensors; lost samples
    apart, which the counters of the line report.
    """
    found = []
    if stream.missing:
        names = named((sensor.name for sensor in stream.missing), MOST_NAMES)
        found.append((Level.WARN, f'the control unit has no channel for {names}'))
    if frame is not None and not frame.window.driven.all():
        pairs = zip(coils, frame.window.driven, strict=True)
        names = named((coil.name for coil, driven in pairs if not driven), MOST_NAMES)
        found.append((Level.ERROR, f'no current in {names}'))
    if past.flags is None or len(past.flags) != len(stream.sensors):
        return found
    for bit, level, word, _ in STATES[:2]:
        bad: dict[str, list[str]] = {}  # those of one reason together
        for row in np.flatnonzero(past.flags & bit).tolist():
            why = _why_stale(past.staleness, row) if bit == STALE else ''
            bad.setdefault(why, []).append(stream.sensors[row].name)
        for why, names_of in bad.items():
            found.append((level, f'{word}: {named(names_of, MOST_NAMES)} {why}'.strip()))
    return found


def _why_stale(staleness: Staleness | None, row: int) -> str:
    """What a stale sensor does; empty where it is constant."""
    if staleness is not None and staleness.age_s[row] > 0:
        return f'repeats its samples of {staleness.age_s[row]:.2g} s ago'
    if staleness is not None and staleness.noiseless[row]:
        return 'has no noise that distinguishes new samples from old'
    return ''


def clock_troubles(stream: FluxStream) -> list[tuple[Level, str]]:
    """Return what is wrong with the stamps, and with the device's own clock."""
    clock, found = stream.clock, []
    if clock.is_doubted and clock.lateness_s > LARGEST_LATENESS_S:
        words = f'clock: everything arrives {clock.lateness_s:.2g} s late'
        found.append((Level.WARN, words))
    elif clock.state is ClockState.SETTLING and stream.withheld:
        found.append((Level.WARN, 'clock: settling, no stamp is good yet'))
    if stream.ticks.words:
        words = f"clock: the device's ticks {stream.ticks.words}; stamps follow its samples"
        found.append((Level.WARN, words))
    return found


def emitter_statuses(coils: Sequence[Coil], stream: FluxStream, frame: FluxFrame) -> list[Status]:
    """Return a status with amplitude, noise and current of each emitter."""
    window = frame.window
    statuses = []
    for k, coil in enumerate(coils):
        values = {
            'frequency_hz': float(stream.tones_hz[k]),
            'current_a': float(abs(window.current[k])),
            'nominal_current_a': float(stream.nominal_a[k]),
            'current_noise_a': float(window.current_sigma[k]),
            'flux_rms_t': _rms(window.flux[:, k]),
            'flux_noise_t': _rms(window.sigma[:, k]),
        }
        level, state = (Level.OK, 'driven') if window.driven[k] else (Level.ERROR, 'no current')
        statuses.append(Status(f'emitter {coil.name}', level, state, values))
    return statuses


def sensor_statuses(stream: FluxStream, frame: FluxFrame, past: Interval) -> list[Status]:
    """Return state and noise of each sensor, by the flags since the last look."""
    seen = past.flags
    flags = frame.flags if seen is None or len(seen) != len(frame.flags) else seen
    statuses = []
    for row, sensor in enumerate(stream.sensors):
        level, message = Level.OK, 'ok'
        for bit, bad, word, usual in STATES:
            if flags[row] & bit:
                why = _why_stale(past.staleness or frame.staleness, row) if bit == STALE else ''
                level, message = bad, ': '.join(filter(None, [word, why or usual]))
                break
        values = {
            'channel': sensor.channel,
            'flux_rms_t': _rms(frame.window.flux[row]),
            'flux_noise_t': _rms(frame.window.sigma[row]),
        }
        statuses.append(Status(sensor.name, level, message, values))
    return statuses


def _rms(values: np.ndarray) -> float:
    finite = np.abs(values[np.isfinite(values)])
    return float(np.sqrt(np.mean(finite**2))) if finite.size else 0.0
