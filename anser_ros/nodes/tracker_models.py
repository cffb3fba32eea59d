"""Reads the models that a tracker receives: what arrives on ``field_model`` and
``field_model_error`` is brought together (`ModelIntake`), and turned into answers (`ModelReader`).
"""

from collections import deque
from typing import Any

from anser_ros.chain.frame import Answer
from anser_ros.errors import LayoutError
from anser_ros.field.model import FieldModel
from anser_ros.nodes.streams.clouds import GivenModel, read_dipoles, read_error
from anser_ros.pose_states import OTHER_MODEL, REFERENCES_LOST, UNCALIBRATED, Withheld
from anser_ros.stamps import stamp_of
from anser_ros.wire.cdr import PointCloud
from anser_ros.wire.points import DipolePoints, ModelError
from anser_ros.wire.setup import Setup

MOST_EARLY = 32
"""Uncertainties kept until their models come; the older ones are those whose models got lost."""


class ModelIntake:
    """Reads models; what is the same as before is not read again.

    So models that share their dipoles or their uncertainty share all that is derived from them.
    """

    def __init__(self) -> None:
        self.newest: GivenModel | None = None
        self._data = b''  # Of the newest model's dipoles
        self._read: tuple[int, ModelError] | None = None
        # Uncertainties that came before their models, in the order of their arrival.
        self._early: deque[PointCloud] = deque(maxlen=MOST_EARLY)

    def take(self, message: PointCloud) -> GivenModel:
        """Read a ``field_model`` message.

        Raises `LayoutError` when it is not a field model, or has no stamp.
        """
        stamp_ns, newest = stamp_of(message), self.newest
        if stamp_ns <= 0:
            raise LayoutError('the field model has no stamp')
        data = message.data.tobytes()
        same = newest is not None and self._data == data
        points = newest.points if newest is not None and same else read_dipoles(message)
        self._data = data
        return self._joined(stamp_ns, points)

    def take_error(self, message: PointCloud) -> GivenModel | None:
        """Keep an uncertainty; return the newest model with it where it is of that model.

        Raises `LayoutError` when it does not belong to that model.
        """
        self._early.append(message)
        newest = self.newest
        if newest is None or stamp_of(message) != newest.stamp_ns:
            return None
        return self._joined(newest.stamp_ns, newest.points)

    def _joined(self, stamp_ns: int, points: DipolePoints) -> GivenModel:
        error = self._error_of(stamp_ns, *points.moments.shape)
        self.newest = GivenModel(stamp_ns, points, error)
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


NO_READINGS = 'no reference readings yet, or too few'
"""What is said where the server has none."""


class ModelReader:
    """Turns published models into answers for a setup, with the effects of a tracker's own model.

    ``file_model`` is that model, whose ``name`` poses state until one is published; with
    ``uncalibrated`` that of the drawing may be used. ``own`` is the answer of it alone.
    """

    def __init__(
        self, setup: Setup, file_model: FieldModel | None, name: str, uncalibrated: bool = False
    ) -> None:
        self._setup, self._file_model, self._uncalibrated = setup, file_model, uncalibrated
        self._read: tuple[DipolePoints, ModelError | None, FieldModel] | None = None
        self.own = Answer(0, file_model, name=name)

    def answer(self, given: GivenModel) -> Answer:
        """Return what a published model says.

        Raises `LayoutError` when it has other emitters than the setup.
        """
        field = self._field_of(given)
        state, differs, withheld = given.withheld, self._difference(given), None
        if differs:
            withheld = Withheld(OTHER_MODEL, differs)
        elif state and not (state == UNCALIBRATED and self._uncalibrated):
            reason = NO_READINGS if state == REFERENCES_LOST else 'reported by field_model'
            withheld = Withheld(state, reason)
        name = str(given.stamp_ns)
        return Answer(given.stamp_ns, field, given.follows, withheld, name)

    def _field_of(self, given: GivenModel) -> FieldModel:
        """The model for the setup, the same one where only the stamp is new."""
        points, error, own = given.points, given.error, self._file_model
        if self._read is not None and self._read[0] is points and self._read[1] is error:
            return self._read[2]
        names, count = self._setup.emitter_names, points.moments.shape[1]
        if count != len(names):
            raise LayoutError(f'the field model has {count} emitters, the setup {len(names)}')
        kept: dict[str, Any] = {}
        if own is not None:
            of_own = 'flux_error_t', 'shift_sigma_m', 'open_arms', 'effects', 'gaps', 'error_share'
            kept = {name: getattr(own, name) for name in of_own}
        if error is not None:
            modes = error.modes if len(error.modes) else None
            kept |= {'flux_error_t': error.flux_error_t, 'modes': modes}
        field = FieldModel(
            points.positions, points.directions, points.moments, names,
            self._setup.frequencies_hz, **kept,
        )  # fmt: skip
        self._read = points, error, field
        return field

    def _difference(self, given: GivenModel) -> str:
        """In what the published model is not the one whose effects are undone; empty where it is.

        A model without a fingerprint passes: there is nothing to compare.
        """
        error, own = given.error, self._file_model
        if error is None or not error.fingerprint:
            return ''
        served = f'field_model serves the model {error.fingerprint}'
        if own is not None and own.fingerprint != error.fingerprint:
            return f'{served}, the model_file here is the model {own.fingerprint}'
        if own is None and error.effects:
            return f'{served}, with {error.effects} effects to correct: give its model_file here'
        return ''
