"""The tests' own end of the graph, beside a tracker or a field_model in the same process."""

import numpy as np
from clouds_of import FluxCloud
from conftest import wait
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String
from tracking_world import certain_model, flux_points, setup_of, triaxial_tool

from anser_ros.nodes.runtime import qos
from anser_ros.nodes.streams.clouds import cloud_of
from anser_ros.nodes.tracker import TrackerNode
from anser_ros.wire.cdr import read_cloud
from anser_ros.wire.points import DipolePoints, encode_field_model
from anser_ros.wire.setup import SensorSpec, dump_setup

SENSORS = triaxial_tool()
BODY = 'tool_a'
FIRST_NS = 1_750_000_000_000_000_000


def reference_specs(count=8):
    """Coils around the volume, two at each place."""
    rng = np.random.default_rng(5)
    specs = []
    for i in range(count):
        angle = 2 * np.pi * (i // 2) / (count // 2)
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        place = (0.16 * np.cos(angle), 0.16 * np.sin(angle), 0.05)
        specs.append(
            SensorSpec(16 + i, f'ref/{i}', 'fg', tuple(map(float, place)), tuple(map(float, axis)),
                       0.0)
        )  # fmt: skip
    return tuple(specs)


class Bench:
    """The test's own end of the graph."""

    points = staticmethod(flux_points)

    def __init__(self, ros, node):
        self.peer = ros.create_node('bench', namespace='anser')
        self.node = node
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(node)
        self.executor.add_node(self.peer)
        self.setup = self.peer.create_publisher(String, 'setup', qos.LATCHED)
        self.flux = self.peer.create_publisher(PointCloud2, 'tool/flux', qos.STREAM)
        self.reference = self.peer.create_publisher(PointCloud2, 'reference/flux', qos.STREAM)
        self.model = self.peer.create_publisher(PointCloud2, 'field_model', qos.LATCHED)
        self.poses, self.full, self.models, self.errors, self.states = {}, {}, [], [], {}
        for name in (*SENSORS.name, BODY):
            stem = name.replace('/0/', '_0/').replace('/1/', '_1/').replace('/2/', '_2/')
            self.peer.create_subscription(
                PoseStamped, f'{stem}/pose', self._keep(self.poses, name), 10
            )
            self.peer.create_subscription(
                PoseWithCovarianceStamped, f'{stem}/pose_with_covariance',
                self._keep(self.full, name), 10,
            )  # fmt: skip
        for name, box in (('field_model', self.models), ('field_model_error', self.errors)):
            keep = self._read_into(box)
            self.peer.create_subscription(PointCloud2, name, keep, qos.LATCHED, raw=True)
        self.peer.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)
        self.cloud = FluxCloud('fg')
        self.stamp_ns = FIRST_NS

    @staticmethod
    def _keep(box, name):
        def keep(message):
            box.setdefault(name, []).append(message)

        return keep

    @staticmethod
    def _read_into(box):
        return lambda data: box.append(read_cloud(data))

    def _on_diagnostics(self, message):
        for status in message.status:
            self.states[status.name] = (
                status.message, {item.key: item.value for item in status.values}
            )  # fmt: skip

    def close(self):
        self.executor.shutdown()
        self.node.destroy_node()
        self.peer.destroy_node()

    def state(self, name):
        return self.states.get(name, ('', {}))[0]

    def value(self, name, key):
        return self.states.get(name, ('', {}))[1].get(key, '')

    def spin_until(self, condition):
        came = wait(condition, lambda: self.executor.spin_once(timeout_sec=0.02))
        assert came, (self.node.counters, self.states)

    def connect(self, *publishers):
        self.spin_until(
            lambda: all(publisher.get_subscription_count() > 0 for publisher in publishers)
        )

    def say_setup(self, text=None):
        self.setup.publish(String(data=text or dump_setup(setup_of(SENSORS, reference_specs()))))

    def say_model(self, model, stamp_ns=5):
        packed = encode_field_model(DipolePoints(model.positions, model.directions, model.moments))
        self.model.publish(cloud_of(packed, 'fg', stamp_ns))

    def say_flux(self, flux, flags=None, stamp_ns=None):
        self.stamp_ns += 20_000_000
        stamp = self.stamp_ns if stamp_ns is None else stamp_ns
        message = self.cloud.message(self.points(flux, flags), stamp)
        self.flux.publish(message)
        return message


def wait_frame(bench, count):
    bench.spin_until(lambda: bench.node.counters['frames'] >= count)


def ready(bench):
    bench.say_setup()
    bench.say_model(certain_model())
    bench.spin_until(lambda: bench.node.counters['models'] >= 1)
    peer = bench.peer
    bench.spin_until(lambda: peer.count_publishers(f'/anser/{BODY}/pose') > 0)
    bench.spin_until(
        lambda: all(
            topic._pose.get_subscription_count() and topic._uncertain.get_subscription_count()
            for topic in bench.node._topics.values()
        )
    )


def tracker_bench(ros):
    """Yield a bench beside a tracker that hears it.

    No frame grows stale: how old one is when it is told of is a matter of the machine.
    """
    node = TrackerNode(parameter_overrides=[Parameter('stale_after_s', value=30.0)])
    bench = Bench(ros, node)
    bench.connect(bench.setup, bench.flux, bench.model)
    yield bench
    bench.close()
