"""Shows how far a command is: a bar on a terminal, lines on stderr now and then elsewhere."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

LINE_INTERVAL_S = 5.0
"""Time from one line to the next, s: enough to see that it goes on, few enough for a log."""
LEAST_DONE, LEAST_S = 0.1, 1.0
"""Finished share of a stage, and time that its later half took, s, from which on the time that is
left is shown. Before, it would be that of loading and compiling, which do not come again."""


class Tell(Protocol):
    """Takes what has been reached."""

    def __call__(self, stage: str, share: float | None = None) -> None:
        """Take in the stage and the finished share of it, 0 to 1, where that is known."""


@contextmanager
def progress_of(command: str) -> Iterator[Tell]:
    """Yield a function that takes how far a command is, which a bar or lines then show."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield _Lines(command).tell
        return
    columns = (
        TextColumn('{task.description}'), BarColumn(), TaskProgressColumn(),
        TextColumn('{task.fields[left]}'),
    )  # fmt: skip
    with Progress(*columns, console=console) as bar:
        task, shown = bar.add_task(command, total=None, left=''), command
        remaining = _Remaining()

        def tell(stage: str, share: float | None = None) -> None:
            nonlocal shown
            if stage != shown:
                shown = stage
                bar.reset(task, description=stage)
            bar.tasks[0].total = None if share is None else 1.0  # without one the bar only moves
            left = '' if share is None else remaining.words(stage, share)
            bar.update(task, completed=share or 0.0, left=left)

        yield tell


class _Remaining:
    """How long a stage will take, by the pace of the later half of what is finished."""

    def __init__(self) -> None:
        self._stage = ''
        self._past: list[tuple[float, float]] = []

    def words(self, stage: str, share: float) -> str:
        """Take in how far a stage is; the time that is left, empty while it is not known well."""
        now_s = time.monotonic()
        if stage != self._stage:
            self._stage, self._past = stage, []
        if not self._past or share > self._past[-1][0]:
            self._past.append((share, now_s))
        done, since_s = next(one for one in reversed(self._past) if self._is_early(one, share))
        took_s = now_s - since_s
        if share < LEAST_DONE or took_s < LEAST_S or share <= done:
            return ''
        return f'about {took_s * (1.0 - share) / (share - done):.0f} s left'

    def _is_early(self, one: tuple[float, float], share: float) -> bool:
        return one[0] <= 0.5 * share or one is self._past[0]


class _Lines:
    """Says a line on stderr every few seconds; a short command says nothing."""

    def __init__(self, command: str) -> None:
        self._command, self._remaining = command, _Remaining()
        self._begin_s = self._shown_s = time.monotonic()

    def tell(self, stage: str, share: float | None = None) -> None:
        """Take in how far a stage is, and say it where it is time to."""
        now_s = time.monotonic()
        if share is None:
            if now_s - self._begin_s > LINE_INTERVAL_S:
                self._say(f'{stage}, after {now_s - self._begin_s:.0f} s')
            return
        left = self._remaining.words(stage, share)
        if now_s - self._shown_s < LINE_INTERVAL_S:
            return
        self._shown_s = now_s
        self._say(', '.join(filter(None, (f'{stage}, {share:.0%}', left))))

    def _say(self, words: str) -> None:
        print(f'{self._command}: {words}', file=sys.stderr, flush=True)
