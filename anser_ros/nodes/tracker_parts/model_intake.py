"""Brings together what arrives on ``field_model`` and ``field_model_error``."""

from collections import deque
from dataclasses import dataclass, replace

from sensor_msgs.msg import PointCloud2

from anser_ros.errors import LayoutError
from anser_ros.field.model import FieldModel
from anser_ros.nodes.streams.model_clouds import read_dipoles, read_error
from anser_ros.pose_states import state_of
from anser_ros.stamps import stamp_of
from anser_ros.wire.model_error import ModelError
from anser_ros.wire.points import DipolePoints
from anser_ros.wire.setup import Setup

MOST_EARLY = 32
"""Uncertainties kept until their models come; the older ones are those whose models got lost."""


@dataclass(frozen=True)
class GivenModel:
    """Holds a model as it came; ``error`` is None if its uncertainty is not stated."""

    stamp_ns: int
    data: bytes
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

    def is_same_as(self, other: 'GivenModel | None') -> bool:
        """Return whether only the stamp differs."""
        return other is not None and self.points is other.points and self.error is other.error

    def field_model(self, setup: Setup, file_model: FieldModel | None) -> FieldModel:
        """Return the model for a setup, with the effects of the model file.

        Raises `LayoutError` when it has other emitters than the setup.
        """
        points, count = self.points, len(setup.emitter_names)
        if points.moments.shape[1] != count:
            raise LayoutError(
                f'the field model has {points.moments.shape[1]} emitters, the setup {count}'
            )
        model = FieldModel(
            points.positions, points.directions, points.moments, setup.emitter_names,
            setup.frequencies_hz,
            flux_error_t=0.0 if file_model is None else file_model.flux_error_t,
            shift_sigma_m=0.0 if file_model is None else file_model.shift_sigma_m,
            effects=() if file_model is None else file_model.effects,
        )  # fmt: skip
        if self.error is None:
            return model
        modes = self.error.modes if len(self.error.modes) else None
        return replace(model, flux_error_t=self.error.flux_error_t, modes=modes)


class ModelIntake:
    """Reads models; what is the same as before is not read again.

    So models that share their dipoles or their uncertainty share all that is derived from them.
    """

    def __init__(self) -> None:
        self.newest: GivenModel | None = None
        self._read: tuple[int, ModelError] | None = None
        # Uncertainties that came before their models, in the order of their arrival.
        self._early: deque[PointCloud2] = deque(maxlen=MOST_EARLY)

    @property
    def has_error(self) -> bool:
        """Return whether an uncertainty has come."""
        return self._read is not None or bool(self._early)

    def take(self, message: PointCloud2) -> GivenModel:
        """Read a ``field_model`` message.

        Raises `LayoutError` when it is not a field model, or has no stamp.
        """
        stamp_ns, newest = stamp_of(message), self.newest
        if stamp_ns <= 0:
            raise LayoutError('the field model has no stamp')
        data = message.data.tobytes()
        same = newest is not None and newest.data == data
        points = newest.points if newest is not None and same else read_dipoles(message)
        return self._joined(stamp_ns, data, points)

    def take_error(self, message: PointCloud2) -> GivenModel | None:
        """Keep an uncertainty; return the newest model with it where it is of that model.

        Raises `LayoutError` when it does not belong to that model.
        """
        self._early.append(message)
        newest = self.newest
        if newest is None or stamp_of(message) != newest.stamp_ns:
            return None
        return self._joined(newest.stamp_ns, newest.data, newest.points)

    def _joined(self, stamp_ns: int, data: bytes, points: DipolePoints) -> GivenModel:
        error = self._error_of(stamp_ns, *points.moments.shape)
        self.newest = GivenModel(stamp_ns, data, points, error)
        return self.newest

    def _error_of(self, stamp_ns: int, n_dipoles: int, n_emitters: int) -> ModelError | None:
        """Return a model's uncertainty: that of its stamp, or the one before that still holds."""
        stamps = [stamp_of(message) for message in self._early]
        if stamp_ns in stamps:
            for _ in range(stamps.index(stamp_ns)):
                self._early.popleft()
            self._read = n_dipoles, read_error(self._early.popleft(), n_dipoles, n_emitters)
        read = self._read
        return read[1] if read is not None and read[0] == n_dipoles else None
