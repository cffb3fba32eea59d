"""The real nodes as processes over DDS: a bag replayed through them, and what came out."""

import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from conftest import wait
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from std_msgs.msg import String

from anser_ros.cli.processes import Supervisor
from anser_ros.nodes.runtime import qos
from anser_ros.stamps import stamp_of
from anser_ros.wire.bag import read_bag

STARTUP_S = 90.0
SETTLE_S = 1.0


@dataclass(frozen=True)
class ReceivedPoses:
    """Poses of one topic: stamps (n,) in ns, positions (n, 3) in m, pose z axes (n, 3)."""

    stamp_ns: np.ndarray
    position: np.ndarray
    axis: np.ndarray


def _row(message: Any) -> tuple[float, ...]:
    p, q = message.pose.position, message.pose.orientation
    axis = (
        2 * (q.x * q.z + q.w * q.y), 2 * (q.y * q.z - q.w * q.x), 1 - 2 * (q.x * q.x + q.y * q.y)
    )  # fmt: skip
    return p.x, p.y, p.z, *axis


class Listener:
    """Gathers every PoseStamped under the namespace."""

    def __init__(self, topics: list[str], domain: int) -> None:
        import rclpy

        self._context = rclpy.Context()
        self._context.init(domain_id=domain)
        self._node = rclpy.create_node('pose_listener', context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._setup = self._node.create_publisher(String, '/anser/setup', qos.LATCHED)
        self._refit_starts = 0
        self._node.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)
        self.got: dict[str, list[Any]] = {topic: [] for topic in topics}
        for topic, messages in self.got.items():
            depth = QoSProfile(depth=4000)
            self._node.create_subscription(PoseStamped, topic, messages.append, depth)

    def _on_diagnostics(self, message: Any) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            self._refit_starts = int(values.get('refit_starts', self._refit_starts))

    def await_refit(self) -> None:
        """Wait until the field model has made its refit: frames that come before may be lost."""
        assert wait(lambda: self._refit_starts, self.spin_once, STARTUP_S), 'no refit was made'

    def announce(self, setup: str) -> None:
        """Say the setup, and wait for a publisher of every topic: before, poses would be lost."""
        self._setup.publish(String(data=setup))

        def is_there() -> bool:
            return all(self._node.count_publishers(topic) for topic in self.got)

        assert wait(is_there, self.spin_once, STARTUP_S), 'the tracker never made its topics'
        self.spin(SETTLE_S)

    def spin_once(self) -> None:
        """Receive what is there."""
        self._executor.spin_once(timeout_sec=0.05)

    def spin(self, seconds: float) -> None:
        """Receive for a while."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.spin_once()

    def total(self) -> int:
        """Number of poses so far."""
        return sum(map(len, self.got.values()))

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()

    def poses(self) -> dict[str, ReceivedPoses]:
        """What came, by topic."""
        series = {}
        for topic, messages in self.got.items():
            stamps = np.array([stamp_of(message) for message in messages], dtype=np.int64)
            values = np.array([_row(message) for message in messages]).reshape(-1, 6)
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
    listener, given = Listener(topics, domain), ('--ros-args', '-p', f'model_file:={model}')
    with tempfile.TemporaryDirectory() as folder, Supervisor(Path(folder)) as supervisor:

        def start(name: str, *arguments: str) -> Any:
            command = [sys.executable, '-m', 'anser_ros.cli.main', name, *arguments]
            return supervisor.start(name, command)

        try:
            start('field_model', *given, *server)
            start('tracker', *given, *tracker)
            listener.announce(read_bag(bag).setup_text)
            if any('baseline_file' in argument for argument in server):
                listener.await_refit()
            player = start('replay', str(bag), '--rate', str(rate), '--wait', str(STARTUP_S))
            while player.process.poll() is None:
                listener.spin(0.2)
            assert player.process.returncode == 0, player.log.read_text()
            before = -1
            while listener.total() != before:  # what is on its way comes sooner than that
                before = listener.total()
                listener.spin(2.0)
            return listener.poses()
        finally:
            listener.close()
