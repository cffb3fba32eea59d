"""A chain that is not there: a node that says what a chain of ten sensors would say."""

import math
import threading
import time

import pytest
from chromium import browser_of
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import String
from std_srvs.srv import Trigger

from anser_ros.nodes.runtime import qos
from anser_ros.wire.setup import dump_setup, parse_setup, topic_of

RATE_HZ = 50.0
SENSORS = 10
RADIUS_M = 0.08
OFF_M = 0.002
"""How far the tracked poses are from the optical ones, m, along z."""


def browser_path():
    """Return the browser, or skip where there is none, or nothing to drive it with."""
    pytest.importorskip('playwright', reason='playwright is not installed')
    pytest.importorskip('nicegui', reason='nicegui is not installed')
    path = browser_of()
    if path is None:
        pytest.skip('no Chromium is installed (apt install chromium)')
    return path


def ten_sensors():
    """Return a setup document with a coil at each of ten places of one pen."""
    coils = ''.join(
        f'  - {{name: c{k}, centre_m: [{0.1 * (k % 2)}, {0.1 * (k // 2)}, 0.0], '
        f'rotation_deg: 45.0, frequency_hz: {1000.0 + 100 * k}}}\n'
        for k in range(4)
    )
    sensors = ''.join(
        f'- {{channel: {n}, name: pen/c{n}, body: pen, position_m: [0, 0, {0.01 * n}], '
        f'axis: [{n % 2}, 0, {(n + 1) % 2}]}}\n'
        for n in range(SENSORS)
    )
    return dump_setup(
        parse_setup(
            'schema: anser_setup/1\nframe_id: fg\nflux_rate_hz: 50\nflux_unit: T\nemitter:\n'
            '  kind: square_spiral_pcb\n  turns: 25\n  side_m: 0.07\n  pitch_m: 0.0005\n'
            f'  layers: 2\n  thickness_m: 0.0016\n  current_a: 0.1\n  coils:\n{coils}'
            f'sensors:\n{sensors}'
        )
    )


class PretendedChain:
    """Poses on a circle, with optical ones beside them, states, and a service."""

    def __init__(self, rclpy, namespace='anser'):
        self.node = rclpy.create_node('pretended', namespace=namespace)
        self.space, self.calls = namespace, []
        setup = parse_setup(ten_sensors())
        self.names = [*(s.name for s in setup.tool_sensors), 'pen']
        latched = self.node.create_publisher(String, 'setup', qos.LATCHED)
        latched.publish(String(data=ten_sensors()))
        self.poses = [
            self.node.create_publisher(
                PoseWithCovarianceStamped, f'{topic_of(name)}/pose_with_covariance', qos.STREAM
            )
            for name in self.names
        ]
        self.optical = self.node.create_publisher(PoseStamped, '/optical/pen/pose', qos.STREAM)
        self.told = self.node.create_publisher(DiagnosticArray, '/diagnostics', qos.EVENTS)
        self.node.create_service(Trigger, 'recorder/start', self._start)
        self.node.create_timer(1.0 / RATE_HZ, self._send)
        self.node.create_timer(0.5, self._tell)
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.thread = threading.Thread(target=self.executor.spin, daemon=True)
        self.thread.start()

    def _start(self, _request, response):
        self.calls.append('recorder/start')
        response.success, response.message = False, 'the disk is full'
        return response

    def _send(self):
        now = self.node.get_clock().now().to_msg()
        angle = 0.5 * time.time()
        truth = PoseStamped()
        truth.header.stamp = now
        truth.header.frame_id = 'fg'
        place = truth.pose.position
        place.x, place.y, place.z = RADIUS_M * math.cos(angle), RADIUS_M * math.sin(angle), 0.15
        self.optical.publish(truth)
        for n, publisher in enumerate(self.poses):
            message = PoseWithCovarianceStamped()
            message.header = truth.header
            at = message.pose.pose.position
            at.x, at.y = place.x, place.y
            at.z = place.z + OFF_M + (0.01 * n if n < SENSORS else 0.0)
            message.pose.covariance[0] = message.pose.covariance[7] = 1e-8
            message.pose.covariance[14] = 4e-8
            publisher.publish(message)

    def _tell(self):
        def line(name, level, message, **values):
            pairs = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
            return DiagnosticStatus(level=bytes([level]), name=name, message=message, values=pairs)

        tracker = f'{self.space}/tracker'
        lines = [line(tracker, 0, '11 of 11 tracked')]
        for name in self.names:
            lines.append(
                line(f'{tracker}: {name}', 0, 'ok', rate_hz=50, frame_rate_hz=50, residual_t=9e-11)
            )
        lines[1] = line(
            f'{tracker}: {self.names[0]}', 1, 'residual', reason='4.2 times', rate_hz=0,
            frame_rate_hz=50, residual_t=5e-9,
        )  # fmt: skip
        lines.append(line(f'{self.space}/watcher', 1, 'something <b>new</b>'))
        self.told.publish(DiagnosticArray(status=lines))

    def end(self):
        """Say no more."""
        self.executor.shutdown()
        self.thread.join(5.0)
        self.node.destroy_node()
