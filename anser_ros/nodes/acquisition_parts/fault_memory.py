"""Remembers faults of the line that happened lately, in words for an operator."""

from collections.abc import Mapping

from anser_ros.nodes.runtime.diagnostics import Level
from anser_ros.wire.records import DeviceStatus, StatusFlag

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

    Faults counted before the first check, while a connection began in the middle of a record, are
    ignored.
    """

    def __init__(self) -> None:
        self._seen: dict[str, int] | None = None
        self._recent: dict[str, tuple[float, int]] = {}

    def note(self, counters: Mapping[str, int], now_s: float) -> None:
        """Compare the counters with those of the last look."""
        seen, self._seen = self._seen, dict(counters)
        self._recent = {n: r for n, r in self._recent.items() if now_s - r[0] < MEMORY_S}
        for name, count in counters.items():
            rise = count - (seen.get(name, 0) if seen is not None else count)
            if rise > 0:
                before = self._recent.get(name, (0.0, 0))[1]
                self._recent[name] = (now_s, before + rise)

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
