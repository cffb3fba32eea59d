"""Opens one serial line by pyserial, reads as fast as it can, and puts its errors into words."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import select
from collections.abc import Callable

import serial

from anser_ros.errors import PortError

_READ_TIMEOUT_S = 0.05
"""Longest time that a read waits, s, before the thread looks whether it has to end."""
_WRITE_TIMEOUT_S = 0.2
"""Longest time that a write may take, s; commands are short, so that a longer one is a fault."""
_READ_BYTES = 1 << 16
"""Largest number of bytes of one read: more than a line of 12 Mbaud brings in 50 ms."""
OPEN_FAILURES = {
    errno.EAGAIN: 'another program uses it',
    errno.EBUSY: 'another program uses it',
    errno.ENOTTY: 'it is not a serial port',
    errno.EACCES: 'no permission (is the user in its group, often dialout?)',
}
"""Plain words for messages of the operating system."""


def open_line(device: str, baud: int) -> serial.SerialBase:
    """Open a port; raises `PortError` with the reason in a few words."""
    try:
        return serial.serial_for_url(
            device,
            baudrate=baud,
            timeout=_READ_TIMEOUT_S,
            write_timeout=_WRITE_TIMEOUT_S,
            exclusive=True,
        )
    except (serial.SerialException, OSError, ValueError, LookupError) as error:
        # pyserial raises LookupError for options of a URL that it does not know
        raise PortError(f'cannot open {device}: {cause_of(error)}') from error


def cause_of(error: BaseException) -> str:
    """Return the reason in a few words, since pyserial quotes the system several times."""
    root = error
    while isinstance(root.__context__, Exception):
        root = root.__context__
    if len(root.args) == 2 and isinstance(root.args[0], int):
        return OPEN_FAILURES.get(root.args[0], str(root.args[1]))
    return ' '.join(str(root).split()) or type(root).__name__


def receiver_of(port: serial.SerialBase) -> Callable[[], bytes]:
    """Return a function that waits for bytes and takes all there are; empty when time is over.

    pyserial's own read costs several system calls and an extra byte for every wake-up, which at a
    thousand blocks a second is most of the work. With a file descriptor, two calls are enough. A
    terminal hands out four kilobytes at a time; all that is there is taken before any of it is
    looked at, so that nothing waits for the work on what came before it.
    """
    try:
        descriptor = port.fileno()
    except (AttributeError, OSError, io.UnsupportedOperation):
        return lambda: bytes(port.read(port.in_waiting or 1))

    def receive() -> bytes:
        if not select.select([descriptor], [], [], _READ_TIMEOUT_S)[0]:
            return b''
        data = os.read(descriptor, _READ_BYTES)
        if not data:
            raise serial.SerialException('the device is gone')
        while len(data) < _READ_BYTES and select.select([descriptor], [], [], 0.0)[0]:
            more = os.read(descriptor, _READ_BYTES)
            if not more:
                break  # the next read will find it gone
            data += more
        return data

    return receive


def close_line(port: serial.SerialBase) -> None:
    """Close a port, whatever has become of it."""
    with contextlib.suppress(serial.SerialException, OSError):
        port.close()
