"""Holds what the halves of the chain give each other, and joins frames with their answers."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from anser_ros.arrays import ComplexArray, Integers
from anser_ros.field.model import FieldModel
from anser_ros.pose_states import Withheld


@dataclass(frozen=True)
class FrameReadings:
    """Holds what S sensors read in one frame: channels, fluxes (S, K), T, and flag bits."""

    channels: Integers
    flux: ComplexArray
    flags: Integers


@dataclass(frozen=True)
class ChainFrame:
    """Holds all that tools or references, or both, measured under one stamp."""

    stamp_ns: int
    tools: FrameReadings | None
    reference: FrameReadings | None

    def in_phase(self) -> 'ChainFrame':
        """Return the frame without the quadrature parts of the tools' fluxes."""
        tools = self.tools
        if tools is None:
            return self
        return replace(self, tools=replace(tools, flux=tools.flux.real.astype(complex)))


@dataclass(frozen=True)
class Answer:
    """Holds the model that is to be used from a stamp on, and why no pose may be given, if so.

    The model is None while there is none but the tracker's own. If it ``follows`` references,
    their frames are answered one by one, and it ages until the next answer. Poses state its
    ``name``, or what distinguishes its arrays where that is None.
    """

    stamp_ns: int
    model: FieldModel | None
    follows: bool = False
    withheld: Withheld | None = None
    name: str | None = None


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

    def __init__(self, use: Callable[[Any], object], track: Callable[[Any], object]) -> None:
        self._use, self._track = use, track
        self._models: deque[tuple[int, Any]] = deque(maxlen=MOST_WAITING)
        # Each with the time until which it waits, None where it is not to, and whether it lags.
        self._frames: deque[tuple[int, Any, float | None, bool]] = deque()
        self._last_frame_ns = self._active_ns = self._in_vain = 0
        self.follows = False
        self.late = 0

    @property
    def waiting(self) -> bool:
        """Return whether a frame waits for its model."""
        return bool(self._frames)

    def add_model(self, stamp_ns: int, model: Any, now_s: float) -> None:
        """Take a model, and what becomes possible by it."""
        frames = (self._last_frame_ns, *(stamp for stamp, *_ in self._frames))
        if stamp_ns in frames:
            self._in_vain = 0
        self._models.append((stamp_ns, model))
        self.work(now_s)

    def add_frame(
        self, stamp_ns: int, frame: Any, now_s: float, longest_wait_s: float, lags: bool = False
    ) -> None:
        """Take a frame, and track it once its model is there, at most so much later.

        It is the frame's own model or, where that ``lags``, that of the frame before. A frame that
        should not wait, with 0, is not late.
        """
        until_s = now_s + longest_wait_s if longest_wait_s > 0 else None
        self._frames.append((stamp_ns, frame, until_s, lags))
        self.work(now_s)

    def work(self, now_s: float) -> None:
        """Track the frames that need not wait any longer."""
        while self._frames:
            stamp_ns, frame, until_s, lags = self._frames[0]
            due_ns = (self._last_frame_ns if lags else 0) or stamp_ns
            self._use_models(due_ns)
            # Its model is active, or a later one says that it has none.
            is_answered = self._active_ns == due_ns or bool(self._models)
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
