"""The live chain with a control unit whose bytes were made before: one run, and what it gave.

The unit writes its bytes into a pseudo-terminal in real time, one millisecond at a time, and notes
when the last byte of each window was taken. A further process receives the poses. All clocks are
the machine's monotonic one. A window without a pose has an infinite latency.
"""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from anser_ros.cli.processes import BOARD_SEED, Child, Supervisor, node_command
from anser_ros.simulation.control_unit import ControlUnit, Piece
from anser_ros.simulation.line import PseudoPort
from anser_ros.simulation.world import Approach, World, board_source, manufactured, steel_disc
from anser_ros.wire.channel_calibration import parse_channels
from anser_ros.wire.frames import Start, encode
from anser_ros.wire.setup import parse_setup, topic_of
from anser_ros.wire.text_files import config_path, read_config

WINDOW_S = 0.02
BLOCK_S = 0.001
MADE_S = 0.005
"""Stretch of samples that is made at a time, s, as the simulated unit of the demo does."""
STARTUP_S = 30.0
SETTLE_S = 3.0
METAL_FROM_S = 8.0
"""Time, s after the first sample, until which there is no metal: the baseline is taken then."""
METAL_RADIUS_M = 0.1
METAL_FAR_M, METAL_NEAR_M = (0.05, -0.03, -0.45), (0.05, -0.03, -0.08)
METAL_TRAVEL_S = 2.0
"""Time, s, of the disc's way in and of its way out; it never rests: 0.19 m/s on average."""
TOOL_SENSORS = 9
PRIORITY = -15
"""Niceness of the thread that stands for the device, where the system allows it."""

LISTENER = """
import gc, signal, sys, time
import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.signals import SignalHandlerOptions
from anser_ros.nodes.runtime import qos
from anser_ros.nodes.runtime.process import make_executor

def main():
    output, *topics = sys.argv[1:]
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    ending = []
    signal.signal(signal.SIGTERM, lambda *_: ending.append(1))
    node = rclpy.create_node('latency_listener')
    got, told = [], []
    def subscribe(index, topic):
        def callback(message):
            if not got:
                open(output + '.first', 'w').close()
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            got.append((index, stamp, time.monotonic_ns()))
        node.create_subscription(PoseStamped, topic, callback, qos.STREAM)
    for index, topic in enumerate(topics):
        subscribe(index, topic)
    def note(message):
        for status in message.status:
            for pair in status.values:
                if pair.key == 'model_age_s_max':
                    told.append((time.monotonic(), float(pair.value)))
    node.create_subscription(DiagnosticArray, '/diagnostics', note, qos.EVENTS)
    executor = make_executor()
    executor.add_node(node)
    gc.disable()  # the instrument's own pauses are not the chain's
    while not ending:
        executor.spin_once(timeout_sec=0.1)
    np.save(output, np.array(got, np.int64).reshape(-1, 3))
    np.save(output.replace('.npy', '_ages.npy'), np.array(told).reshape(-1, 2))

main()
"""

FLOOR = """
import sys, os, termios, tty
import rclpy
from geometry_msgs.msg import PoseStamped
from anser_ros.nodes.runtime import qos
from anser_ros.wire.protocols import FrameReader
from anser_ros.wire.frames import encode
from anser_ros.wire.frames import SampleBlock, Start

def main():
    link, blocks, topics = sys.argv[1], float(sys.argv[2]), sys.argv[3:]
    rclpy.init()
    node = rclpy.create_node('floor')
    publishers = [node.create_publisher(PoseStamped, topic, qos.STREAM) for topic in topics]
    while not all(publisher.get_subscription_count() for publisher in publishers):
        rclpy.spin_once(node, timeout_sec=0.1)
    line = os.open(link, os.O_RDWR | os.O_NOCTTY)
    tty.setraw(line)
    os.write(line, encode(Start()))
    reader, message = FrameReader(), PoseStamped()
    while True:
        for record in reader.feed(os.read(line, 65536)):
            payload = record.payload
            if isinstance(payload, SampleBlock) and (payload.sequence + 1) % blocks < 1.0:
                message.header.stamp.sec = int((payload.sequence + 1) // blocks)
                for publisher in publishers:
                    publisher.publish(message)

main()
"""


def world(metal: bool) -> World:
    """Return the demo's board and tool, with a steel disc that comes and goes without a rest."""
    setup = parse_setup(read_config('demo_setup.yaml'))
    board = manufactured(setup, np.random.default_rng(BOARD_SEED))
    path = Approach(
        far_m=METAL_FAR_M, near_m=METAL_NEAR_M, start_s=METAL_FROM_S, travel_s=METAL_TRAVEL_S,
        stay_s=0.0, period_s=2 * METAL_TRAVEL_S,
    )  # fmt: skip
    bodies = [steel_disc(path, radius_m=METAL_RADIUS_M)] if metal else []
    return World(setup, board_source(board), metal=bodies)


def made_bytes(metal: bool, seconds: float) -> list[bytes]:
    """Return what a control unit sends from its start on, one item a millisecond."""
    unit = ControlUnit(world(metal), parse_channels(read_config('demo_channels.yaml')))
    unit.receive(encode(Start()))
    samples = round(MADE_S * unit.sample_rate_hz)
    sent: list[bytes] = []
    for _ in range(round(seconds / MADE_S)):
        others = b''
        for piece in unit.advance(samples):
            if piece.is_block:
                sent.append(others + piece.data)
                others = b''
            else:
                others += piece.data
    return sent


class Feeder(threading.Thread):
    """Streams prepared bytes, so little work is left in real time."""

    def __init__(self, port: PseudoPort, sent: list[bytes]) -> None:
        super().__init__(name='feeder', daemon=True)
        self._unit = ControlUnit(world(False), parse_channels(read_config('demo_channels.yaml')))
        self._port, self._sent = port, sent
        self.begin_ns = 0  # when the first sample was taken; 0 before
        self.taken_ns: list[int] = []  # when the line had taken the last byte of each millisecond
        self.stopping = threading.Event()

    def run(self) -> None:
        """Greet until a start comes, then stream, as a device does that no other program slows."""
        with contextlib.suppress(PermissionError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), PRIORITY)
        while not self._unit.streaming and not self.stopping.is_set():
            self._port.write(self._unit.advance(400))
            self._port.wait(0.01)
            self._port.write(self._unit.receive(self._port.read()))
        self.begin_ns = time.monotonic_ns()
        for rank, data in enumerate(self._sent):
            due = self.begin_ns + round((rank + 1) * BLOCK_S * 1e9)
            while (left := due - time.monotonic_ns()) > 0:
                time.sleep(left / 1e9)
            if self.stopping.is_set():
                return
            self._port.write([Piece(data)])
            while self._port._pending:
                self._port.wait(0.001)
            self.taken_ns.append(time.monotonic_ns())


@dataclass(frozen=True)
class Layout:
    """What runs: which processes, at which rate, and whether the model follows the references."""

    rate_hz: float = 50.0
    composed: bool = True  # acquisition, field model and tracker in one process, or in three
    follows: bool = True  # the refit active from a baseline on, or a model that stays as it was
    metal: bool = True  # it comes and goes without a rest; its bytes must have been made with it
    is_floor: bool = False  # nothing of these, but a node that reads the port and publishes poses
    floor_poses: int = 1  # how many poses that node publishes a window

    @property
    def poses(self) -> int:
        """Poses that a window gives."""
        return self.floor_poses if self.is_floor else TOOL_SENSORS


@dataclass(frozen=True)
class Run:
    """What one run of the chain gave.

    ``device_late_ms`` is how late the bytes themselves were at the 99th percentile; above a few ms
    the machine was busy with something else, and the figures say more of that than of the chain.
    """

    latency_ms: np.ndarray  # from the last byte of a window to its pose; infinite if none came
    lost: int  # windows of a sensor without a pose
    load: dict[str, float]  # CPU seconds a second, by process
    device_late_ms: float
    ages_s: np.ndarray  # largest age of a model that a pose used, of each second

    def percentile(self, share: float) -> float:
        """Latency, ms, that this many per cent of all windows have at most."""
        return float(np.percentile(self.latency_ms, share, method='higher'))


def _chain(layout: Layout, link: Path, folder: str, topics: list[str]) -> dict[str, list[str]]:
    """Return the commands of the processes by name."""
    if layout.is_floor:
        blocks = str(1 / layout.rate_hz / BLOCK_S)
        return {'floor': [sys.executable, '-c', FLOOR, str(link), blocks, *topics]}
    model = config_path('demo_model.yaml')
    refit = {'refit': layout.follows, 'baseline_at_start': layout.follows}
    port = {'device': link, 'rate_hz': layout.rate_hz, 'window_s': WINDOW_S}
    recorder = {'recorder': node_command('recorder', directory=folder, name='bag')}
    if layout.composed:
        values = {f'acquisition__{k}': v for k, v in port.items()}
        values |= {f'field_model__{k}': v for k, v in refit.items()}
        return recorder | {'live': node_command('live', model_file=model, **values)}
    return recorder | {
        'field_model': node_command('field_model', model_file=model, **refit),
        'tracker': node_command('tracker', model_file=model),
        'acquisition': node_command('acquisition', **port),
    }


def _cpu_s(pid: int) -> float:
    fields = Path(f'/proc/{pid}/stat').read_text().rsplit(')', 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def _cpu(chain: dict[str, Child]) -> dict[str, float]:
    return {name: _cpu_s(child.process.pid) for name, child in chain.items()}


def run_chain(layout: Layout, sent: list[bytes], measure_s: float) -> Run:
    """Run the chain and return what was measured after it had settled."""
    os.environ.setdefault('ROS_DOMAIN_ID', str(1 + os.getpid() % 100))
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    setup = parse_setup(read_config('demo_setup.yaml'))
    names = [topic_of(sensor.name) for sensor in setup.tool_sensors]
    names = names[: layout.poses]
    topics = [f'/anser/{name}/pose' for name in names]
    with tempfile.TemporaryDirectory() as folder:
        link, output = Path(folder) / 'cu', Path(folder) / 'poses.npy'
        port = PseudoPort(link)
        feeder = Feeder(port, sent)
        # the supervisor ends them all, also when this process is killed
        with contextlib.closing(port), Supervisor(Path(folder) / 'logs') as supervisor:
            supervisor.start('listener', [sys.executable, '-c', LISTENER, str(output), *topics])
            commands = _chain(layout, link, folder, topics)
            chain = {name: supervisor.start(name, words) for name, words in commands.items()}
            feeder.start()
            _wait_for(Path(f'{output}.first'))
            metal_s = METAL_FROM_S if layout.metal and not layout.is_floor else 0.0
            left_s = metal_s - (time.monotonic_ns() - feeder.begin_ns) / 1e9
            time.sleep(max(left_s, 0.0) + SETTLE_S)
            before, from_ns = _cpu(chain), time.monotonic_ns()
            time.sleep(measure_s)
            after, until_ns = _cpu(chain), time.monotonic_ns()
            time.sleep(0.5)
            load = {name: (after[name] - before[name]) / measure_s for name in chain}
            feeder.stopping.set()
        poses, ages = np.load(output), np.load(str(output).replace('.npy', '_ages.npy'))
    taken = np.array(feeder.taken_ns)
    due = feeder.begin_ns + (1 + np.arange(len(taken))) * BLOCK_S * 1e9
    late = ((taken - due) / 1e6)[(taken > from_ns) & (taken < until_ns)]
    latency_ms = _latencies(layout, poses, feeder, from_ns, until_ns)
    lost = int(np.isinf(latency_ms).sum())
    told = ages[(ages[:, 0] > from_ns / 1e9 + 1.0) & (ages[:, 0] < until_ns / 1e9), 1]
    return Run(latency_ms, lost, load, float(np.percentile(late, 99)), told)


def _wait_for(path: Path) -> None:
    """Wait for the listener's word that the first pose has come."""
    end = time.monotonic() + STARTUP_S
    while not path.exists():
        if time.monotonic() > end:
            raise RuntimeError(f'no pose within {STARTUP_S:g} s')
        time.sleep(0.1)


def _latencies(
    layout: Layout, poses: np.ndarray, feeder: Feeder, from_ns: int, until_ns: int
) -> np.ndarray:
    """Latency, ms, of each window and sensor; infinite where no pose came.

    The stamp is the middle of a window, late by the line's shortest delay, which is far below the
    spacing of windows; so the nearest window is the right one. The floor stamps with its number.
    """
    hop, window = 1 / layout.rate_hz / BLOCK_S, WINDOW_S / BLOCK_S  # in blocks
    taken = np.array(feeder.taken_ns)
    if layout.is_floor:
        window = hop
    ends = np.arange(window, len(taken), hop)
    # The block that has a window's last sample
    taken = taken[np.ceil(ends - 1e-6).astype(int) - 1]
    if layout.is_floor:
        window = poses[:, 1] // 10**9 - 1
    else:
        middles = feeder.begin_ns + ends * BLOCK_S * 1e9 - WINDOW_S * 0.5e9
        stamps = poses[:, 1] - (time.time_ns() - time.monotonic_ns())
        window = np.searchsorted(middles, stamps - 0.5 * hop * BLOCK_S * 1e9)
    known = (window >= 0) & (window < len(ends))
    latency_ms = np.full((len(ends), layout.poses), np.inf)
    rows = poses[known]
    latency_ms[window[known], rows[:, 0]] = (rows[:, 2] - taken[window[known]]) / 1e6
    return latency_ms[(taken > from_ns) & (taken < until_ns)].ravel()
