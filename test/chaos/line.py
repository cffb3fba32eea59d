"""A man in the middle of the serial line: every record passes through whatever is put on it.

The simulated control unit has one pseudo-terminal, the acquisition opens another; between them a
thread cuts the unit's stream into records and hands them to tampers, which give back what arrives.
"""

import contextlib
import os
import select
import struct
import threading
import time
import tty
import zlib
from collections import deque
from collections.abc import Callable
from pathlib import Path

from anser_ros.simulation.control_unit import TICK_HZ, Piece
from anser_ros.simulation.line import PseudoPort
from anser_ros.wire import frames

Tamper = Callable[[list[bytes], float], list[bytes]]
"""Takes the records that came and the time, s, that it has been on; gives what arrives."""

HELLO, SAMPLES = 0x01, 0x02
"""Numbers of the two types of records that tampers change."""
IDLE_S = 0.002
"""Longest wait for bytes, s: a block lasts as long, so that nothing is late by more."""
SLICE_S = 0.1
"""Slices of time, s, of which the least delay of the unit is kept."""
SLICES = 20
"""Slices before a pose's arrival in which the unit must not have been late: two seconds, in which
the host's clock finds the earliest arrivals again."""
REOPEN_S = 0.05
"""Time between attempts to open the control unit's port, s."""


def kind(record: bytes) -> int:
    """Return the type number of a record."""
    return record[5]


def opened(record: bytes) -> object:
    """Return what a record carries."""
    return frames.decode_payload(
        kind(record), memoryview(record)[frames.HEADER.size : -frames.CRC.size]
    )


def inside(
    *,
    hello: Callable[[frames.Hello], frames.Hello] = lambda given: given,
    block: Callable[[frames.SampleBlock], frames.SampleBlock | None] = lambda given: given,
) -> Tamper:
    """Return a tamper that changes hellos and blocks of samples, or swallows blocks.

    A record whose content comes back as the same object stays as it is, byte for byte.
    """
    changes = {HELLO: hello, SAMPLES: block}

    def tamper(records: list[bytes], _on_s: float) -> list[bytes]:
        out = []
        for record in records:
            if kind(record) in changes:
                given = opened(record)
                changed = changes[kind(record)](given)
                if changed is None:
                    continue
                record = record if changed is given else frames.encode(changed)
            out.append(record)
        return out

    return tamper


def with_crc(body: bytes) -> bytes:
    """Return a record whose last four bytes are its right checksum."""
    return body[: -frames.CRC.size] + frames.CRC.pack(zlib.crc32(body[: -frames.CRC.size]))


class Line:
    """The line between a control unit and a host, by the links of their ports."""

    def __init__(self, unit: Path, host: Path) -> None:
        self._unit_link = unit
        self._port = PseudoPort(host)
        self._unit: int | None = None
        self._rest = b''
        self._tampers: dict[str, tuple[Tamper, float]] = {}
        self._held: deque[bytes] = deque()
        self.is_held = False
        self._lateness: dict[int, float] = {}
        self._lock = threading.Lock()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name='line', daemon=True)
        self._thread.start()

    def put(self, name: str, tamper: Tamper) -> None:
        """Put a tamper on the line, behind those that are on it already."""
        with self._lock:
            self._tampers[name] = (tamper, time.monotonic())

    def take_off(self, name: str) -> None:
        """Take a tamper off the line."""
        with self._lock:
            self._tampers.pop(name, None)

    def inject(self, data: bytes) -> None:
        """Let bytes arrive at the host that nobody sent."""
        with self._lock:
            self._port.write([Piece(data)])

    def unplug(self) -> None:
        """Pull the host's cable out."""
        with self._lock:
            self._port.unplug()

    def plug(self) -> None:
        """Plug the host's cable in."""
        with self._lock:
            if not self._port.plugged:
                self._port.plug()

    def close(self) -> None:
        """End the line."""
        self._ending.set()
        self._thread.join(2.0)
        self._port.close()
        if self._unit is not None:
            os.close(self._unit)

    def _run(self) -> None:
        while not self._ending.is_set():
            if self._unit is None and not self._open():
                self._ending.wait(REOPEN_S)
                continue
            with self._lock:
                commands = self._port.read()
            with contextlib.suppress(OSError):
                if commands:
                    os.write(self._unit, commands)
            came = self._read()
            with self._lock:
                self._pass(came)
            if not came and self._unit is not None:
                select.select([self._unit], [], [], IDLE_S)
                self._leave_a_stranger()

    def _leave_a_stranger(self) -> None:
        """Close a port whose unit has gone: it reads as empty, and its name is given away."""
        try:
            is_ours = os.readlink(self._unit_link) == os.ttyname(self._unit)
        except OSError:
            is_ours = False
        if not is_ours:
            os.close(self._unit)
            self._unit = None

    def _open(self) -> bool:
        try:
            descriptor = os.open(self._unit_link, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            tty.setraw(descriptor)
        except OSError:
            return False
        self._unit, self._rest = descriptor, b''
        self._lateness.clear()
        return True

    def _read(self) -> bytes:
        parts = []
        try:
            while part := os.read(self._unit, 65536):
                parts.append(part)
        except BlockingIOError:
            pass
        except OSError:  # the unit has gone
            os.close(self._unit)
            self._unit = None
        return b''.join(parts)

    def late(self, at_s: float, more_than_s: float) -> bool:
        """Return whether the simulated unit itself was late at a monotonic time.

        On a busy machine it works its samples out late, as no device does; that few have a good
        stamp then is nobody's fault. Late is what came later, by the unit's clock, than the
        earliest that ever came.
        """
        best = min(self._lateness.values(), default=0.0)
        slice_ = int(at_s / SLICE_S)
        near = [self._lateness.get(slice_ - back) for back in range(SLICES)]
        known = [value for value in near if value is not None]
        return not known or max(known) > best + more_than_s

    def _note_lateness(self, records: list[bytes], now: float) -> None:
        """Keep the least delay, by the unit's clock, of each slice of time."""
        for record in records:
            if kind(record) == SAMPLES:
                _, ticks = struct.unpack_from('<IQ', record, frames.HEADER.size)
                slice_ = int(now / SLICE_S)
                delay = now - ticks / TICK_HZ
                self._lateness[slice_] = min(delay, self._lateness.get(slice_, delay))

    def _pass(self, came: bytes) -> None:
        records = self._cut(came)
        now = time.monotonic()
        self._note_lateness(records, now)
        for tamper, begin in list(self._tampers.values()):
            records = tamper(records, now - begin)
        self._held.extend(records)
        if not self.is_held and self._held:
            self._port.write([Piece(record, True) for record in self._held])
            self._held.clear()
        self._port.write([])

    def _cut(self, came: bytes) -> list[bytes]:
        """Return whole records; the unit's own end of the line is never damaged."""
        data, records, place = self._rest + came, [], 0
        while True:
            start = data.find(frames.MAGIC, place)
            if start < 0 or len(data) - start < frames.HEADER.size:
                break
            length = frames.HEADER.unpack_from(data, start)[3]
            end = start + frames.OVERHEAD + length
            if end > len(data):
                break
            records.append(data[start:end])
            place = end
        self._rest = data[place if start < 0 else max(place, start) :][-(1 << 17) :]
        return records
