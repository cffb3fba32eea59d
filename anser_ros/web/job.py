"""Runs a command of the suite as a process of its own, and reads its progress."""

import asyncio
import contextlib
import math
import os
import re
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path

NICE = 10
"""Niceness of commands: poses go before a diagnosis."""
PERCENT = re.compile(r'(\d+)%')
KEPT_LINES = 20
"""Lines of what a command says that are kept, for the last ones say why it failed."""
LONGEST_LINE = 65_536
"""Bytes of a line that are taken as one, which bounds the memory of a line without an end."""


class Job:
    """Runs a command once.

    What it prints goes to ``output.txt`` in the folder of its results. ``exit_code`` is None while
    it runs; ``share`` is how much is done, 0 to 1, and NaN where it does not say.
    """

    def __init__(self, kind: str, arguments: Sequence[str], folder: Path) -> None:
        self.kind, self.folder = kind, folder
        self._arguments = [str(argument) for argument in arguments]
        self.exit_code: int | None = None
        self.share, self.stage = math.nan, ''
        self._lines: list[str] = []
        self._began_s, self._took_s = time.monotonic(), math.nan
        self._process: asyncio.subprocess.Process | None = None
        self._is_ended = False

    @property
    def seconds(self) -> float:
        """Return how long it has run, or took, s."""
        return time.monotonic() - self._began_s if math.isnan(self._took_s) else self._took_s

    @property
    def failure(self) -> str:
        """Return why it failed, in a line; empty while it runs and when it did not."""
        if self.exit_code in (None, 0):
            return ''
        if self._is_ended:
            return f'{self.kind} was cancelled'
        return self._lines[-1] if self._lines else f'{self.kind} ended with {self.exit_code}'

    async def run(self) -> None:
        """Run it to its end."""
        command = [sys.executable, '-P', '-m', 'anser_ros.cli.main', self.kind, *self._arguments]
        with (self.folder / 'output.txt').open('wb') as output:
            self._process = await asyncio.create_subprocess_exec(
                'nice', '-n', str(NICE), *command, stdin=asyncio.subprocess.DEVNULL,
                stdout=output, stderr=asyncio.subprocess.PIPE, start_new_session=True,
                limit=LONGEST_LINE,
            )  # fmt: skip
        try:
            await self._listen(self._process.stderr)
            code = await self._process.wait()
        finally:
            self.end()
            self._took_s = time.monotonic() - self._began_s
        self.exit_code = code

    async def _listen(self, stream: asyncio.StreamReader | None) -> None:
        while stream is not None:
            try:
                line = await stream.readline()
            except ValueError:  # longer than a line may be
                continue
            if not line:
                return
            self.take_line(line.decode(errors='replace').strip())

    def take_line(self, line: str) -> None:
        """Take a line of progress, ``what: stage, 43%, about 5 s left``, or of complaint."""
        if not line:
            return
        self._lines = [*self._lines[-KEPT_LINES + 1 :], line]
        words, found = line.partition(': ')[2], PERCENT.search(line)
        self.share = int(found[1]) / 100 if found else math.nan
        self.stage = words or line

    def cancel(self) -> None:
        """End it before its time."""
        self._is_ended = self._is_ended or self.exit_code is None
        self.end()

    def end(self) -> None:
        """Ask its processes to end."""
        process = self._process
        if process is not None and process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGTERM)
