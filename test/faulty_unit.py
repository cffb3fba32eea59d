"""A control unit whose fluxes tell the time, behind a line that can be tampered with.

Every sensor's fluxes turn around the emitters once in `TURN_S`: when a window was sampled can be
read from the fluxes that were published, whatever happened to them on the way.
"""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from anser_ros.nodes.acquisition_parts.wall_clock import WallClock
from anser_ros.simulation.control_unit import ControlUnit
from anser_ros.simulation.pseudo_port import PseudoPort
from anser_ros.wire.channel_calibration import parse_channels
from anser_ros.wire.config_folder import read_config
from anser_ros.wire.frame_reader import FrameReader
from anser_ros.wire.frames import encode
from anser_ros.wire.records import Hello, Payload, Record, SampleBlock
from anser_ros.wire.setup import parse_setup

SETUP = parse_setup(read_config('demo_setup.yaml'))
CHANNELS = parse_channels(read_config('demo_channels.yaml'))
TURN_S = 10.0
AMPLITUDE_T = 4e-7
STEP_S = 0.002
Tamper = Callable[[Payload, float], Payload | None]


def _unchanged(payload: Payload, _time_s: float) -> Payload:
    return payload


class TurningWorld:
    """Fluxes (S, K) that turn around the emitters."""

    def __init__(self) -> None:
        self.setup, self.sensors = SETUP, SETUP.sensors
        self._at = 2 * np.pi * np.arange(len(SETUP.emitter.coils)) / len(SETUP.emitter.coils)

    def flux(self, time_s: float) -> np.ndarray:
        """Return the fluxes at a time since power-up."""
        turned = 1.5 + np.cos(2 * np.pi * time_s / TURN_S - self._at)
        return np.tile(AMPLITUDE_T * turned, (len(self.sensors), 1)).astype(complex)


def sampled_s(flux: np.ndarray, about_s: float) -> np.ndarray:
    """Return when the fluxes (S, K) were sampled, s since power-up, nearest to a guess."""
    count = flux.shape[1]
    angle = np.angle(flux.real @ np.exp(2j * np.pi * np.arange(count) / count))
    time_s = angle * TURN_S / (2 * np.pi)
    return time_s + TURN_S * np.round((about_s - time_s) / TURN_S)


class FaultyUnit:
    """Runs a simulated unit in a thread, in real time.

    Attributes
    ----------
    tamper : callable
        Gets each record and the time since power-up, and returns what leaves in its place.
    delay_s : float
        How long a record is on its way; records stay in order.
    lost_s : float
        Time that the device has lost without counting it.
    """

    def __init__(self, link: Path, seed: int = 0) -> None:
        self.tamper: Tamper = _unchanged
        self.delay_s = self.lost_s = 0.0
        self._unit = ControlUnit(TurningWorld(), CHANNELS, seed=seed)
        self._unit.advance(0)
        self._port = PseudoPort(link)
        self._reader = FrameReader()
        self._line: deque[tuple[float, bytes]] = deque()
        self.begin_s = time.monotonic()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    @property
    def now_s(self) -> float:
        """Time since power-up, s."""
        return time.monotonic() - self.begin_s

    def taken_s(self, stamp_ns: int) -> float:
        """Return the time since power-up that a stamp of the system's clock means, s."""
        return (stamp_ns - WallClock().offset_ns()) / 1e9 - self.begin_s

    def close(self) -> None:
        """Stop, and remove the port."""
        self._closing.set()
        self._thread.join()
        self._port.close()

    def _run(self) -> None:
        rate = self._unit.sample_rate_hz
        while not self._closing.is_set():
            now_s = self.now_s
            commands = self._port.read()
            due = int((now_s - self.lost_s) * rate) - self._unit.samples
            for piece in self._unit.advance(max(due, 0)):
                self._send(piece.data, now_s)
            for piece in self._unit.receive(commands):
                self._send(piece.data, now_s)
            while self._line and self._line[0][0] <= now_s:
                self._port.write_all(self._line.popleft()[1])
            self._port.wait(STEP_S)

    def _send(self, data: bytes, now_s: float) -> None:
        if self.tamper is not _unchanged:
            (record,) = self._reader.feed(data)
            payload = self.tamper(record.payload, now_s)
            if payload is None:
                return
            data = encode(payload, record.tag)
        self._line.append((now_s + self.delay_s, data))

    def release(self) -> None:
        """Let all that is on its way arrive now, and what follows without delay."""
        self.delay_s = 0.0
        self._line = deque((0.0, data) for _, data in self._line)


class Ring:
    """Repeats the codes of the last `blocks` blocks, in all columns or in some."""

    def __init__(self, blocks: int, columns: list[int] | None = None) -> None:
        self._past: deque[np.ndarray] = deque(maxlen=blocks)
        self._columns = columns
        self.on = False

    @property
    def is_full(self) -> bool:
        """Return whether as many blocks have passed as are to be repeated."""
        return len(self._past) == self._past.maxlen

    def __call__(self, payload: Payload, _time_s: float) -> Payload:
        """Return the record with old samples while it is on."""
        if not isinstance(payload, SampleBlock):
            return payload
        if not self.on:
            self._past.append(payload.codes)
            return payload
        codes = np.array(payload.codes)
        rows = slice(None) if self._columns is None else self._columns
        codes[:, rows] = self._past[0][:, rows]
        self._past.rotate(-1)
        return replace(payload, codes=codes)


class Ticks:
    """Replaces the ticks of blocks by a function of theirs, and the tick rate of hellos."""

    def __init__(self) -> None:
        self.change: Callable[[int], int] = lambda ticks: ticks
        self.rate = 1.0

    def __call__(self, payload: Payload, _time_s: float) -> Payload:
        """Return the record as the device would send it."""
        if isinstance(payload, SampleBlock):
            ticks = int(self.change(payload.timestamp_ticks)) % 2**64
            return replace(payload, timestamp_ticks=ticks)
        if isinstance(payload, Hello):
            return replace(payload, tick_hz=payload.tick_hz * self.rate)
        return payload


__all__ = ['FaultyUnit', 'Record', 'Ring', 'Ticks', 'sampled_s']
