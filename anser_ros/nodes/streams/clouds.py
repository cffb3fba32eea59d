"""Writes flux clouds as messages."""

import array

from sensor_msgs.msg import PointCloud2, PointField

from anser_ros.stamps import set_stamp
from anser_ros.wire.points import FluxPoints, encode_flux


class FluxCloud:
    """Makes the messages of one flux topic; their fields are built once for all of them."""

    def __init__(self, frame_id: str) -> None:
        self._frame_id = frame_id
        self._fields: list[PointField] = []

    def message(self, points: FluxPoints, stamp_ns: int) -> PointCloud2:
        """Return the message of one window.

        Parameters
        ----------
        points : FluxPoints
            A row per sensor.
        stamp_ns : int
            Middle of the window, ns of the ROS clock.
        """
        fields, step, data = encode_flux(points)
        if len(fields) != len(self._fields):
            self._fields = [
                PointField(name=name, offset=offset, datatype=datatype, count=count)
                for name, offset, datatype, count in fields
            ]
        message = PointCloud2()
        message.header.frame_id = self._frame_id
        set_stamp(message.header.stamp, stamp_ns)
        message.height, message.width = 1, len(points.channel)
        message.fields = self._fields
        message.point_step, message.row_step = step, len(data)
        # An array is handed over in microseconds; bytes are checked one by one.
        buffer = array.array('B')
        buffer.frombytes(data)
        message.data = buffer
        message.is_dense = not bool(_has_nan(points))
        return message


def _has_nan(points: FluxPoints) -> bool:
    return bool((points.flux != points.flux).any() or (points.position != points.position).any())
