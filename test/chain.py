"""The real nodes as processes over DDS: a bag replayed through them, and what came out."""

import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String

from anser_ros.wire.bag import Salvage, iter_messages, read_bag
from anser_ros.wire.bag_writer import BagWriter

STARTUP_S = 90.0
SETTLE_S = 1.0


def beginning(bag: Path, out: Path, length_s: float) -> Path:
    """Copy the first seconds of a bag, message by message."""
    writer, channels, end_ns = BagWriter(out), {}, None
    for message in iter_messages(bag, Salvage()):
        end_ns = end_ns or message.log_time_ns + round(1e9 * length_s)
        if message.log_time_ns > end_ns:
            break
        if message.topic not in channels:
            definition = message.schema.data.decode()
            channels[message.topic] = writer.add_topic(
                message.topic, message.type_name, definition
            )
        writer.write(channels[message.topic], message.log_time_ns, message.data)
    writer.close()
    return out


@dataclass(frozen=True)
class ReceivedPoses:
    """Poses of one topic: stamps (n,) in ns, positions (n, 3) in m, pose z axes (n, 3)."""

    stamp_ns: np.ndarray
    position: np.ndarray
    axis: np.ndarray


def start(*arguments: str, domain: int, log: Path) -> subprocess.Popen:
    """Start `anser ARGUMENTS` in a ROS domain of its own."""
    environment = {
        **os.environ,
        'ROS_DOMAIN_ID': str(domain),
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        'ROS_LOG_DIR': str(log.parent),
    }
    with log.open('wb') as stream:
        return subprocess.Popen(
            [sys.executable, '-m', 'anser_ros.cli.main', *arguments],
            stdout=stream, stderr=subprocess.STDOUT, env=environment, start_new_session=True,
        )  # fmt: skip


def stop(processes: list[subprocess.Popen]) -> None:
    """End processes, and kill what does not end."""
    for process in processes:
        if process.poll() is None:
            process.terminate()
    for process in processes:
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait(10)


def _axis(q: Any) -> tuple[float, float, float]:
    return (
        2 * (q.x * q.z + q.w * q.y),
        2 * (q.y * q.z - q.w * q.x),
        1 - 2 * (q.x * q.x + q.y * q.y),
    )


class Listener:
    """Gathers every PoseStamped under the namespace."""

    def __init__(self, topics: list[str], domain: int) -> None:
        import rclpy

        self._context = rclpy.Context()
        self._context.init(domain_id=domain)
        self._node = rclpy.create_node('pose_listener', context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._setup = self._node.create_publisher(String, '/anser/setup', latched)
        self._text = String
        self._refit_starts = 0
        self._node.create_subscription(
            DiagnosticArray, '/diagnostics', self._on_diagnostics, QoSProfile(depth=10)
        )
        self.got: dict[str, list[tuple]] = {topic: [] for topic in topics}
        for topic in topics:
            self._node.create_subscription(
                PoseStamped, topic, lambda m, rows=self.got[topic]: self._add(m, rows),
                QoSProfile(depth=4000),
            )  # fmt: skip

    @staticmethod
    def _add(message: Any, rows: list[tuple]) -> None:
        stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        p, q = message.pose.position, message.pose.orientation
        rows.append((stamp, p.x, p.y, p.z, *_axis(q)))

    def _on_diagnostics(self, message: Any) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            self._refit_starts = int(values.get('refit_starts', self._refit_starts))

    def await_refit(self) -> None:
        """Wait until the field model has made its refit: frames that come before may be lost."""
        end = time.monotonic() + STARTUP_S
        while not self._refit_starts:
            assert time.monotonic() < end, 'the field model never made its refit'
            self.spin(0.2)

    def announce(self, setup: str) -> None:
        """Say the setup, and wait for a publisher of every topic: before, poses would be lost."""
        self._setup.publish(self._text(data=setup))
        end = time.monotonic() + STARTUP_S
        while not all(self._node.count_publishers(topic) for topic in self.got):
            assert time.monotonic() < end, 'the tracker never made its topics'
            self.spin(0.2)
        self.spin(SETTLE_S)

    def spin(self, seconds: float) -> None:
        """Receive for a while."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self._executor.spin_once(timeout_sec=0.05)

    def total(self) -> int:
        """Number of poses so far."""
        return sum(len(rows) for rows in self.got.values())

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()

    def poses(self) -> dict[str, ReceivedPoses]:
        """What came, by topic."""
        series = {}
        for topic, rows in self.got.items():
            stamps = np.array([row[0] for row in rows], dtype=np.int64)
            values = np.array([row[1:] for row in rows]).reshape(-1, 6)
            series[topic] = ReceivedPoses(stamps, values[:, :3], values[:, 3:])
        return series


def replay_through_nodes(
    bag: Path,
    topics: list[str],
    *,
    domain: int,
    model: Path,
    rate: float = 0.0,
    server: tuple[str, ...] = ('-p', 'refit:=false'),
    tracker: tuple[str, ...] = (),
) -> dict[str, ReceivedPoses]:
    """Replay a bag through field_model and tracker, each in its process; poses by topic.

    Parameters
    ----------
    topics : full names of PoseStamped topics to receive
    model : file that both nodes load
    rate : of the replay; 0 for as fast as it is taken
    server : parameters of field_model beside its model file
    tracker : parameters of the tracker beside its model file
    """
    with tempfile.TemporaryDirectory() as folder:
        logs = Path(folder)
        file = f'model_file:={model}'
        listener = Listener(topics, domain)
        processes = [
            start('field_model', '--ros-args', '-p', file, *server, domain=domain,
                  log=logs / 'field_model.log'),
            start('tracker', '--ros-args', '-p', file, *tracker, domain=domain,
                  log=logs / 'tracker.log'),
        ]  # fmt: skip
        try:
            listener.announce(read_bag(bag).setup_text)
            if any('baseline_file' in argument for argument in server):
                listener.await_refit()
            player = start(
                'replay', str(bag), '--rate', str(rate), '--wait', str(STARTUP_S),
                domain=domain, log=logs / 'replay.log',
            )  # fmt: skip
            processes.append(player)
            while player.poll() is None:
                listener.spin(0.2)
            assert player.returncode == 0, (logs / 'replay.log').read_text()
            before = -1
            while listener.total() != before:  # what is on its way comes sooner than that
                before = listener.total()
                listener.spin(2.0)
            return listener.poses()
        finally:
            stop(processes)
            listener.close()
