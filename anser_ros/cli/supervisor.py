"""Starts, watches and ends processes together, without the package `launch`."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

_PR_SET_PDEATHSIG = 1
"""Option of Linux's prctl that sends a signal to a process when its parent ends."""
_TERMINATE_S = 1.5
"""Time for a process to end after SIGTERM, s, enough to close a bag; then it is killed."""
_KILL_S = 1.0
"""Time for the system to end a killed process, s: only one that waits for a disk takes longer."""
_TAIL_LINES = 8
"""Last lines of a log that an error message shows: a traceback's last calls and its reason."""


@dataclass(frozen=True)
class Child:
    """Holds a process that a supervisor has started.

    Attributes
    ----------
    name : str
        Name in messages.
    process : subprocess.Popen
        The process, leader of a separate group.
    log : Path or None
        File of its output; None for the terminal.
    """

    name: str
    process: subprocess.Popen[bytes]
    log: Path | None


class Supervisor:
    """Starts processes and ends them together when its context is left.

    Each process is in a separate group, so that Ctrl-C reaches only the supervisor, which ends
    them in order. When the supervisor itself is killed, the system ends them (Linux).

    Parameters
    ----------
    logs : Path
        Folder for their output.
    """

    def __init__(self, logs: Path) -> None:
        self._logs = logs
        self._children: list[Child] = []

    def __enter__(self) -> Supervisor:
        self._logs.mkdir(parents=True, exist_ok=True)
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def start(self, name: str, command: Sequence[str], *, on_terminal: bool = False) -> Child:
        """Start a process whose output goes to a log, or to the terminal if asked.

        Parameters
        ----------
        name : str
            Name in messages and of the log.
        command : sequence of str
            The program with its arguments.
        on_terminal : bool
            Whether the process writes to the terminal.
        """
        log = None if on_terminal else self._logs / f'{name}.log'
        stream = None if log is None else log.open('wb')
        try:
            process = subprocess.Popen(
                list(command),
                stdin=subprocess.DEVNULL,
                stdout=stream,
                stderr=None if stream is None else subprocess.STDOUT,
                start_new_session=True,
                preexec_fn=_prepare,
            )
        finally:
            if stream is not None:
                stream.close()
        self._children.append(Child(name, process, log))
        return self._children[-1]

    def forget(self, child: Child) -> None:
        """Stop watching a process that has done its work."""
        self._children.remove(child)

    def ended(self) -> Child | None:
        """Return a process that has ended by itself, or None while all run."""
        return next((c for c in self._children if c.process.poll() is not None), None)

    def end(self) -> None:
        """Ask all processes to terminate, and kill those that do not end in time.

        A process with files to close has a handler of the signal; others simply end.
        """
        for number, patience_s in ((signal.SIGTERM, _TERMINATE_S), (signal.SIGKILL, _KILL_S)):
            running = [c for c in self._children if c.process.poll() is None]
            for child in running:
                _signal_group(child, number)
            end = time.monotonic() + patience_s
            for child in running:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    child.process.wait(max(0.0, end - time.monotonic()))
        for child in self._children:
            _signal_group(child, signal.SIGKILL)


def tail(child: Child) -> str:
    """Return the last lines of a process's log."""
    if child.log is None:
        return ''
    lines = child.log.read_text(encoding='utf-8', errors='replace').splitlines()
    return '\n'.join(f'    {line}' for line in lines[-_TAIL_LINES:])


def _signal_group(child: Child, number: int) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(child.process.pid, number)


def _prepare() -> None:
    """Let the system kill the new process when its parent ends (Linux)."""
    if sys.platform.startswith('linux'):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
