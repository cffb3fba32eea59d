"""Keeps the model that the tracker uses, with its age while the references are silent."""

from dataclasses import replace

from anser_ros.field.model import FieldModel
from anser_ros.integrity.ageing import FrameModel, ModelAge
from anser_ros.nodes.tracker_parts.model_intake import GivenModel
from anser_ros.physics.volume import TrackedVolume
from anser_ros.pose_states import OTHER_MODEL, REFERENCES_LOST, UNCALIBRATED, Withheld
from anser_ros.wire.setup import Setup

REASONS = {REFERENCES_LOST: 'no reference readings yet, or too few'}
"""What is said of a state that the server names, where it needs words."""
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
        standing = self._age.at(stamp_ns, REASONS.get(state, ''))
        if standing.model is None:
            standing = replace(standing, model=self.field)
        if state and state != REFERENCES_LOST:
            return FrameModel(standing.model, Withheld(state, 'reported by field_model'))
        return standing

    def soon(self) -> FieldModel | None:
        """Return the model that a frame will be tracked with that comes just after the newest."""
        if self._differs or not self._age.newest_ns:
            return self.field
        return self._age.at(self._age.newest_ns + 1).model or self.field
