"""A field_model node that refits, in the process of the test, fed by its callbacks."""

import numpy as np
from clouds_of import FluxCloud, received
from conftest import wait
from geometry_msgs.msg import PointStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from refit_world import anser_world, metal_block
from std_msgs.msg import String
from std_srvs.srv import Trigger
from tracking_world import flux_points, setup_of
from visualization_msgs.msg import MarkerArray

from anser_ros.nodes.field_model import FieldModelNode
from anser_ros.nodes.runtime import qos
from anser_ros.sessions.starting_model import save_model
from anser_ros.wire.setup import dump_setup

HEAD = metal_block([0.03, -0.02, -0.11], [0.1, 0.12, 0.06])
FIRST_NS = 1_750_000_000_000_000_000
STEP_NS = 20_000_000


def setup_text(world, **stated):
    """The test's world as a setup document."""
    return dump_setup(setup_of(world.references).with_stated(stated))


class Rig:
    """A field_model node, what it publishes, and the callbacks that it is fed through."""

    def __init__(self, ros, folder, **parameters):
        self.world = anser_world()
        save_model(folder / 'model.yaml', self.world.model)
        values = {
            'model_file': str(folder / 'model.yaml'),
            'baseline_s': 0.2,
            'keep_state': False,
            **parameters,
        }
        self.node = FieldModelNode(
            parameter_overrides=[Parameter(name, value=value) for name, value in values.items()]
        )
        self.peer = ros.create_node('peer', namespace='anser')
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.executor.add_node(self.peer)
        self.markers, self.centroids = [], []
        self.peer.create_subscription(MarkerArray, 'metal', self.markers.append, qos.LATCHED)
        self.peer.create_subscription(
            PointStamped, 'metal/centroid', self.centroids.append, qos.STREAM
        )
        self.until(lambda: self.node._metal._centroid.get_subscription_count() > 0)
        self.cloud, self.stamp_ns = FluxCloud('fg'), FIRST_NS
        self.rng = np.random.default_rng(1)
        # Why poses are withheld with each model that is told, in codes.
        self.codes, write = [], self.node._output.given
        self.node._output.given = lambda *given: self.codes.append(given[-1]) or write(*given)

    def until(self, condition):
        spins = wait(condition, lambda: self.executor.spin_once(timeout_sec=0.02))
        assert spins, self.node.counters

    def message(self, channels, flux, flags=None):
        return self.cloud.message(flux_points(flux, flags, channels), self.stamp_ns)

    def say(self, change, fault=None):
        """One frame of the references."""
        self.stamp_ns += STEP_NS
        flux = self.world.baseline + change + self.world.noise(self.rng)
        if fault is not None:
            flux[fault] = 0.0
        self.node._on_flux(received(self.message(self.world.references.channel, flux)))
        self.executor.spin_once(timeout_sec=0.0)

    def give_baseline(self):
        if self.node._setup is None:
            self.node._on_setup(String(data=setup_text(self.world)))
        for _ in range(12):
            self.say(0.0)
        reply = self.node._on_set_baseline(Trigger.Request(), Trigger.Response())
        assert reply.success, reply.message

    def start(self):
        self.give_baseline()
        self.until(lambda: self.node.counters['refit_starts'] == 1)

    def close(self):
        self.executor.shutdown()
        self.node.destroy_node()
        self.peer.destroy_node()
