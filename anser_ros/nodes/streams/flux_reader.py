"""Reads flux messages into arrays; what is no flux message of the setup is refused and counted.

The contents of a frame, beyond its layout, are judged by `frames.intake`.
"""

from sensor_msgs.msg import PointCloud2

from anser_ros.errors import LayoutError
from anser_ros.frames.intake import Count
from anser_ros.nodes.runtime.handover import HandedFlux
from anser_ros.nodes.streams.clouds import layout_of, width_of
from anser_ros.stamps import SECOND_NS, stamp_of
from anser_ros.wire.points import FluxPoints, decode_flux


def read_frame(
    message: PointCloud2 | HandedFlux, frame_id: str, count: Count
) -> tuple[int, FluxPoints]:
    """Read a flux message that must be in a frame; its peculiarities are counted.

    The counters are ``fluxes_big_endian``, ``fluxes_other_frame_id``, ``fluxes_without_stamp``.
    Raises `LayoutError` when it is in another frame, has no stamp, or is no flux cloud.
    """
    given_id = message.frame_id if isinstance(message, HandedFlux) else message.header.frame_id
    if given_id != frame_id:
        count('fluxes_other_frame_id', 1)
        raise LayoutError(f'fluxes in the frame {given_id!r}, the setup is in {frame_id!r}')
    if isinstance(message, HandedFlux):
        return message.stamp_ns, message.points
    if message.is_bigendian:
        count('fluxes_big_endian', 1)
    stamp_ns, nanosec = stamp_of(message), message.header.stamp.nanosec
    if stamp_ns <= 0 or nanosec >= SECOND_NS:
        count('fluxes_without_stamp', 1)
    if nanosec >= SECOND_NS:
        raise LayoutError(f'the stamp has {nanosec} nanoseconds, a second or more')
    if stamp_ns <= 0:
        raise LayoutError('the flux message has no stamp')
    width = width_of(message)
    return stamp_ns, decode_flux(
        layout_of(message), message.point_step, width, message.data, bool(message.is_bigendian)
    )
