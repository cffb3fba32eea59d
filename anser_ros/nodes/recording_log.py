"""Counts and gaps of the topics while they are recorded."""

import statistics
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from anser_ros.wire.bag_metadata import BagRecord

# Intervals from which a topic's own period is learnt.
LEARNING = 25
GAP_FACTOR = 1.5


@dataclass
class TopicLog:
    """What arrived of one topic.

    Attributes
    ----------
    lost : int
        Messages that the publisher numbered and that never came; known while there is only one.
    gaps : int
        Intervals between stamps longer than one and a half of the topic's usual ones.
    longest_gap_s : float
    jumps_back : int
        Stamps that lie before the one that came before them.
    """

    n_publishers: int = 1
    lost: int = 0
    gaps: int = 0
    longest_gap_s: float = 0.0
    jumps_back: int = 0
    _sequence: int | None = None
    _stamp_ns: int | None = None
    _intervals_s: list[float] = field(default_factory=list)
    _period_s: float = 0.0

    def publishers(self, count: int) -> None:
        """Note how many publish the topic now."""
        self.n_publishers = max(self.n_publishers, count)

    def add(self, sequence: int | None, stamp_ns: int | None) -> None:
        """Note one message by its publisher's number and its stamp, where it has them."""
        if sequence is not None and self.n_publishers == 1:
            # A smaller number is a publisher that was started again.
            if self._sequence is not None and sequence > self._sequence + 1:
                self.lost += sequence - self._sequence - 1
            self._sequence = sequence
        if stamp_ns is not None:
            if self._stamp_ns is not None:
                self._add_interval((stamp_ns - self._stamp_ns) * 1e-9)
            self._stamp_ns = stamp_ns

    def _add_interval(self, interval_s: float) -> None:
        if interval_s < 0.0:
            self.jumps_back += 1
        elif not self._period_s:
            self._intervals_s.append(interval_s)
            if len(self._intervals_s) == LEARNING:
                self._learn()
        elif interval_s > GAP_FACTOR * self._period_s:
            self._add_gap(interval_s)

    def _learn(self) -> None:
        self._period_s = statistics.median(self._intervals_s)
        for interval_s in self._intervals_s:
            if interval_s > GAP_FACTOR * self._period_s:
                self._add_gap(interval_s)
        self._intervals_s.clear()

    def _add_gap(self, interval_s: float) -> None:
        self.gaps += 1
        self.longest_gap_s = max(self.longest_gap_s, interval_s)


def report(folder: Path, record: BagRecord, logs: Mapping[str, TopicLog]) -> str:
    """Return the counts and gaps of a bag in one line."""
    text = (
        f'{folder}: {record.messages} messages of {len(record.topics)} topics '
        f'in {record.duration_s:.1f} s'
    )
    troubles = []
    for name, log in sorted(logs.items()):
        found = []
        if log.lost:
            found.append(f'{log.lost} lost')
        if log.gaps:
            found.append(f'{log.gaps} gaps up to {log.longest_gap_s:.3g} s')
        if log.jumps_back:
            found.append(f'{log.jumps_back} jumps back in time')
        if found:
            troubles.append(f'{name} {", ".join(found)}')
    return f'{text}; {"; ".join(troubles) or "no gaps"}'
