"""Runs work that takes longer than a frame in one background thread of the process.

A result comes into use at a fixed time after it was requested, measured by the stamps of the
frames: so the refit's results do not depend on how busy the machine is, and a recording gives the
live results. If the thread has not finished by then, the refit waits for it.
"""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from typing import Generic, TypeVar

DELAY_NS = 80_000_000
"""Time from asking for a result to its use, ns: four frames at 50 Hz. The longest work takes 20 ms
of a free processor, and frames wait for it on a busy one; until then the interim answer holds."""

Result = TypeVar('Result')


@cache
def _worker() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=1, thread_name_prefix='refit')


def begin_in_background(work: Callable[[], None]) -> None:
    """Start work in the thread that saves a later frame time and changes no result."""
    _worker().submit(work)


class BackgroundTask(Generic[Result]):
    """Runs one piece of work in the background thread.

    ``work``: must only read what nothing else changes. ``stamp_ns``: stamp of the frame that
    starts it, ns.
    """

    def __init__(self, work: Callable[[], Result], stamp_ns: int) -> None:
        self._begin_ns = stamp_ns
        self._future: Future[Result] = _worker().submit(work)

    def is_due(self, stamp_ns: int) -> bool:
        """Return whether the result may be used in a frame; at once where the stamps went back."""
        return not self._begin_ns <= stamp_ns < self._begin_ns + DELAY_NS

    def result(self) -> Result:
        """Return the result, and wait for it where that is necessary."""
        return self._future.result()
