"""Simulates a serial port: a pseudo-terminal behind a link that keeps its name."""

from __future__ import annotations

import contextlib
import os
import select
import time
import tty
from collections.abc import Sequence
from pathlib import Path

from anser_ros.errors import PortError
from anser_ros.held_names import hold
from anser_ros.simulation.control_unit import Piece

_PENDING_LIMIT_BYTES = 1 << 20
"""Bytes that wait for the host at most, about half a second of samples. A host that is slower
loses blocks instead of falling behind more and more."""


class PseudoPort:
    """Holds the device's end of the line, which never blocks; the host opens the link.

    Raises `PortError` when something other than a link has that path, another simulated device has
    it, or the link cannot be made.
    """

    def __init__(self, link: Path) -> None:
        self.link = link
        self._fds: tuple[int, int] | None = None
        self._pending = b''
        self._holder = hold(f'port {os.path.abspath(link)}')
        if self._holder is None:
            raise PortError(f'{link} is the port of another simulated control unit that runs')
        try:
            self.plug()
        except PortError:
            self._holder.close()
            raise

    @property
    def plugged(self) -> bool:
        """Return whether the cable is plugged in."""
        return self._fds is not None

    def plug(self) -> None:
        """Plug the cable in: a new terminal appears behind the same link."""
        if self.link.exists() and not self.link.is_symlink():
            raise PortError(f'{self.link} exists, but is not a link')
        master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(master, False)
        temporary = self.link.with_name(f'{self.link.name}.{os.getpid()}')
        try:
            temporary.symlink_to(os.ttyname(slave))
            temporary.replace(self.link)
        except OSError as error:
            os.close(master)
            os.close(slave)
            raise PortError(f'cannot make the link {self.link}: {error.strerror}') from error
        self._fds = (master, slave)

    def unplug(self) -> None:
        """Pull the cable out, so that the link disappears."""
        if self._fds is None:
            return
        self._remove_own_link()
        for descriptor in self._fds:
            os.close(descriptor)
        self._fds, self._pending = None, b''

    def close(self) -> None:
        """Pull the cable out for good, and leave the path to others."""
        self.unplug()
        if self._holder is not None:
            self._holder.close()

    def write(self, pieces: Sequence[Piece]) -> int:
        """Send records and return the number of blocks dropped because the line was full."""
        if self._fds is None:
            return sum(piece.is_block for piece in pieces)
        dropped = 0
        parts = [self._pending]
        size = len(self._pending)
        for piece in pieces:
            if size + len(piece.data) > _PENDING_LIMIT_BYTES:
                dropped += piece.is_block
                continue
            parts.append(piece.data)
            size += len(piece.data)
        self._pending = b''.join(parts)
        self._flush()
        return dropped

    def write_all(self, data: bytes) -> None:
        """Send bytes and wait until the line has taken all of them."""
        self._pending += data
        self._flush()
        while self._pending and self._fds is not None:
            select.select([], [self._fds[0]], [], 0.1)
            self._flush()

    def wait(self, timeout_s: float) -> None:
        """Wait until the host sends something or the time is over, and send what is pending.

        The system takes a few kilobytes at a time, so that a port on which nobody waits is slow.
        """
        end = time.monotonic() + timeout_s
        while (left := end - time.monotonic()) > 0:
            if self._fds is None:
                time.sleep(left)
                return
            master = self._fds[0]
            readable, writable, _ = select.select(
                [master], [master] if self._pending else [], [], left
            )
            if writable:
                self._flush()
            if readable:
                return

    def _flush(self) -> None:
        if self._fds is None:
            return
        with contextlib.suppress(BlockingIOError):
            while self._pending:
                self._pending = self._pending[os.write(self._fds[0], self._pending) :]

    def read(self) -> bytes:
        """Return the bytes that the host has sent, possibly none."""
        if self._fds is None:
            return b''
        try:
            return os.read(self._fds[0], 4096)
        except BlockingIOError:
            return b''

    def _remove_own_link(self) -> None:
        """Remove the link, unless another simulator has taken it over."""
        if self._fds is None:
            return
        with contextlib.suppress(OSError):
            if os.readlink(self.link) == os.ttyname(self._fds[1]):
                self.link.unlink()
