"""Tools and a model to poses: the half of the chain that tracks."""

from dataclasses import replace

from anser_ros.chain.frame import Answer, FrameReadings
from anser_ros.field.model import FieldModel
from anser_ros.integrity.model_age import FrameModel, ModelAge
from anser_ros.pose_states import UNCALIBRATED, Withheld
from anser_ros.tracking.estimate import PoseEstimate, TrackerSettings
from anser_ros.tracking.tracker import Tracker

OTHER_CLOCK_NS = 5_000_000_000
"""A model whose stamp is that far ahead of the frames' has it from another clock: the host's,
where a recording is played. Its age counts from when it came."""


class TrackingHalf:
    """Tracks tools with the models that it is given, each as far as its age allows.

    ``references_age_s`` is for how long a model that follows references holds without them, s.
    ``answer`` is the newest one, by default that of the tracker's own model, and ``withheld`` why
    the last frame has no poses.
    """

    def __init__(
        self, tracker: Tracker, references_age_s: float, answer: Answer | None = None
    ) -> None:
        self.tracker = tracker
        self.answer = answer or Answer(0, tracker.model)
        self.withheld: Withheld | None = None
        self._age = ModelAge(references_age_s, tracker.settings.box)
        self._frame_ns = 0

    def use(self, answer: Answer, ahead: bool = False) -> None:
        """Track by another answer from now on; its model is made ready for the next frame.

        The next frame is that of the answer's own stamp or, where the answer is one ``ahead``, the
        one after it. Raises `TrackingError` or `ModelFileError` when the model can't be used.
        """
        self.answer = answer
        if not answer.follows:
            self._age.forget()
        elif answer.model is not None and self._is_given(answer):
            stamp_ns = answer.stamp_ns
            # One that is far behind is late, however far; only one ahead is of another clock.
            if self._frame_ns and stamp_ns - self._frame_ns > OTHER_CLOCK_NS:
                stamp_ns = self._frame_ns
            self._age.answered(stamp_ns, answer.model)
        self._track_with(self._age.at(answer.stamp_ns + ahead).model or answer.model)

    def set_up(self, settings: TrackerSettings) -> None:
        """Track on with other settings, from where the tools were."""
        self.tracker = self.tracker.with_settings(settings)

    def step(
        self, stamp_ns: int, tools: FrameReadings, doubt: Withheld | None = None
    ) -> list[PoseEstimate]:
        """Return the estimates of a frame's tools, as `Tracker.update`, which says what raises.

        A ``doubt`` is why no pose may be given of a frame whose stamp says nothing of ages.
        """
        standing = FrameModel(self.tracker.model, doubt) if doubt else self._at(stamp_ns)
        self.withheld = standing.withheld
        if standing.model is not self.tracker.model:
            self._track_with(standing.model)
        return self.tracker.update(
            stamp_ns, tools.channels, tools.flux, tools.flags, standing.withheld,
            learns=not self.answer.follows,
        )  # fmt: skip

    @staticmethod
    def _is_given(answer: Answer) -> bool:
        """Return whether the references gave the model; a drawing is a model like any other."""
        return answer.withheld is None or answer.withheld.state == UNCALIBRATED

    def _at(self, stamp_ns: int) -> FrameModel:
        """Return what a frame may be tracked with."""
        self._frame_ns, answer = stamp_ns, self.answer
        if answer.model is not None and self._age.newest_ns > stamp_ns + OTHER_CLOCK_NS:
            self._age.answered(stamp_ns, answer.model)
        aged = self._age.at(stamp_ns, answer.withheld)
        return replace(aged, model=aged.model or answer.model or self.tracker.model)

    def _track_with(self, model: FieldModel | None) -> None:
        """Have the tracker use a model; poses state the answer's name."""
        name = self.answer.name
        if model is not None and self.tracker.model is not model:
            self.tracker = self.tracker.with_model(model, name)
        elif name is not None:
            self.tracker = self.tracker.renamed(name)
