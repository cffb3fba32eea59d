"""How far a command is: a bar on a terminal, lines on stderr now and then elsewhere."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

SAY_S = 5.0
"""Time from one line to the next, s: enough to see that it goes on, few enough for a log."""


@contextmanager
def progress_of(command: str) -> Iterator[Callable[[str, float], None]]:
    """Yield a function that is told the stage and the finished share of it, 0 to 1.

    Parameters
    ----------
    command : str
        What goes on, before a stage has a name.
    """
    console = Console(stderr=True)
    if not console.is_terminal:
        yield _Lines(command).tell
        return
    columns = (
        TextColumn('{task.description}'), BarColumn(), TaskProgressColumn(), TimeRemainingColumn(),
    )  # fmt: skip
    with Progress(*columns, console=console) as bar:
        task, stage = bar.add_task(command, total=1.0), command

        def tell(name: str, share: float) -> None:
            nonlocal stage
            if name != stage:
                stage = name
                bar.reset(task, description=name)
            bar.update(task, completed=share)

        yield tell


@contextmanager
def stages_of(command: str) -> Iterator[Callable[[str], None]]:
    """Yield a function that is told in words what has been reached, where no share is known."""
    console = Console(stderr=True)
    if console.is_terminal:
        with console.status(command) as status:
            yield status.update
        return
    begin_s = time.monotonic()

    def tell(what: str) -> None:
        past_s = time.monotonic() - begin_s
        if past_s > SAY_S:
            print(f'{command}: {what}, after {past_s:.0f} s', file=sys.stderr, flush=True)

    yield tell


class _Lines:
    """Says a line on stderr every few seconds; a short command says nothing."""

    def __init__(self, command: str) -> None:
        self._command, self._stage = command, ''
        self._begin_s = self._said_s = self._last_s = time.monotonic()

    def tell(self, stage: str, share: float) -> None:
        """Take in how far a stage is, and say it where it is time to."""
        now_s = time.monotonic()
        if stage != self._stage:
            self._stage, self._begin_s = stage, self._last_s
        self._last_s = now_s
        if now_s - self._said_s < SAY_S:
            return
        self._said_s = now_s
        line = f'{self._command}: {stage}, {share:.0%}'
        if share > 0.0:
            left_s = (now_s - self._begin_s) * (1.0 - share) / share
            line += f', about {left_s:.0f} s left'
        print(line, file=sys.stderr, flush=True)
