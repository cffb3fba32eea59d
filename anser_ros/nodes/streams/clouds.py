"""Writes flux clouds as messages."""

from sensor_msgs.msg import PointCloud2

from anser_ros.nodes.streams.model_clouds import CloudMaker
from anser_ros.wire.points import FluxPoints, encode_flux


class FluxCloud:
    """Makes the messages of one flux topic; their fields are built once for all of them."""

    def __init__(self, frame_id: str) -> None:
        self._frame_id, self._maker = frame_id, CloudMaker()

    def message(self, points: FluxPoints, stamp_ns: int) -> PointCloud2:
        """Return the message of a window by its middle, ns of the ROS clock, a row per sensor."""
        message = self._maker.message(encode_flux(points), self._frame_id, stamp_ns)
        flux, place = points.flux, points.position
        message.is_dense = not ((flux != flux).any() or (place != place).any())  # no NaN
        return message
