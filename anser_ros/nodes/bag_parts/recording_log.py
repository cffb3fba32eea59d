"""Counts and gaps of the topics while they are recorded."""

import statistics
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from anser_ros.wire.bag_metadata import BagRecord

# Intervals from which a topic's own period is learnt.
LEARNING = 25
# An interval of more than so many usual ones is a gap: less than the two of one lost message.
GAP_FACTOR = 1.5


@dataclass
class TopicLog:
    """Records what arrived of one topic.

    Attributes
    ----------
    n_publishers : int
        How many nodes publish it.
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

    @property
    def faults(self) -> str:
        """Return what is wrong with the topic, in words; empty when nothing is."""
        found = []
        if self.lost:
            found.append(f'{self.lost} lost')
        if self.gaps:
            found.append(f'{self.gaps} gaps up to {self.longest_gap_s:.3g} s')
        if self.jumps_back:
            found.append(f'{self.jumps_back} jumps back in time')
        return ', '.join(found)

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


def report(
    folder: Path, record: BagRecord, logs: Mapping[str, TopicLog]
) -> tuple[str, tuple[str, ...]]:
    """Return the counts of a bag in one short line, and a line for each topic with faults."""
    text = (
        f'{folder}: {record.messages} messages of {len(record.topics)} topics '
        f'in {record.duration_s:.1f} s'
    )
    faulty = {name: log for name, log in sorted(logs.items()) if log.faults}
    if not faulty:
        return f'{text}; no gaps', ()
    found = [
        f'{sum(log.lost for log in faulty.values())} messages lost',
        f'{sum(log.gaps > 0 for log in faulty.values())} topics with gaps',
        f'{sum(log.jumps_back > 0 for log in faulty.values())} that jump back in time',
    ]
    words = ', '.join(word for word in found if not word.startswith('0 '))
    return f'{text}; {words} (named in the log)', tuple(
        f'{name} {log.faults}' for name, log in faulty.items()
    )
