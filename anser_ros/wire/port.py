"""Runs the control unit's serial port: a reader thread that survives cables and names faults.

One line is opened and read as fast as pyserial can. The thread reads, finds records and queues
them; it never waits for the receiver. A receiver that is too slow loses whole blocks, counted as
`overrun_blocks`. The port is reopened with growing pauses after an unplugged cable.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import queue
import select
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import serial
from serial.tools import list_ports

from anser_ros.errors import PortError
from anser_ros.wire.frames import Hello, Payload, Record, SampleBlock, Stop
from anser_ros.wire.protocols import ANSER, SerialProtocol, records_of

_READ_TIMEOUT_S = 0.05
"""Longest time that a read waits, s, before the thread looks whether it has to end."""
_WRITE_TIMEOUT_S = 0.2
"""Longest time that a write may take, s; commands are short, so that a longer one is a fault."""
_READ_BYTES = 1 << 16
"""Largest number of bytes of one read: more than a line of 12 Mbaud brings in 50 ms."""
_LONGEST_REST_S, _GATHERED_BYTES = 3e-3, 12_000
"""Longest time, s, that blocks are left to gather while no window is due, and most bytes: at 4 ms
arrivals would not be punctual; a terminal holds 4 kB and its driver about 16 kB more."""
_TERMINAL_BYTES = 4095
"""Most bytes that a terminal hands out at a time: after fewer there are no more."""
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

    pyserial's own read costs several system calls and an extra byte for every wake-up. A terminal
    hands out 4 kB at a time; all of it is taken before any is looked at. pyserial has made the
    descriptor one whose reads don't wait.
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
        piece = data
        with contextlib.suppress(BlockingIOError):
            while len(piece) >= _TERMINAL_BYTES and len(data) < _READ_BYTES:
                piece = os.read(descriptor, _READ_BYTES)
                data += piece
        return data

    return receive


def close_line(port: serial.SerialBase) -> None:
    """Close a port, whatever has become of it."""
    with contextlib.suppress(serial.SerialException, OSError):
        port.close()


STOP_S = 0.1
"""Time, s, that the last messages get to leave before the process ends."""
DEFAULT_BAUD = 12_000_000
"""Baud rate of the port; USB devices ignore it."""
SILENCE_S = 1.5
"""Usual time without a byte that counts as a fault, s: a unit says hello once a second."""
_COMMANDS = 64
"""Commands that may wait, and whose time is remembered; a few a second are answered within one."""
_GARBAGE_BYTES = 256
"""Bytes without a record within a second beyond which the line counts as garbled."""


class PortState(Enum):
    """Names what the port is doing now; the value is the words for an operator."""

    CLOSED = 'closed'
    ABSENT = 'no port'
    WAITING = 'open, nothing received yet'
    RECEIVING = 'receiving records'
    WRONG_BAUD = 'bytes arrive but no records: check the baud rate'
    SILENT = 'nothing arrives'


@dataclass
class PortCounters:
    """Counts faults since the port started; each is an event unless the name says otherwise."""

    gap_blocks: int = 0
    wrong_baud: int = 0
    silence: int = 0
    unplug: int = 0
    unwritten: int = 0
    overrun_blocks: int = 0
    open_failures: int = 0
    reader_failures: int = 0
    opens: int = 0
    received_bytes: int = 0


class Batch(NamedTuple):
    """Holds records that were received together; none when the connection began or ended."""

    records: tuple[Record, ...] = ()
    arrivals_ns: tuple[int, ...] = ()  # of the host's monotonic clock, right after each read


class ControlUnitPort:
    """Reads the control unit in a separate thread.

    The device is a path or a pyserial URL. No byte for ``silence_s`` is a fault. So many blocks
    may wait for the receiver, which is woken for ``blocks_wanted`` of them; the pause between
    attempts to open is doubled up to the longest.
    """

    def __init__(
        self,
        device: str,
        *,
        protocol: SerialProtocol = ANSER,
        baud: int = DEFAULT_BAUD,
        silence_s: float = SILENCE_S,
        queue_blocks: int = 2048,
        pause_s: float = 0.1,
        longest_pause_s: float = 2.0,
    ) -> None:
        self.device = device
        self.counters = PortCounters()
        self.state = PortState.CLOSED
        self.reason = ''
        self._baud = baud
        self._silence_s = silence_s
        self.blocks_wanted, self._block_s = 1, 0.0
        self._queue_blocks = queue_blocks
        self._holding = threading.RLock()
        self._held: list[Record] = []
        self._arrivals_ns: list[int] = []
        self._held_blocks = 0
        self._pauses = (pause_s, longest_pause_s)
        self._protocol = protocol
        self._reader = protocol.make_reader()
        self._queue: queue.SimpleQueue[Batch] = queue.SimpleQueue()
        self._commands: deque[tuple[int, bytes]] = deque(maxlen=_COMMANDS)
        self._sent_ns: deque[tuple[int, int]] = deque(maxlen=_COMMANDS)
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self._next_sequence: int | None = None
        self._tag = 0

    def start(self) -> None:
        """Start the reader thread, once (`PortError`); the port may appear later."""
        if self._thread is not None:
            raise PortError(f'the port {self.device} was started before')
        self._thread = threading.Thread(target=self._run, name='control_unit_port', daemon=True)
        self._thread.start()

    def end_stream(self) -> None:
        """Command the control unit to stop, and give the message time to leave."""
        self.send(Stop())
        time.sleep(STOP_S)

    def stop(self, timeout_s: float = 1.0) -> None:
        """End the reader thread and close the port."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join(timeout_s)

    def want(self, blocks: int, block_s: float = 0.0) -> None:
        """Set how many blocks to collect, and their length, s, where they may gather unread."""
        with self._holding:
            self.blocks_wanted, self._block_s = blocks, block_s
            if self._held_blocks >= blocks:
                self._hand_over()

    def get(self, timeout_s: float) -> Batch | None:
        """Wait for the next batch and return it, or None when none arrived in time."""
        try:
            return self._queue.get(timeout=timeout_s)
        except queue.Empty:
            return None

    def send(self, command: Payload) -> int:
        """Queue a command, which is lost if the port closes first; returns its tag."""
        self._tag = self._tag % 0xFFFF + 1
        self._commands.append((self._tag, self._protocol.encode(command, self._tag)))
        return self._tag

    def sent_ns(self, tag: int) -> int | None:
        """Return the monotonic time right before a command left, None for one long ago."""
        for known, sent_ns in reversed(tuple(self._sent_ns)):
            if known == tag:
                return sent_ns
        return None

    def fault_counters(self) -> dict[str, int]:
        """Return all counters by name, the frame reader's included."""
        return vars(self.counters) | self._reader.fault_counters()

    @property
    def last_refusal(self) -> str:
        """Return the reason why the last refused record was refused."""
        return self._reader.last_refusal

    def _run(self) -> None:
        pause, longest = self._pauses
        wait = pause
        while not self._stopping.is_set():
            try:
                port = open_line(self.device, self._baud)
            except PortError as error:
                self.counters.open_failures += 1
                self.state, self.reason = PortState.ABSENT, str(error)
                self._stopping.wait(wait)
                wait = min(2 * wait, longest)
                continue
            opened = time.monotonic()
            self.counters.opens += 1
            self.state, self.reason = PortState.WAITING, ''
            self._reader.reset()
            self._next_sequence = None
            self._commands.clear()
            self._queue.put(Batch())
            try:
                self._read(port)
            except PortError as error:
                self.counters.reader_failures += 1
                self.state, self.reason = PortState.ABSENT, str(error)
            except (serial.SerialException, OSError, TypeError) as error:
                # pyserial raises TypeError when the descriptor vanishes between two of its calls
                if not self._stopping.is_set():
                    self.counters.unplug += 1
                    self.state, self.reason = PortState.ABSENT, f'unplugged: {cause_of(error)}'
            finally:
                close_line(port)
                self._hand_over()
                self._queue.put(Batch())
            wait = pause if time.monotonic() - opened > longest else min(2 * wait, longest)
            self._stopping.wait(wait)
        self.state = PortState.CLOSED

    def _read(self, port: serial.SerialBase) -> None:
        last_byte = last_record = time.monotonic()
        garbage_bytes = 0
        reader = self._reader
        receive = receiver_of(port)
        while not self._stopping.is_set():
            while self._commands:
                tag, command = self._commands.popleft()
                self._sent_ns.append((tag, time.monotonic_ns()))
                try:
                    port.write(command)
                except serial.SerialTimeoutException:  # its sender misses the reply
                    self.counters.unwritten += 1
                    break  # what arrives must not wait for the next one
            data = receive()
            # The stamps hang on this time: it is taken before anything is made of the bytes.
            arrival_ns = time.monotonic_ns()
            now = arrival_ns / 1e9
            if data:
                last_byte = now
                garbage_bytes += len(data)
                self.counters.received_bytes += len(data)
                records = records_of(reader, data)
                if records:
                    last_record, garbage_bytes = now, 0
                    self.state = PortState.RECEIVING
                    self._take(records, arrival_ns)
                    self._rest(arrival_ns)
            elif self._held:
                self._hand_over()
            elif now - last_byte > self._silence_s:
                self.counters.silence += 1
                self.state = PortState.SILENT
                last_byte = now
            if now - last_record > 1.0 and garbage_bytes > _GARBAGE_BYTES:
                self.counters.wrong_baud += 1
                self.state = PortState.WRONG_BAUD
                last_record, garbage_bytes = now, 0

    def _rest(self, arrival_ns: int) -> None:
        """Let blocks gather behind those that are held, up to the last that is wanted."""
        newest = self._held[-1:]
        if newest and isinstance(block := newest[0].payload, SampleBlock):
            left = self.blocks_wanted - self._held_blocks - 1
            rest_s = min(left, _GATHERED_BYTES / max(block.codes.nbytes, 1)) * self._block_s
            rest_s = min(rest_s, _LONGEST_REST_S) - (time.monotonic_ns() - arrival_ns) / 1e9
            if rest_s > 0:
                time.sleep(rest_s)

    def _take(self, records: list[Record], arrival_ns: int) -> None:
        """Hold blocks until there are as many as wanted; anything else goes on at once."""
        urgent = False
        with self._holding:
            for record in records:
                payload = record.payload
                if isinstance(payload, SampleBlock):
                    self._count_gap(payload.sequence)
                    if self._queue.qsize() * self.blocks_wanted >= self._queue_blocks:
                        self.counters.overrun_blocks += 1
                        continue
                    self._held_blocks += 1
                else:
                    urgent = True
                self._held.append(record)
                self._arrivals_ns.append(arrival_ns)
            if urgent or self._held_blocks >= self.blocks_wanted:
                self._hand_over()

    def _hand_over(self) -> None:
        """Queue what is held; a receiver that never reads gets no more than records fit."""
        with self._holding:
            if self._held and self._queue.qsize() < 2 * self._queue_blocks:
                self._queue.put(Batch(tuple(self._held), tuple(self._arrivals_ns)))
            self._held, self._arrivals_ns, self._held_blocks = [], [], 0

    def _count_gap(self, sequence: int) -> None:
        if self._next_sequence is not None and sequence:
            missing = (sequence - self._next_sequence) % 2**32
            if missing < 2**31:
                self.counters.gap_blocks += missing
        self._next_sequence = (sequence + 1) % 2**32


def find_port(
    candidates: Iterable[str] | None = None,
    *,
    protocol: SerialProtocol = ANSER,
    baud: int = DEFAULT_BAUD,
    listen_s: float = 1.5,
) -> str:
    """Find the port, of the given or of all, that carries a hello, by listening only."""
    devices: list[str] = list(candidates or (port.device for port in list_ports.comports()))
    for device in devices:
        try:
            port = open_line(device, baud)
        except PortError:
            continue
        reader = protocol.make_reader()
        end = time.monotonic() + listen_s
        try:
            while time.monotonic() < end:
                records = records_of(reader, port.read(port.in_waiting or 1))
                if any(isinstance(record.payload, Hello) for record in records):
                    return device
        except (serial.SerialException, OSError, PortError):
            continue
        finally:
            close_line(port)
    raise PortError(f'no control unit was found on any of {len(devices)} serial ports')
