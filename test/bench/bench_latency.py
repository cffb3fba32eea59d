"""Latency, rate and load of the live chain: serial port to PoseStamped in another process.

A control unit writes its bytes into a pseudo-terminal in real time, one millisecond at a time, and
notes when the last byte of each window was taken; acquisition, field model, tracker and recorder
run as processes of their own; a further process receives the poses. All clocks are the machine's
monotonic one.
"""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from anser_ros.cli.demo import BOARD_SEED
from anser_ros.cli.supervisor import Child, Supervisor
from anser_ros.simulation.board_source import board_source
from anser_ros.simulation.control_unit import ControlUnit
from anser_ros.simulation.manufacture import manufactured
from anser_ros.simulation.pseudo_port import PseudoPort
from anser_ros.simulation.world import World
from anser_ros.wire.channel_calibration import parse_channels
from anser_ros.wire.config_folder import config_path, read_config
from anser_ros.wire.frames import encode
from anser_ros.wire.records import Start
from anser_ros.wire.setup import parse_setup, topic_of

for _variable in ('OPENBLAS_NUM_THREADS', 'NUMBA_NUM_THREADS'):  # as `anser` does for its nodes
    os.environ.setdefault(_variable, '1')

WINDOW_S = 0.02
STRETCH_S = 0.001
STARTUP_S = 30.0
SETTLE_S = 3.0
MEASURE_S = 10.0
RATES_HZ = (200.0, 100.0)
TOOL_SENSORS = 9
BUSY_MS = 3.0

LISTENER = """
import signal, sys, time
import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.signals import SignalHandlerOptions
from anser_ros.nodes import qos
from anser_ros.nodes.process import make_executor

def main():
    output, *topics = sys.argv[1:]
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    ending = []
    signal.signal(signal.SIGTERM, lambda *_: ending.append(1))
    node = rclpy.create_node('latency_listener')
    got = []
    def subscribe(index, topic):
        def callback(message):
            if not got:
                open(output + '.first', 'w').close()
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            got.append((index, stamp, time.monotonic_ns()))
        node.create_subscription(PoseStamped, topic, callback, qos.STREAM)
    for index, topic in enumerate(topics):
        subscribe(index, topic)
    executor = make_executor()
    executor.add_node(node)
    while not ending:
        executor.spin_once(timeout_sec=0.1)
    np.save(output, np.array(got, np.int64).reshape(-1, 3))

main()
"""


class Feeder(threading.Thread):
    """Streams a prepared recording of the control unit, so little work is left in real time.

    Attributes
    ----------
    begin_ns : when the first sample was taken; 0 before
    taken_ns : when the line had taken the last byte of each millisecond
    """

    def __init__(self, port: PseudoPort, seconds: float) -> None:
        super().__init__(name='feeder', daemon=True)
        setup = parse_setup(read_config('demo_setup.yaml'))
        board = manufactured(setup, np.random.default_rng(BOARD_SEED))
        world = World(setup, board_source(board))
        self._unit = ControlUnit(world, parse_channels(read_config('demo_channels.yaml')))
        self._port = port
        recorded = ControlUnit(world, parse_channels(read_config('demo_channels.yaml')))
        recorded.receive(encode(Start()))
        samples = round(STRETCH_S * recorded.sample_rate_hz)
        self._stretches = [
            b''.join(piece.data for piece in recorded.advance(samples))
            for _ in range(round(seconds / STRETCH_S))
        ]
        self.begin_ns = 0
        self.taken_ns: list[int] = []
        self.stopping = threading.Event()

    def run(self) -> None:
        """Greet until a start comes, then stream."""
        while not self._unit.streaming and not self.stopping.is_set():
            self._port.write(self._unit.advance(400))
            self._port.wait(0.01)
            self._port.write(self._unit.receive(self._port.read()))
        self.begin_ns = time.monotonic_ns()
        for rank, stretch in enumerate(self._stretches):
            due = self.begin_ns + round((rank + 1) * STRETCH_S * 1e9)
            while (left := due - time.monotonic_ns()) > 0:
                time.sleep(left / 1e9)
            if self.stopping.is_set():
                return
            self._port.write_all(stretch)
            self.taken_ns.append(time.monotonic_ns())


@dataclass
class Run:
    """What one run of the chain gave.

    Attributes
    ----------
    latency_ms : ndarray, from the last byte of a window to its pose, each pose
    share : poses that came, of those that should have
    load : CPU seconds a second, by process
    device_late_ms : how late the bytes themselves were at the 99th percentile; above a few ms the
        machine was busy with something else, and the figures say more of that than of the chain
    """

    latency_ms: np.ndarray
    share: float
    load: dict[str, float]
    device_late_ms: float


def _command(name: str, /, **parameters: object) -> list[str]:
    command = [sys.executable, '-m', f'anser_ros.nodes.{name}', '--ros-args']
    for key, value in parameters.items():
        command += ['-p', f'{key}:={value}']
    return command


def _cpu_s(child: Child) -> float:
    fields = Path(f'/proc/{child.process.pid}/stat').read_text().rsplit(')', 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def run_chain(rate_hz: float, measure_s: float = MEASURE_S) -> Run:
    """Run the chain at a rate and return what was measured after it had settled."""
    setup = parse_setup(read_config('demo_setup.yaml'))
    topics = [f'/anser/{topic_of(sensor.name)}/pose' for sensor in setup.tool_sensors]
    with tempfile.TemporaryDirectory() as folder:
        link, output = Path(folder) / 'cu', Path(folder) / 'poses.npy'
        port = PseudoPort(link)
        feeder = Feeder(port, STARTUP_S + SETTLE_S + measure_s + 1.0)
        # the supervisor ends them all, also when this process is killed
        with contextlib.closing(port), Supervisor(Path(folder) / 'logs') as supervisor:
            supervisor.start('listener', [sys.executable, '-c', LISTENER, str(output), *topics])
            chain = {
                name: supervisor.start(name, _command(name, **parameters))
                for name, parameters in (
                    ('field_model', {'model_file': config_path('demo_model.yaml')}),
                    ('tracker', {'model_file': config_path('demo_model.yaml')}),
                    ('recorder', {'directory': folder, 'name': 'bag'}),
                    (
                        'acquisition',
                        {'device': link, 'rate_hz': rate_hz, 'window_s': WINDOW_S},
                    ),
                )
            }
            feeder.start()
            _wait_for(Path(f'{output}.first'))
            time.sleep(SETTLE_S)
            before, from_ns = {n: _cpu_s(c) for n, c in chain.items()}, time.monotonic_ns()
            time.sleep(measure_s)
            after, until_ns = {n: _cpu_s(c) for n, c in chain.items()}, time.monotonic_ns()
            time.sleep(0.3)
            load = {name: (after[name] - before[name]) / measure_s for name in chain}
            feeder.stopping.set()
        poses = np.load(output)
    latency_ms, share = _match(poses, feeder, rate_hz, from_ns, until_ns)
    taken = np.array(feeder.taken_ns)
    due = feeder.begin_ns + (1 + np.arange(len(taken))) * STRETCH_S * 1e9
    late = ((taken - due) / 1e6)[(taken > from_ns) & (taken < until_ns)]
    return Run(latency_ms, share, load, float(np.percentile(late, 99)))


def _wait_for(path: Path) -> None:
    """Wait for the listener's word that the first pose has come."""
    end = time.monotonic() + STARTUP_S
    while not path.exists():
        if time.monotonic() > end:
            raise RuntimeError(f'no pose within {STARTUP_S:g} s')
        time.sleep(0.1)


def _match(
    poses: np.ndarray, feeder: Feeder, rate_hz: float, from_ns: int, until_ns: int
) -> tuple[np.ndarray, float]:
    """Latency of each pose by the window that its stamp belongs to, and the share that came.

    The stamp is the middle of a window, late by the line's shortest delay, which is far below the
    spacing of windows; so the nearest window is the right one.
    """
    hop_ms, window_ms = round(1e3 / rate_hz / (1e3 * STRETCH_S)), round(WINDOW_S / STRETCH_S)
    taken = np.array(feeder.taken_ns)
    ends = np.arange(window_ms, len(taken) + 1, hop_ms)
    taken = taken[ends - 1]
    middles = feeder.begin_ns + ends * STRETCH_S * 1e9 - WINDOW_S * 0.5e9
    wanted = (taken > from_ns) & (taken < until_ns)
    stamps = poses[:, 1] - (time.time_ns() - time.monotonic_ns())
    window = np.clip(np.searchsorted(middles, stamps - 0.5 * hop_ms * 1e6), 0, len(ends) - 1)
    counted = wanted[window]
    latency_ms = (poses[counted, 2] - taken[window[counted]]) / 1e6
    return latency_ms, counted.sum() / (wanted.sum() * TOOL_SENSORS)


def rows() -> Iterator[dict]:
    """Yield the rows of the benchmark table."""
    os.environ.setdefault('ROS_DOMAIN_ID', str(1 + os.getpid() % 100))
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    slow = run_chain(50.0)
    p50, p99 = np.percentile(slow.latency_ms, [50, 99])
    window_ms = 1e3 * WINDOW_S
    what = 'serial port to PoseStamped, 9 + 32 channels at 50 Hz'
    if slow.device_late_ms > BUSY_MS:
        note = f'machine busy: the bytes themselves {slow.device_late_ms:.0f} ms late'
        print(f'  {note}; latencies say more of that than of the chain', flush=True)
        what += f' ({note})'
    for name, value, target in (('p50', p50, 3.0), ('p99', p99, 10.0)):
        yield {
            'name': f'{what}, {name}',
            'value': float(value),
            'unit': 'ms',
            'rival': 'window length',
            'rival_value': window_ms,
            'target': target,
        }
    load = 100 * sum(slow.load.values())
    parts = ', '.join(f'{name} {100 * share:.0f}' for name, share in sorted(slow.load.items()))
    yield {
        'name': f'CPU of the chain at 50 Hz ({parts})',
        'value': load,
        'unit': '% of a core',
        'target': 60.0,
    }
    yield {
        'name': 'rate without a lost window, 9 + 32 channels',
        'value': _sustained_hz(),
        'unit': 'Hz',
        'rival': 'usual rate',
        'rival_value': 50.0,
        'target': 200.0,
        'target_is': 'least',
    }


def _sustained_hz() -> float:
    """The highest rate at which every window gave all its poses."""
    for rate_hz in RATES_HZ:
        if run_chain(rate_hz).share >= 1.0:
            return rate_hz
    return 50.0


if __name__ == '__main__':
    for row in rows():
        print(row)
