"""Point clouds as messages, where a test reads or changes what nodes publish as bytes."""

from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import PointCloud2

from anser_ros.nodes.streams.clouds import flux_cloud
from anser_ros.wire.cdr import PointCloud, read_cloud


def message_of(cloud: bytes) -> PointCloud2:
    return deserialize_message(cloud, PointCloud2)


def received(message: PointCloud2) -> PointCloud:
    """The message as a node has it that it was sent to."""
    return read_cloud(bytes(serialize_message(message)))


class FluxCloud:
    """Makes messages of fluxes in a frame."""

    def __init__(self, frame_id):
        self.frame_id = frame_id

    def message(self, points, stamp_ns):
        return message_of(flux_cloud(points, self.frame_id, stamp_ns))
