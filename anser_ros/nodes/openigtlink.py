"""Serves every pose, and the state of what has none, to 3D Slicer as OpenIGTLink."""

import math
import sys
import time
from dataclasses import dataclass
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from std_msgs.msg import String

from anser_ros.nodes import qos
from anser_ros.nodes.igtl_server import IgtlServer, state_bytes, transform_bytes
from anser_ros.nodes.node import AnserNode, Level, Status, main
from anser_ros.nodes.parameters import parameter
from anser_ros.wire.setup import parse_setup, topic_of

WATCH_PERIOD_S = 0.05
"""How often sensors are looked at that have fallen silent, s."""
OK = 'ok'
SILENT = 'stale'


@dataclass(frozen=True)
class OpenIGTLinkParameters:
    """Parameters of the OpenIGTLink server."""

    host: str = parameter('127.0.0.1', 'address to listen on; 0.0.0.0 lets other machines in')
    port: int = parameter(18944, 'TCP port, 0 for a free one', minimum=0, maximum=65535)
    stale_after_s: float = parameter(
        0.3, 'a sensor without a pose for so long is reported, s', minimum=0.02, live=True
    )


class OpenIGTLink(AnserNode):
    """Sends each pose as TRANSFORM (mm, frame of the board), each change of state as STRING.

    The device is the sensor's or the body's name of the setup document, the state's device is
    that with ``/state``.
    """

    NAME = 'openigtlink'
    PARAMETERS = OpenIGTLinkParameters

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._server = IgtlServer(self.parameters.host, self.parameters.port)
        self.get_logger().info(f'listening on {self.parameters.host}:{self._server.port}')
        self._pose_subscriptions: dict[str, Any] = {}
        self._states: dict[str, str] = {}
        self._last_pose_s: dict[str, float] = {}
        self._n_clients = 0
        self.create_subscription(String, 'setup', self._on_setup, qos.LATCHED)
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, qos.EVENTS)
        self.create_timer(WATCH_PERIOD_S, self._watch, clock=self.steady_clock)

    @property
    def port(self) -> int:
        """The TCP port in use."""
        return self._server.port

    def status(self) -> Status:
        """Return how many clients there are, and what they have missed."""
        values = {
            'address': f'{self.parameters.host}:{self._server.port}',
            'clients': self._server.n_clients,
            'clients_refused': self._server.refused,
            'messages_dropped': self._server.dropped,
            'sensors_ok': sum(state == OK for state in self._states.values()),
        }
        if not self._states:
            return Status('', Level.WARN, 'no setup yet', values)
        return Status('', Level.OK, 'serving', values)

    def close(self) -> None:
        """End the connections of all clients."""
        self._server.close()

    def _on_setup(self, message: String) -> None:
        setup = parse_setup(message.data)
        names = [sensor.name for sensor in setup.tool_sensors] + list(setup.bodies)
        for name in set(self._pose_subscriptions) - set(names):
            self.destroy_subscription(self._pose_subscriptions.pop(name))
            self._states.pop(name, None)
            self._last_pose_s.pop(name, None)
        for name in names:
            if name not in self._pose_subscriptions:
                self._set_state(name, 'no pose yet')
                self._pose_subscriptions[name] = self.create_subscription(
                    PoseStamped, f'{topic_of(name)}/pose', self._taker(name), qos.STREAM
                )

    def _taker(self, name: str) -> Any:
        def take(message: PoseStamped) -> None:
            self._on_pose(name, message)

        return take

    def _on_pose(self, name: str, message: PoseStamped) -> None:
        point, turn = message.pose.position, message.pose.orientation
        position = (point.x, point.y, point.z)
        quaternion = (turn.x, turn.y, turn.z, turn.w)
        if not all(map(math.isfinite, position + quaternion)) or not any(quaternion):
            self.warn('poses_refused', f'{name}: a pose that is not one')
            return
        self._last_pose_s[name] = time.monotonic()
        self._set_state(name, OK)
        if self._n_clients:
            stamp_s = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
            self._server.send(transform_bytes(name, stamp_s, position, quaternion))
            self.count('transforms')

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        """Take the tracker's reasons for sensors that have no pose just now."""
        for status in message.status:
            node, _, part = status.name.partition(': ')
            if node.endswith('/tracker') and part in self._states and self._is_silent(part):
                self._set_state(part, status.message if status.message != OK else SILENT)

    def _is_silent(self, name: str) -> bool:
        last_s = self._last_pose_s.get(name, -math.inf)
        return time.monotonic() - last_s > self.parameters.stale_after_s

    def _watch(self) -> None:
        for name, state in self._states.items():
            if state == OK and self._is_silent(name):
                self._set_state(name, SILENT)
        before, self._n_clients = self._n_clients, self._server.n_clients
        if self._n_clients > before:  # whoever is new must know what has no pose
            for name, state in self._states.items():
                self._send_state(name, state)

    def _set_state(self, name: str, state: str) -> None:
        if self._states.get(name) != state:
            self._states[name] = state
            self._send_state(name, state)

    def _send_state(self, name: str, state: str) -> None:
        if self._n_clients:
            self._server.send(state_bytes(name, time.time(), state))
            self.count('states')


if __name__ == '__main__':
    sys.exit(main(OpenIGTLink))
