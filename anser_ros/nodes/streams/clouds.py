"""Writes clouds as messages, reads what all clouds have, and names what of a setup is measured."""

import array
from collections.abc import Sequence

from sensor_msgs.msg import PointCloud2, PointField

from anser_ros.errors import LayoutError
from anser_ros.stamps import set_stamp
from anser_ros.wire.points import FluxPoints, PointFieldTuple, encode_flux

FLUX_NOISE = 'flux_noise_t'
"""Key of the setup document: what the fluxes' components scatter by, T."""
STAMP_SIGMA = 'stamp_sigma_s'
"""Key of the setup document: what the stamps are uncertain by, s."""
FLUX_RATE = 'flux_rate_hz'
"""Key of the setup document: the fluxes' rate, which is the stream's own once there is one, Hz."""


def without_measured(text: str) -> str:
    """Return a setup document's text without the values that acquisition measures.

    What is left never changes while a sender runs: board, coils and sensors.
    """
    keys = tuple(f'{key}:' for key in (FLUX_NOISE, STAMP_SIGMA, FLUX_RATE))
    return '\n'.join(line for line in text.split('\n') if not line.startswith(keys))


class CloudMaker:
    """Makes point clouds; the fields of each layout are built once."""

    def __init__(self) -> None:
        self._fields: dict[tuple[PointFieldTuple, ...], list[PointField]] = {}

    def message(
        self,
        packed: tuple[Sequence[PointFieldTuple], int, bytes],
        frame_id: str,
        stamp_ns: int,
    ) -> PointCloud2:
        """Return the message of packed points (fields, point_step, bytes)."""
        fields, step, data = packed
        key = tuple(fields)
        if key not in self._fields:
            self._fields[key] = [
                PointField(name=name, offset=offset, datatype=datatype, count=count)
                for name, offset, datatype, count in fields
            ]
        message = PointCloud2()
        message.header.frame_id = frame_id
        set_stamp(message.header.stamp, stamp_ns)
        message.height, message.width = 1, len(data) // step
        message.fields = self._fields[key]
        message.point_step, message.row_step = step, len(data)
        # An array is handed over in microseconds; bytes are checked one by one.
        buffer = array.array('B')
        buffer.frombytes(data)
        message.data = buffer
        message.is_dense = True
        return message


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


def layout_of(message: PointCloud2) -> list[PointFieldTuple]:
    """Return the fields of a cloud as plain tuples."""
    return [(f.name, f.offset, f.datatype, f.count) for f in message.fields]


def width_of(message: PointCloud2) -> int:
    """Return the number of points of a cloud that has one row.

    Raises `LayoutError` when the cloud has more rows.
    """
    if message.height != 1:
        raise LayoutError(f'the cloud must have height 1, got {message.height}')
    return int(message.width)
