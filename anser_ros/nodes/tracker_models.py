"""Gives each frame the field model of its instant. What arrives on ``field_model`` and
``field_model_error`` is brought together (`ModelIntake`), kept with its age while the
references are silent (`ActiveModel`), and joined with the frames that it answers
(`AnsweredFrames`): a server that follows the references answers each of their frames by a model
with its stamp, for which a tool frame waits a few milliseconds, so that live poses are the same
as offline.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from sensor_msgs.msg import PointCloud2

from anser_ros.errors import LayoutError
from anser_ros.field.model import FieldModel
from anser_ros.integrity.model_age import FrameModel, ModelAge
from anser_ros.nodes.streams.clouds import GivenModel, read_dipoles, read_error
from anser_ros.physics.volume import TrackedVolume
from anser_ros.pose_states import OTHER_MODEL, REFERENCES_LOST, UNCALIBRATED, Withheld
from anser_ros.stamps import stamp_of
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
        self._data = b''  # Of the newest model's dipoles, where it came as a message
        self._read: tuple[int, ModelError] | None = None
        # Uncertainties that came before their models, in the order of their arrival.
        self._early: deque[PointCloud2] = deque(maxlen=MOST_EARLY)

    @property
    def has_error(self) -> bool:
        """Return whether an uncertainty has come."""
        return self._read is not None or bool(self._early)

    def take(self, message: PointCloud2 | GivenModel) -> GivenModel:
        """Read a ``field_model`` message, or take a model that was handed over.

        Raises `LayoutError` when it is not a field model, or has no stamp.
        """
        if isinstance(message, GivenModel):
            if message.error is not None:
                self._read = len(message.points.positions), message.error
            self.newest, self._data = message, b''
            return message
        stamp_ns, newest = stamp_of(message), self.newest
        if stamp_ns <= 0:
            raise LayoutError('the field model has no stamp')
        data = message.data.tobytes()
        same = newest is not None and self._data == data
        points = newest.points if newest is not None and same else read_dipoles(message)
        self._data = data
        return self._joined(stamp_ns, points)

    def take_error(self, message: PointCloud2) -> GivenModel | None:
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
OTHER_CLOCK_NS = 5_000_000_000
"""A model whose stamp is that far ahead of the frames' has it from another clock: the host's,
where a recording is played. Its age counts from when it came."""


class ActiveModel:
    """Holds the published model, as the fluxes of each moment may be tracked with it.

    ``file_model`` is the tracker's own, whose effects apply; ``given`` is the published model, and
    ``field`` its field, or the file's while none is published.
    """

    def __init__(
        self,
        setup: Setup,
        volume: TrackedVolume,
        file_model: FieldModel | None,
        uncalibrated: bool = False,
    ) -> None:
        self._setup, self._file_model = setup, file_model
        self._uncalibrated = uncalibrated
        self.field = file_model
        self._age = ModelAge(setup.refit.references_age_s, volume)
        self._frame_ns = 0
        self._differs = ''
        self.given: GivenModel | None = None

    def field_of(self, given: GivenModel) -> FieldModel:
        """Return a published model for the setup, with the effects of the tracker's own.

        Raises `LayoutError` when it has other emitters than the setup.
        """
        if self.field is not None and given.is_same_as(self.given):
            return self.field
        return given.field_model(self._setup, self._file_model)

    def put(self, given: GivenModel, field: FieldModel) -> None:
        """Use another published model from now on, and what `field_of` made of it."""
        self.given, self.field = given, field
        self._differs = self._difference(given)
        if not given.follows:
            self._age.forget()
        elif given.withheld in ('', UNCALIBRATED):
            stamp_ns = given.stamp_ns
            # One that is far behind is late, however far; only one ahead is of another clock.
            if self._frame_ns and stamp_ns - self._frame_ns > OTHER_CLOCK_NS:
                stamp_ns = self._frame_ns
            self._age.answered(stamp_ns, field)

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

    def at(self, stamp_ns: int) -> FrameModel:
        """Return what a frame of fluxes may be tracked with."""
        self._frame_ns = stamp_ns
        if self.field is not None and self._age.newest_ns > stamp_ns + OTHER_CLOCK_NS:
            self._age.answered(stamp_ns, self.field)
        if self._differs:
            return FrameModel(self.field, Withheld(OTHER_MODEL, self._differs))
        state = '' if self.given is None else self.given.withheld
        if state == UNCALIBRATED and self._uncalibrated:
            state = ''
        reason = NO_READINGS if state == REFERENCES_LOST else 'reported by field_model'
        aged = self._age.at(stamp_ns, Withheld(state, reason) if state else None)
        return replace(aged, model=aged.model or self.field)

    def soon(self) -> FieldModel | None:
        """Return the model that a frame will be tracked with that comes just after the newest."""
        if self._differs or not self._age.newest_ns:
            return self.field
        return self._age.at(self._age.newest_ns + 1).model or self.field


FAR_AHEAD_NS = 1_000_000_000
"""A model that far from a frame has its stamp from another clock (a recording's, the host's)."""
MOST_LATE = 5
"""Frames in a row that waited in vain, after which none waits until an answer has come again."""
MOST_WAITING = 200
"""Most frames and models that wait, each: four seconds at 50 Hz, beyond any useful wait. Older
models are dropped, and the oldest frame is tracked at once."""


class AnsweredFrames:
    """Keeps frames and models in the order in which they are to be used.

    ``use`` activates a model, ``track`` works on a frame with the active one. ``follows`` is
    whether the server answers frames, by its own word; ``late`` counts frames that waited in vain.
    """

    def __init__(self, use: Callable[[Any], None], track: Callable[[Any], None]) -> None:
        self._use, self._track = use, track
        self._models: deque[tuple[int, Any]] = deque(maxlen=MOST_WAITING)
        # Each with the time until which it waits; None where it is not to wait.
        self._frames: deque[tuple[int, Any, float | None]] = deque()
        self._last_frame_ns = self._active_ns = self._in_vain = 0
        self.follows = False
        self.late = 0

    @property
    def waiting(self) -> bool:
        """Return whether a frame waits for its model."""
        return bool(self._frames)

    def add_model(self, stamp_ns: int, model: Any, now_s: float) -> None:
        """Take a model, and what becomes possible by it."""
        frames = (self._last_frame_ns, *(stamp for stamp, _, _ in self._frames))
        if stamp_ns in frames:
            self._in_vain = 0
        self._models.append((stamp_ns, model))
        self.work(now_s)

    def add_frame(self, stamp_ns: int, frame: Any, now_s: float, longest_wait_s: float) -> None:
        """Take a frame, and track it once its model is there, at most so much later.

        A frame that should not wait, with 0, is not late.
        """
        until_s = now_s + longest_wait_s if longest_wait_s > 0 else None
        self._frames.append((stamp_ns, frame, until_s))
        self.work(now_s)

    def work(self, now_s: float) -> None:
        """Track the frames that need not wait any longer."""
        while self._frames:
            stamp_ns, frame, until_s = self._frames[0]
            self._use_models(stamp_ns)
            # Its model is active, or a later one says that it has none.
            is_answered = self._active_ns == stamp_ns or bool(self._models)
            may_wait = self.follows and not is_answered and self._in_vain < MOST_LATE
            if may_wait and until_s is not None:
                if now_s < until_s and len(self._frames) <= MOST_WAITING:
                    return
                self.late += 1
                self._in_vain += 1
            self._frames.popleft()
            self._last_frame_ns = stamp_ns
            self._track(frame)
        self._use_models(self._last_frame_ns)

    def _use_models(self, stamp_ns: int) -> None:
        """Activate the newest model that is meant for a frame; later ones stay."""
        newest = None
        while self._models:
            model_ns = self._models[0][0]
            if stamp_ns < model_ns <= stamp_ns + FAR_AHEAD_NS and self._last_frame_ns:
                break
            newest = self._models.popleft()
        if newest is not None:
            self._active_ns = newest[0]
            self._use(newest[1])
