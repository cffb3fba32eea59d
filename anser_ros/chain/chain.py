"""Writes down the order in which a frame passes both halves, wherever they run."""

from collections.abc import Sequence
from typing import Any, Protocol

from anser_ros.chain.frame import ChainFrame, FrameReadings
from anser_ros.tracking.estimate import PoseEstimate


class Refits(Protocol):
    """Gives models, as `ModelHalf` does by references; what it says is for the other half."""

    def step(self, frame: ChainFrame) -> Any:
        """Return what is to be used for the frame; None where that has not changed."""

    def witnessed(self, frame: ChainFrame, found: Sequence[PoseEstimate]) -> None:
        """Take in what a frame's tools read, and the poses that were found."""


class Tracks(Protocol):
    """Gives poses, as `TrackingHalf` does."""

    def use(self, answer: Any, ahead: bool = False) -> None:
        """Track by another answer; one ahead of frames is for the frame after its own."""

    def step(self, stamp_ns: int, tools: FrameReadings) -> list[PoseEstimate]:
        """Return the estimates of a frame."""


class Chain:
    """Takes frames through both halves, without a clock of its own.

    Each frame is read, judged, refitted, tracked and judged in this order, so that it is tracked
    by its own model. If the refit ``lags``, its poses come first, by the model of the frame
    before, aged by a frame. What tools contradict is for the next frame.
    """

    def __init__(self, refits: Refits | None, tracks: Tracks, lags: bool = False) -> None:
        self._refits, self._tracks, self._lags = refits, tracks, lags
        self._used: Any = None

    def step(self, frame: ChainFrame) -> list[PoseEstimate]:
        """Return the estimates of a frame, with their states; none where it has no tools."""
        if not self._lags:
            self._refit(frame)
        found: list[PoseEstimate] = []
        if frame.tools is not None:
            found = self._tracks.step(frame.stamp_ns, frame.tools)
        if self._lags:
            self._refit(frame)
        if self._refits is not None and frame.tools is not None:
            self._refits.witnessed(frame, found)
        return found

    def _refit(self, frame: ChainFrame) -> None:
        answer = None if self._refits is None else self._refits.step(frame)
        if answer is not None and answer is not self._used:
            self._tracks.use(answer, self._lags)
            self._used = answer
