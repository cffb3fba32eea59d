"""Simulates the line between control unit and host: a pseudo-terminal, and its faults."""

import contextlib
import os
import select
import time
import tty
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from anser_ros.errors import PortError
from anser_ros.parallel import hold
from anser_ros.simulation.control_unit import Piece

NONE = 'none'
UNPLUG = 'unplug'
OVERRUN = 'overrun'
SATURATION = 'saturation'
FAULTS = (
    NONE, 'bad_crc', 'gap', 'garbage', 'wrong_baud', 'silence', UNPLUG, OVERRUN, SATURATION,
)  # fmt: skip
_BURST_BYTES = 700
"""Length of a burst of garbage: about that of a block of samples."""
_LASTS_S = {'wrong_baud': 2.5, 'silence': 2.5, UNPLUG: 1.0, OVERRUN: 0.1, SATURATION: 1.0}
"""Duration of each lasting fault, s. The first two outlast the host's patience."""


class FaultInjector:
    """Damages the records on the line once in every period.

    `bad_crc`, `gap` and `garbage` affect one block, the others last for some time. The owner of
    the unit and of its port has to act on `unplug`, `overrun` (the unit has no room for its
    blocks) and `saturation` (of its first channel) while they last.
    """

    def __init__(self, kind: str = NONE, period_s: float = 5.0, seed: int = 0) -> None:
        self.kind = kind
        self.period_s = period_s
        self._rng = np.random.default_rng(seed)
        self._done = -1

    def lasts(self, time_s: float, kind: str) -> bool:
        """Return whether the lasting fault `kind` is on at a time; each period begins with it."""
        in_period = time_s % self.period_s
        return self.kind == kind and in_period < min(_LASTS_S[kind], self.period_s / 2)

    def apply(self, pieces: Sequence[Piece], time_s: float) -> list[Piece]:
        """Return the records as they arrive."""
        if self.kind in ('bad_crc', 'gap', 'garbage'):
            return self._damage_one(pieces, int(time_s // self.period_s))
        if self.kind == 'silence' and self.lasts(time_s, 'silence'):
            return []
        if self.kind == 'wrong_baud' and self.lasts(time_s, 'wrong_baud'):
            # A receiver at another baud rate gets fewer bytes, all of them wrong.
            return [Piece(self._noise(max(1, len(p.data) // 3)), p.is_block) for p in pieces]
        return list(pieces)

    def _damage_one(self, pieces: Sequence[Piece], period: int) -> list[Piece]:
        first = next((rank for rank, piece in enumerate(pieces) if piece.is_block), None)
        if first is None or period == self._done:
            return list(pieces)
        self._done = period
        if self.kind == 'gap':
            arrived = []
        elif self.kind == 'garbage':
            arrived = [Piece(self._noise(_BURST_BYTES)), pieces[first]]
        else:
            damaged = bytearray(pieces[first].data)
            damaged[len(damaged) // 2] ^= 0x10
            arrived = [Piece(bytes(damaged), is_block=True)]
        return [*pieces[:first], *arrived, *pieces[first + 1 :]]

    def _noise(self, count: int) -> bytes:
        return bytes(self._rng.integers(0, 256, count, dtype=np.uint8))


_PENDING_LIMIT_BYTES = 1 << 20
"""Bytes that wait for the host at most, half a second of samples: a slower host loses blocks."""


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
        with contextlib.suppress(OSError):
            if os.readlink(self.link) == os.ttyname(self._fds[1]):  # no other simulator's by now
                self.link.unlink()
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
