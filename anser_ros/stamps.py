"""Stamps: whole nanoseconds, from a ROS message and back, and what turns them into seconds."""

from typing import Any

NANO = 1e-9
"""Seconds in a nanosecond."""

SECOND_NS = 1_000_000_000
"""Nanoseconds in a second."""


def stamp_of(message: Any) -> int:
    """Return the header stamp of a message, whoever decoded it, ns."""
    stamp = message.header.stamp
    return int(stamp.sec) * SECOND_NS + int(stamp.nanosec)


def set_stamp(stamp: Any, stamp_ns: int) -> None:
    """Write a stamp, ns, into a message's ``builtin_interfaces/Time``."""
    stamp.sec, stamp.nanosec = divmod(stamp_ns, SECOND_NS)
