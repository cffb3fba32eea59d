"""Writes fluxes and field models as messages, and reads them. What is no message of the setup
is refused and counted; the contents of a frame are judged by `frames.intake`. A model is two
messages: its dipoles and their uncertainty.
"""

import array
from collections.abc import Sequence
from typing import Any

import numpy as np
from rclpy.serialization import serialize_message
from sensor_msgs.msg import PointCloud2, PointField

from anser_ros.effects.correction import needs_correction
from anser_ros.errors import LayoutError
from anser_ros.field.model import FieldModel
from anser_ros.frames.intake import Count
from anser_ros.nodes.runtime.handover import HandedFlux
from anser_ros.stamps import SECOND_NS, pack_stamp, set_stamp, stamp_of
from anser_ros.wire.points import (
    DipolePoints,
    FluxPoints,
    ModelError,
    PointFieldTuple,
    decode_field_model,
    decode_flux,
    decode_model_error,
    encode_field_model,
    encode_flux,
    encode_model_error,
)

FLUX_NOISE, STAMP_SIGMA, FLUX_RATE = 'flux_noise_t', 'stamp_sigma_s', 'flux_rate_hz'
"""Keys of the setup document that acquisition measures: by what the components of fluxes scatter,
T, by what the stamps are uncertain, s, and the stream's own rate."""


def without_measured(text: str) -> str:
    """Return a setup document's text without the values that acquisition measures."""
    keys = tuple(f'{key}:' for key in (FLUX_NOISE, STAMP_SIGMA, FLUX_RATE))
    return '\n'.join(line for line in text.split('\n') if not line.startswith(keys))


class CloudMaker:
    """Makes point clouds; the fields of each layout are built once."""

    def __init__(self) -> None:
        self._fields: dict[tuple[PointFieldTuple, ...], list[PointField]] = {}

    def message(
        self, packed: tuple[Sequence[PointFieldTuple], int, bytes], frame_id: str, stamp_ns: int
    ) -> PointCloud2:
        """Return the message of packed points (fields, point_step, bytes)."""
        fields, step, data = packed
        key = tuple(fields)
        if key not in self._fields:
            self._fields[key] = [
                PointField(name=name, offset=offset, datatype=datatype, count=count)
                for name, offset, datatype, count in fields
            ]
        message = PointCloud2(height=1, width=len(data) // step, is_dense=True)
        message.header.frame_id = frame_id
        set_stamp(message.header.stamp, stamp_ns)
        message.fields = self._fields[key]
        message.point_step, message.row_step = step, len(data)
        message.data = array.array('B', data)  # taken in microseconds; bytes are checked singly
        return message


class FluxCloud:
    """Makes the messages of flux topics; their fields are built once for all of them."""

    def __init__(self, frame_id: str) -> None:
        self._frame_id, self._maker = frame_id, CloudMaker()
        # By the shape of the fluxes: the bytes of a message, and where those of its points begin.
        self._packed: dict[tuple[int, ...], tuple[bytearray, int]] = {}

    def message(self, points: FluxPoints, stamp_ns: int) -> PointCloud2:
        """Return the message of a window by its middle, ns of the ROS clock, a row per sensor."""
        message = self._maker.message(encode_flux(points), self._frame_id, stamp_ns)
        message.is_dense = _is_dense(points)
        return message

    def packed(self, points: FluxPoints, stamp_ns: int) -> bytes:
        """Return the bytes of that message, which are published in a fraction of the time."""
        shape = points.flux.shape
        if shape not in self._packed:
            told = self.message(points, stamp_ns)
            told.data = array.array('B', mark := b'\xff' * len(told.data))
            whole = bytearray(serialize_message(told))
            self._packed[shape] = whole, whole.rindex(mark)
        whole, begin = self._packed[shape]
        data = encode_flux(points)[2]
        end = begin + len(data)
        whole[begin:end], whole[end] = data, _is_dense(points)
        pack_stamp(whole, stamp_ns)
        return bytes(whole)


def _is_dense(points: FluxPoints) -> bool:
    flux, place = points.flux, points.position
    return not ((flux != flux).any() or (place != place).any())  # no NaN


def layout_of(message: PointCloud2) -> tuple[list[PointFieldTuple], int, int, Any]:
    """Return the fields of a cloud as plain tuples, its point_step, its points and its bytes.

    Raises `LayoutError` when the cloud has more rows than one.
    """
    if message.height != 1:
        raise LayoutError(f'the cloud must have height 1, got {message.height}')
    fields = [(f.name, f.offset, f.datatype, f.count) for f in message.fields]
    return fields, message.point_step, int(message.width), message.data


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
    return stamp_ns, decode_flux(*layout_of(message), bool(message.is_bigendian))


class ModelWriter:
    """Makes the two messages of a model."""

    def __init__(self) -> None:
        self._maker = CloudMaker()
        self._encoded: tuple[FieldModel, PointCloud2] | None = None
        self._uncertainty: tuple[object, float, int, bool, int, str, int] | None = None
        self._origin = '', 0

    def name_origin(self, base: FieldModel) -> None:
        """Tell from now on which model the served ones are made from."""
        self._origin = base.fingerprint, sum(needs_correction(record) for record in base.effects)

    def dipoles(self, model: FieldModel, frame_id: str, stamp_ns: int) -> PointCloud2:
        """Return the ``field_model`` message; for the model of the last one, that one renamed."""
        if self._encoded is not None and self._encoded[0] is model:
            message = self._encoded[1]
            message.header.frame_id = frame_id
            set_stamp(message.header.stamp, stamp_ns)
            return message
        points = DipolePoints(model.positions, model.directions, model.moments)
        message = self._maker.message(encode_field_model(points), frame_id, stamp_ns)
        self._encoded = (model, message)
        return message

    def new_error(
        self, model: FieldModel, frame_id: str, stamp_ns: int, follows: bool, withheld: int = 0
    ) -> PointCloud2 | None:
        """Return the ``field_model_error`` message; None where the last one still holds."""
        kept = self._uncertainty
        size = len(model.positions)
        now = (model.modes, model.flux_error_t, size, follows, withheld, *self._origin)
        if kept is not None and kept[0] is now[0] and kept[1:] == now[1:]:
            return None
        self._uncertainty = now
        return self.error(model, frame_id, stamp_ns, follows, withheld)

    def error(
        self, model: FieldModel, frame_id: str, stamp_ns: int, follows: bool, withheld: int = 0
    ) -> PointCloud2:
        """Return the ``field_model_error`` message."""
        modes = model.modes
        if modes is None:
            modes = np.zeros((0, *model.moments.shape), dtype=complex)
        error = ModelError(float(model.flux_error_t), modes, follows, withheld, *self._origin)
        return self._maker.message(encode_model_error(error), frame_id, stamp_ns)


def read_dipoles(message: PointCloud2) -> DipolePoints:
    """Read a ``field_model`` message.

    Raises `LayoutError` when it is not a field model, has no dipole, or a direction is no unit
    vector.
    """
    points = decode_field_model(*layout_of(message), bool(message.is_bigendian))
    if len(points.positions) == 0:
        raise LayoutError('the field model has no dipole')
    norms = np.linalg.norm(points.directions, axis=1)
    if np.abs(norms - 1.0).max() > 1e-3:
        raise LayoutError('a dipole direction is not a unit vector')
    return points


def read_error(message: PointCloud2, n_dipoles: int, n_emitters: int) -> ModelError:
    """Read a ``field_model_error`` message for a model of that size; raises `LayoutError`."""
    return decode_model_error(*layout_of(message), n_dipoles, n_emitters)
