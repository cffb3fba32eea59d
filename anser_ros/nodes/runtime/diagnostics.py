"""Reports what a node says of itself: statuses, and warnings that do not flood."""

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

HARDWARE_ID = 'anser'
TROUBLE_HELD_S = 10.0
"""How long, s, a trouble is still reported after it was last seen, so that nobody misses it."""


class Level(IntEnum):
    """Names the levels of diagnostic_msgs."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True)
class Status:
    """Holds one line of ``/diagnostics``.

    ``name`` is what it is about, such as ``tool_a/0/x``, and empty for the node itself; in
    ``values`` the unit stands in the name.
    """

    name: str
    level: Level
    message: str
    values: Mapping[str, object] = field(default_factory=dict)


def diagnostic_array(node: str, statuses: Iterable[Status], stamp: Time) -> DiagnosticArray:
    """Return the message of a node's statuses; each is named ``node`` or ``node: part``."""
    message = DiagnosticArray()
    message.header.stamp = stamp
    for status in statuses:
        one = DiagnosticStatus()
        one.level = bytes([int(status.level)])
        one.name = f'{node}: {status.name}' if status.name else node
        one.message = status.message
        one.hardware_id = HARDWARE_ID
        one.values = [
            KeyValue(key=key, value=f'{value:.6g}' if isinstance(value, float) else str(value))
            for key, value in status.values.items()
        ]
        message.status.append(one)
    return message


class LastStatus(NamedTuple):
    """Holds what a node reported last of itself or of a part of it."""

    level: int
    message: str
    values: Mapping[str, str]


def statuses_in(message: DiagnosticArray) -> dict[str, LastStatus]:
    """Return the statuses of a message by ``node`` or ``node: part``."""
    return {
        one.name: LastStatus(
            one.level[0], one.message, {pair.key: pair.value for pair in one.values}
        )
        for one in message.status
    }


def named(names: Iterable[str], most: int) -> str:
    """Return the first few names, and how many more there are."""
    known = list(names)
    more = f' and {len(known) - most} more' if len(known) > most else ''
    return ', '.join(known[:most]) + more


class Trouble:
    """Remembers what went wrong last, and whether that is still news."""

    def __init__(self) -> None:
        self.forget()

    def say(self, words: str, now_s: float) -> None:
        """Take what has just gone wrong, at a monotonic time."""
        self.last, self._at_s = words, now_s

    def recent(self, now_s: float) -> str:
        """Return what went wrong lately; empty when nothing did."""
        return self.last if now_s - self._at_s < TROUBLE_HELD_S else ''

    def forget(self) -> None:
        """Take the trouble for over."""
        self.last, self._at_s = '', -math.inf


MOST_KINDS = 200
"""Kinds of warnings that are told apart: a sender of ever other names must fill no memory."""


class Throttle:
    """Lets the first warning of a kind through whole, and the rest at most once a period."""

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._last_s: dict[str, float] = {}
        self._held_back: Counter[str] = Counter()

    def admit(self, kind: str, text: str, now_s: float) -> str | None:
        """Return the text to log now, or None when this one is held back.

        Warnings of a kind that differ in numbers alone are one to it; times are monotonic.
        """
        kind += re.sub(r'\d+', '', text)
        kind = kind if kind in self._last_s or len(self._last_s) < MOST_KINDS else ''
        last_s = self._last_s.get(kind)
        if last_s is not None and now_s - last_s < self._period_s:
            self._held_back[kind] += 1
            return None
        held = self._held_back.pop(kind, 0)
        self._last_s[kind] = now_s
        return f'{text} ({held} more like it held back)' if held else text
