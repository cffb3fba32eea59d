"""Converts stamps: whole nanoseconds, from a ROS message and back, and what makes them seconds."""

import struct
import time
from datetime import UTC, datetime
from enum import Enum
from typing import Any

NANO = 1e-9
"""Seconds in a nanosecond."""

SECOND_NS = 1_000_000_000
"""Nanoseconds in a second."""

JUMP_NS = SECOND_NS
"""A stamp further than this from the last one, ns, is not late or lost but a jump: a replay begins
again, a clock was set, or a silence. It is as old as a good pose may be to start the next from."""

LIVE_WITHIN_S = 60.0
"""A stamp further than this from the host's clock, s, is a recording's; hosts agree far better."""


class Order(Enum):
    """Says how a stamp follows the last one of its stream."""

    NEXT = 'next'
    SAME = 'same'
    LATE = 'late'
    """Before the last one, by at most `JUMP_NS`."""
    BACK = 'back'
    """Farther before the last one: a replay that begins again, or a clock that was set."""
    AHEAD = 'ahead'
    """Farther after the last one than a stream may pause."""


def order_of(stamp_ns: int, last_ns: int, jump_ns: int = JUMP_NS) -> Order:
    """Return how a stamp follows the last one (0: none), ns; ``jump_ns`` is the longest pause."""
    if last_ns == 0 or last_ns < stamp_ns <= last_ns + jump_ns:
        return Order.NEXT
    if stamp_ns > last_ns:
        return Order.AHEAD
    if stamp_ns == last_ns:
        return Order.SAME
    return Order.LATE if stamp_ns >= last_ns - JUMP_NS else Order.BACK


def stamp_of(message: Any) -> int:
    """Return the header stamp of a message, whoever decoded it, ns."""
    stamp = message.header.stamp
    return int(stamp.sec) * SECOND_NS + int(stamp.nanosec)


def set_stamp(stamp: Any, stamp_ns: int) -> None:
    """Write a stamp, ns, into a message's ``builtin_interfaces/Time``."""
    stamp.sec, stamp.nanosec = divmod(stamp_ns, SECOND_NS)


_STAMP, _STAMP_OFFSET = struct.Struct('<iI'), 4
"""How and where the bytes of a message with a header have its stamp."""


def pack_stamp(message: bytearray, stamp_ns: int) -> None:
    """Write a stamp, ns, into the bytes of a message that begins with a header."""
    _STAMP.pack_into(message, _STAMP_OFFSET, *divmod(stamp_ns, SECOND_NS))


def is_live(stamp_ns: int, now_ns: int) -> bool:
    """Return whether a stamp, ns, is of now by the host's clock, and not a recording's."""
    return abs(now_ns - stamp_ns) < LIVE_WITHIN_S * SECOND_NS


LATEST_NS = 2**31 * SECOND_NS - 1
"""Latest stamp, ns, that a ROS message holds: of 2038-01-19."""
LAST_DAY_S = 253_402_214_400  # 9999-12-31, the last that a date can be
EPOCHS = {
    '1904 (LabVIEW)': -2_082_844_800, '1900 (NTP)': -2_208_988_800,
    '1601 (Windows)': -11_644_473_600, 'the year 1 (.NET)': -62_135_596_800,
}  # fmt: skip
"""Where other programs begin to count seconds, s, by the usual zero of 1970."""
RECENT_NS = 946_684_800 * SECOND_NS
"""Start of the year 2000, ns: a recording's stamps are not before."""
EPOCHS_OF_DAYS = {'1899-12-30 (Excel)': -2_209_161_600, 'year 0 (MATLAB)': -62_167_305_600}
"""Where programs begin that count days, s."""


def stamp_fault(first_ns: int, last_ns: int, of_days: bool = False) -> str:
    """Return why times, ns, or ``of_days``, are no stamps, and the remedy; empty if they are."""
    if first_ns >= 0 and last_ns <= LATEST_NS:
        return ''
    if first_ns < 0:
        words = 'cannot be stamps of a bag: before 1970; start_ns or --shift adds a start'
        return f'times of {first_ns * NANO:g} s {words}'
    day = datetime.fromtimestamp(min(first_ns // SECOND_NS, LAST_DAY_S), UTC)
    words = f'times of {day:%Y-%m-%d}, beyond what a ROS stamp holds (2038-01-19)'
    for name, start_s in (EPOCHS_OF_DAYS if of_days else EPOCHS).items():
        start_ns = start_s * SECOND_NS
        # What was recorded was not recorded later than now.
        if first_ns + start_ns >= RECENT_NS and last_ns + start_ns <= time.time_ns():
            remedy = f'start_ns: {start_ns}, or import_poses --shift {start_s}'
            return f'{words}: {"days" if of_days else "seconds"} since {name}? {remedy}'
    return f'{words}; they cannot be stamps of a bag: is the unit of time right?'
