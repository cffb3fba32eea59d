"""Flux messages to arrays: the layout is checked in full once, then read in one go."""

from sensor_msgs.msg import PointCloud2

from anser_ros.errors import LayoutError
from anser_ros.nodes.model_clouds import NANO, layout_of, stamp_of, width_of
from anser_ros.wire.points import FluxPoints, decode_flux


def read_flux(message: PointCloud2) -> tuple[int, FluxPoints]:
    """Stamp (ns) and points of a flux message.

    Raises
    ------
    LayoutError
        When the stamp is zero or none, or the cloud is no flux cloud.
    """
    if message.header.stamp.nanosec >= NANO:
        raise LayoutError(
            f'the stamp has {message.header.stamp.nanosec} nanoseconds, a second or more'
        )
    stamp_ns = stamp_of(message)
    if stamp_ns <= 0:
        raise LayoutError('the flux message has no stamp')
    width = width_of(message)
    return stamp_ns, decode_flux(
        layout_of(message), message.point_step, width, message.data, bool(message.is_bigendian)
    )
