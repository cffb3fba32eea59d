"""Detects when a node has fallen too far behind what it receives to catch up by itself.

Poses that are late by several windows are useless for guidance, so a node that is slower than its
input discards the waiting messages and takes the newest. A node that only paused may catch up, and
loses nothing.
"""

from collections import deque
from statistics import median

from anser_ros.stamps import NANO

LATE_WINDOWS = 3.0
"""Age of a message, in the spacing of messages, from which it may be late. Smaller, and the jitter
of a loaded machine looks like a backlog; larger, and poses are that many windows old."""
SHORTEST_LATE_S = 0.05
"""Age, s, below which no message is late, however fast messages come: the executor has delays."""
CATCH_UP_S = 1.0
"""A backlog that will be gone within this time is worked off."""
MEMORY = 25
"""Messages that typical figures are taken of, so that a few slow ones say nothing."""
FEWEST_MESSAGES = 10
"""Messages that must have been worked on before a backlog is judged: the first ones are slow."""
MOST_LEFT_OUT = 2
"""Frames in a row that are left out by what gives way to newer ones. Fewer, and poses of a
computer that is a tenth too slow fall behind; more, and the model is older than metal in a hand
allows."""


class Backlog:
    """Estimates the typical spacing of messages, and the time that each takes."""

    def __init__(self, spacing_s: float | None = None) -> None:
        known = () if spacing_s is None else (spacing_s,)
        self._spacing_s: deque[float] = deque(known, maxlen=MEMORY)
        self._work_s: deque[float] = deque(maxlen=MEMORY)
        self._last = (0, 0)
        self._left_out = 0

    def arrived(self, received_ns: int, stamp_ns: int) -> None:
        """Note when the middleware received the message that is worked on next, and its stamp.

        A burst of messages does not count as faster than its stamps.
        """
        last, self._last = self._last, (received_ns, stamp_ns)
        if last[0]:
            self._spacing_s.append(max(received_ns - last[0], stamp_ns - last[1], 0) * NANO)

    def worked(self, seconds: float) -> None:
        """Note how long a message took."""
        self._work_s.append(seconds)

    def is_hopeless(self, age_s: float) -> bool:
        """Return whether a message of this age shows a backlog that will not be gone soon."""
        if age_s < SHORTEST_LATE_S or len(self._work_s) < FEWEST_MESSAGES:
            return False
        spacing_s, work_s = median(self._spacing_s), median(self._work_s)
        if age_s < LATE_WINDOWS * spacing_s:
            return False
        share = work_s / max(spacing_s, 1e-9)
        return share >= 1.0 or age_s * share / (1.0 - share) > CATCH_UP_S

    def gives_way(self, age_s: float) -> bool:
        """Return whether to leave out, of a frame so old, work that can wait for newer ones."""
        behind = bool(self._spacing_s) and age_s > median(self._spacing_s)
        is_left_out = behind and self._left_out < MOST_LEFT_OUT
        self._left_out = self._left_out + 1 if is_left_out else 0
        return is_left_out
