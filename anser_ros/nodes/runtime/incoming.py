"""Takes messages as they arrive: what is too large is refused before it becomes an object.

Turning a cloud of a million points into a message takes a third of a second, so what arrives is
taken as bytes, and their number, and the sizes that they state, are looked at.
"""

from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String

from anser_ros.errors import LayoutError
from anser_ros.wire.cdr import cloud_head
from anser_ros.wire.points import MOST_POINTS

MOST_BYTES = {String: 1_000_000, DiagnosticArray: 1_000_000, PointCloud2: 16_000_000}
"""Largest message of a type, bytes: a setup of a thousand sensors has 0.2 MB, the uncertainty of a
model of 4000 dipoles 6 MB."""
MOST_FIELDS = 4096
"""Most fields of a cloud, which is one of 2000 emitters: each field is an object to be made."""


def opened(data: bytes, message_type: type) -> Any:
    """Return the message that serialised bytes hold.

    Raises `LayoutError` when there are more bytes, points or fields than a sensible message has.
    """
    most = MOST_BYTES[message_type]
    if len(data) > most:
        raise LayoutError(f'a message of {len(data)} bytes is refused, the most is {most}')
    if message_type is PointCloud2:
        height, width, fields = cloud_head(data)
        if height * width > MOST_POINTS or fields > MOST_FIELDS:
            raise LayoutError(
                f'a cloud of {height} x {width} points with {fields} fields is refused, '
                f'the most is {MOST_POINTS} with {MOST_FIELDS}'
            )
    return deserialize_message(data, message_type)
