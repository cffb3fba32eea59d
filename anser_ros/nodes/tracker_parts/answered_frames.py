"""Brings tool frames together with the field models that were made for their instants.

A server that follows the references answers each of their frames by a model with its stamp. A tool
frame is tracked with the model of its own stamp, or the newest before it, so it waits for the
answer: a few milliseconds, and never longer than it may. So live poses are the same as offline. If
there is no such server, no frame waits.
"""

import math
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

Model = TypeVar('Model')
Frame = TypeVar('Frame')

FAR_AHEAD_NS = 1_000_000_000
"""A model that far from a frame has its stamp from another clock (a recording's, the host's)."""
MOST_LATE = 5
"""Frames in a row that waited in vain, after which none waits until an answer has come again."""
NO_WAIT_S = -math.inf
"""Time until which a frame waits that is not to wait."""
MOST_WAITING = 200
"""Most frames and models that are kept waiting, each; older models are dropped, and the oldest
frame is tracked at once. At 50 frames a second that is four seconds, beyond any useful wait."""


class AnsweredFrames(Generic[Model, Frame]):
    """Keeps frames and models in the order in which they are to be used.

    ``use`` activates a model, ``track`` works on a frame with the active one. ``follows`` is
    whether the server answers frames, by its own word; ``late`` counts frames that waited in vain.
    """

    def __init__(self, use: Callable[[Model], None], track: Callable[[Frame], None]) -> None:
        self._use, self._track = use, track
        self._models: deque[tuple[int, Model]] = deque(maxlen=MOST_WAITING)
        self._frames: deque[tuple[int, Frame, float]] = deque()
        self._last_frame_ns = 0
        self._active_ns = 0
        self._in_vain = 0
        self.follows = False
        self.late = 0

    @property
    def waiting(self) -> bool:
        """Return whether a frame waits for its model."""
        return bool(self._frames)

    def add_model(self, stamp_ns: int, model: Model, now_s: float) -> None:
        """Take a model, and what becomes possible by it."""
        frames = (self._last_frame_ns, *(stamp for stamp, _, _ in self._frames))
        if stamp_ns in frames:
            self._in_vain = 0
        self._models.append((stamp_ns, model))
        self.work(now_s)

    def add_frame(self, stamp_ns: int, frame: Frame, now_s: float, longest_wait_s: float) -> None:
        """Take a frame, and track it once its model is there, at most so much later.

        A frame that should not wait, with 0, is not late.
        """
        until_s = now_s + longest_wait_s if longest_wait_s > 0 else NO_WAIT_S
        self._frames.append((stamp_ns, frame, until_s))
        self.work(now_s)

    def work(self, now_s: float) -> None:
        """Track the frames that need not wait any longer."""
        while self._frames:
            stamp_ns, frame, until_s = self._frames[0]
            self._use_models(stamp_ns)
            if not self._is_answered(stamp_ns):
                overdue = now_s >= until_s or len(self._frames) > MOST_WAITING
                waits = until_s != NO_WAIT_S
                if self.follows and waits and self._in_vain < MOST_LATE:
                    if not overdue:
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

    def _is_answered(self, stamp_ns: int) -> bool:
        """Whether the model of a frame is active, or a later one says that it has none."""
        return self._active_ns == stamp_ns or bool(self._models)
