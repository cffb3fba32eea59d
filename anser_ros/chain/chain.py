"""Writes down the order in which a frame passes both halves, wherever they run."""

from collections import deque
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
        self._refits, self._tracks, self.lags = refits, tracks, lags
        self._used: Any = None

    def step(self, frame: ChainFrame) -> list[PoseEstimate]:
        """Return the estimates of a frame, with their states; none where it has no tools."""
        if not self.lags:
            self.refit(frame)
        found: list[PoseEstimate] = []
        if frame.tools is not None:
            found = self._tracks.step(frame.stamp_ns, frame.tools)
        if self.lags:
            self.refit(frame)
        if self._refits is not None and frame.tools is not None:
            self._refits.witnessed(frame, found)
        return found

    def refit(self, frame: ChainFrame) -> None:
        """Use what a frame's references give, unless it is in use; again where it comes later."""
        answer = None if self._refits is None else self._refits.step(frame)
        if answer is not None and answer is not self._used:
            self._tracks.use(answer, self.lags)
            self._used = answer


FAR_AHEAD_NS = 1_000_000_000
"""A model that far from a frame has its stamp from another clock (a recording's, the host's)."""
MOST_LATE = 5
"""Frames in a row that waited in vain, after which none waits until an answer has come again."""
MOST_WAITING = 200
"""Most frames and models that wait, each: four seconds at 50 Hz, beyond any useful wait. Older
models are dropped, and the oldest frame is tracked at once."""


class AnsweredFrames:
    """Keeps frames until the answers have come that `Chain` is to take them with, in its order.

    Answers have a ``stamp_ns``; that of a frame of references is its own. ``follows`` is whether
    the server answers frames, by its own word; ``late`` counts frames that waited in vain.
    """

    def __init__(self, tracks: Tracks) -> None:
        self._chain = Chain(self, tracks)
        self._answers: deque[Any] = deque(maxlen=MOST_WAITING)
        # Each with the time until which it waits, None where it is not to, and whether it lags.
        self._frames: deque[tuple[ChainFrame, float | None, bool]] = deque()
        self._last = ChainFrame(0, None, None)
        self._active_ns = self._in_vain = 0
        self.follows = False
        self.late = 0

    @property
    def waiting(self) -> bool:
        """Return whether a frame waits for its answer."""
        return bool(self._frames)

    def add_answer(self, answer: Any, now_s: float) -> None:
        """Take an answer, and what becomes possible by it."""
        frames = (self._last, *(frame for frame, *_ in self._frames))
        if answer.stamp_ns in [frame.stamp_ns for frame in frames]:
            self._in_vain = 0
        self._answers.append(answer)
        self.work(now_s)

    def add_frame(
        self, frame: ChainFrame, now_s: float, longest_wait_s: float, lags: bool = False
    ) -> None:
        """Take a frame, and track it once its answer is there, at most so much later.

        It is the frame's own or, where that ``lags``, that of the frame before. A frame that
        should not wait, with 0, is not late.
        """
        until_s = now_s + longest_wait_s if longest_wait_s > 0 else None
        self._frames.append((frame, until_s, lags))
        self.work(now_s)

    def work(self, now_s: float) -> None:
        """Take the frames through the chain that need not wait any longer."""
        while self._frames:
            frame, until_s, lags = self._frames[0]
            self._chain.lags = lags and self._last.stamp_ns > 0
            due = self._last if self._chain.lags else frame
            self._chain.refit(due)
            # Its answer is in use, or a later one says that it has none.
            is_answered = self._active_ns == due.stamp_ns or bool(self._answers)
            may_wait = self.follows and not is_answered and self._in_vain < MOST_LATE
            if may_wait and until_s is not None:
                if now_s < until_s and len(self._frames) <= MOST_WAITING:
                    return
                self.late += 1
                self._in_vain += 1
            self._frames.popleft()
            self._last = frame
            self._chain.step(frame)
        self._chain.refit(self._last)

    def step(self, frame: ChainFrame) -> Any:
        """Return the newest answer that is meant for a frame, None for none; later ones stay."""
        newest, stamp_ns = None, frame.stamp_ns
        while self._answers:
            answer_ns = self._answers[0].stamp_ns
            if stamp_ns < answer_ns <= stamp_ns + FAR_AHEAD_NS and self._last.stamp_ns:
                break
            newest = self._answers.popleft()
            self._active_ns = answer_ns
        return newest

    def witnessed(self, frame: ChainFrame, found: Sequence[PoseEstimate]) -> None:
        """Leave it to who answers: the server receives poses itself."""
