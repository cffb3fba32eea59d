"""Publishes the two topics of the field model: its dipoles, and how uncertain they are."""

from sensor_msgs.msg import PointCloud2

from anser_ros.field.model import FieldModel
from anser_ros.nodes.runtime import qos
from anser_ros.nodes.runtime.node import AnserNode
from anser_ros.nodes.streams.model_clouds import ModelWriter
from anser_ros.pose_states import code_of


class ModelOutput(ModelWriter):
    """Publishes models, and hands them to the nodes of the same process."""

    def __init__(self, node: AnserNode) -> None:
        super().__init__()
        self._node = node
        self.models = node.create_publisher(PointCloud2, 'field_model', qos.MODELS)
        self.errors = node.create_publisher(PointCloud2, 'field_model_error', qos.MODEL_ERRORS)
        node.offer(self.errors, lasts=True)
        node.offer(self.models, lasts=True)

    def publish(
        self, model: FieldModel, frame_id: str, stamp_ns: int, follows: bool, withheld: str
    ) -> None:
        """Publish a model, and its uncertainty where that is news.

        The uncertainty is published first, so that a receiver has both when the model arrives.
        """
        error = self.new_error(model, frame_id, stamp_ns, follows, code_of(withheld))
        dipoles = self.dipoles(model, frame_id, stamp_ns)
        if error is not None:
            self._node.hand_over(self.errors, error)
        self._node.hand_over(self.models, dipoles)
        if error is not None:
            self.errors.publish(error)
        self.models.publish(dipoles)
