"""Compares the system's clock with the monotonic one: what separates them, and when it was set."""

import time
from collections.abc import Callable

_TRIES = 5
"""Readings of both clocks of which the closest together counts: between two readings a thread may
have to wait, and the wait would be taken for a part of the difference."""
_CLOSE_NS = 20_000
"""Time (20 us) from one reading to the next that is close enough to try no more."""
_STEP_NS = 5_000_000
"""Change of the difference (5 ms) from one look to the next that is no drift but a setting. A
clock that is being slewed moves by 0.5 ms a second."""


class WallClock:
    """Converts monotonic times to the system's time, which may be set while we run.

    ``sets`` counts how often that happened.
    """

    def __init__(
        self,
        wall_ns: Callable[[], int] = time.time_ns,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._wall_ns, self._monotonic_ns = wall_ns, monotonic_ns
        self._offset_ns: int | None = None
        self.sets = 0

    def offset_ns(self) -> int:
        """Return the system's time minus the monotonic time now, ns."""
        best_ns, offset_ns = -1, 0
        for _ in range(_TRIES):
            before_ns = self._monotonic_ns()
            wall_ns = self._wall_ns()
            width_ns = self._monotonic_ns() - before_ns
            if best_ns < 0 or width_ns < best_ns:
                best_ns, offset_ns = width_ns, wall_ns - before_ns - width_ns // 2
            if best_ns <= _CLOSE_NS:
                break
        if self._offset_ns is not None and abs(offset_ns - self._offset_ns) > _STEP_NS:
            self.sets += 1
        self._offset_ns = offset_ns
        return offset_ns
