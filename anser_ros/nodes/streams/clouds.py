"""Writes fluxes and field models as messages, and reads them. What is no message of the setup
is refused and counted; the contents of a frame are judged by `frames.intake`. A model is two
messages: its dipoles and their uncertainty.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from anser_ros.chain.frame import FrameReadings
from anser_ros.effects.correction import needs_correction
from anser_ros.errors import LayoutError
from anser_ros.field.model import FieldModel
from anser_ros.frames.intake import Count
from anser_ros.pose_states import state_of
from anser_ros.stamps import SECOND_NS, stamp_of
from anser_ros.wire.cdr import PointCloud, cloud_bytes
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


def cloud_of(
    packed: tuple[Sequence[PointFieldTuple], int, bytes],
    frame_id: str,
    stamp_ns: int,
    is_dense: bool = True,
) -> bytes:
    """Return the bytes of a cloud of packed points (fields, point_step, bytes).

    They are published in a fraction of the time that a message takes.
    """
    fields, step, data = packed
    return cloud_bytes(stamp_ns, frame_id, fields, step, len(data) // step, data, is_dense)


def flux_cloud(points: FluxPoints, frame_id: str, stamp_ns: int) -> bytes:
    """Return the cloud of a window by its middle, ns of the ROS clock, a point per sensor."""
    return cloud_of(encode_flux(points), frame_id, stamp_ns, _is_dense(points))


def _is_dense(points: FluxPoints) -> bool:
    flux, place = points.flux, points.position
    return not ((flux != flux).any() or (place != place).any())  # no NaN


def layout_of(cloud: PointCloud) -> tuple[list[PointFieldTuple], int, int, memoryview]:
    """Return the fields of a cloud, its point_step, its points and its bytes.

    Raises `LayoutError` when the cloud has more rows than one.
    """
    if cloud.height != 1:
        raise LayoutError(f'the cloud must have height 1, got {cloud.height}')
    return cloud.fields, cloud.point_step, cloud.width, cloud.data


def is_frame(given_id: str, frame_id: str) -> bool:
    """Return whether a frame is the one, alone or behind a prefix that ends with _ or /."""
    return given_id == frame_id or given_id.endswith((f'_{frame_id}', f'/{frame_id}'))


def read_frame(message: PointCloud, frame_id: str, count: Count) -> tuple[int, FluxPoints]:
    """Read a flux message that must be in a frame, with any prefix; its peculiarities are counted.

    The counters are ``fluxes_big_endian``, ``fluxes_other_frame_id``, ``fluxes_without_stamp``.
    Raises `LayoutError` when it is in another frame, has no stamp, or is no flux cloud.
    """
    given_id = message.header.frame_id
    if not is_frame(given_id, frame_id):
        count('fluxes_other_frame_id', 1)
        raise LayoutError(f'fluxes in the frame {given_id!r}, the setup is in {frame_id!r}')
    if message.is_bigendian:
        count('fluxes_big_endian', 1)
    stamp_ns, nanosec = stamp_of(message), message.header.stamp.nanosec
    if stamp_ns <= 0 or nanosec >= SECOND_NS:
        count('fluxes_without_stamp', 1)
    if nanosec >= SECOND_NS:
        raise LayoutError(f'the stamp has {nanosec} nanoseconds, a second or more')
    if stamp_ns <= 0:
        raise LayoutError('the flux message has no stamp')
    return stamp_ns, decode_flux(*layout_of(message), message.is_bigendian)


def readings_of(points: FluxPoints) -> FrameReadings:
    """Return what the chain takes of a frame's points."""
    return FrameReadings(points.channel, points.flux, points.flags)


@dataclass(frozen=True)
class GivenModel:
    """Holds a model as its readers have it; ``error`` is None if no uncertainty is stated."""

    stamp_ns: int
    points: DipolePoints
    error: ModelError | None

    @property
    def follows(self) -> bool:
        """Return whether every frame of the references is answered by a model of its stamp."""
        return self.error is not None and self.error.follows

    @property
    def withheld(self) -> str:
        """Return the state for which the server wants no pose to be given; empty where none is."""
        code = 0 if self.error is None else self.error.withheld
        return state_of(code)


class ModelWriter:
    """Lays models out for their readers, and makes the bytes of the two messages of each."""

    def __init__(self) -> None:
        self._laid_out: tuple[FieldModel, DipolePoints] | None = None
        self._uncertainty: tuple[tuple[Any, ...], ModelError] | None = None
        self._origin = '', 0

    def name_origin(self, base: FieldModel) -> None:
        """Tell from now on which model the served ones are made from."""
        self._origin = base.fingerprint, sum(needs_correction(record) for record in base.effects)

    def given(
        self, model: FieldModel, stamp_ns: int, follows: bool, withheld: int = 0
    ) -> GivenModel:
        """Return a model as its readers have it; what is the same as of the last is shared."""
        if self._laid_out is None or self._laid_out[0] is not model:
            points = DipolePoints(model.positions, model.directions, model.moments)
            self._laid_out = model, points
        known, modes = self._uncertainty, model.modes
        now = model.flux_error_t, len(model.positions), follows, withheld, *self._origin
        if known is None or known[0][0] is not modes or known[0][1:] != now:
            if modes is None:
                modes = np.zeros((0, *model.moments.shape), dtype=complex)
            error = ModelError(float(model.flux_error_t), modes, follows, withheld, *self._origin)
            self._uncertainty = known = (model.modes, *now), error
        return GivenModel(stamp_ns, self._laid_out[1], known[1])

    def dipoles(self, given: GivenModel, frame_id: str) -> bytes:
        """Return the ``field_model`` message."""
        return cloud_of(encode_field_model(given.points), frame_id, given.stamp_ns)

    def error(self, given: GivenModel, frame_id: str) -> bytes:
        """Return the ``field_model_error`` message."""
        assert given.error is not None
        return cloud_of(encode_model_error(given.error), frame_id, given.stamp_ns)


def read_dipoles(message: PointCloud) -> DipolePoints:
    """Read a ``field_model`` message.

    Raises `LayoutError` when it is not a field model, has no dipole, or a direction is no unit
    vector.
    """
    points = decode_field_model(*layout_of(message), message.is_bigendian)
    if len(points.positions) == 0:
        raise LayoutError('the field model has no dipole')
    norms = np.linalg.norm(points.directions, axis=1)
    if np.abs(norms - 1.0).max() > 1e-3:
        raise LayoutError('a dipole direction is not a unit vector')
    return points


def read_error(message: PointCloud, n_dipoles: int, n_emitters: int) -> ModelError:
    """Read a ``field_model_error`` message for a model of that size; raises `LayoutError`."""
    return decode_model_error(*layout_of(message), n_dipoles, n_emitters)
