"""Starts, watches and ends nodes beside a simulated control unit, in a ROS domain of their own."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import NamedTuple

from anser_ros.cli.commands import COMPOSED, NODES
from anser_ros.errors import ParameterError
from anser_ros.parallel import hold
from anser_ros.tracking.estimate import NO_GATE

VARIABLE = 'ROS_DOMAIN_ID'
LAST_DOMAIN = 101
"""Largest ROS domain used. The ports of domains up to this are no ephemeral ports of Linux."""


@contextmanager
def own_domain(preferred: Iterable[int]) -> Iterator[int]:
    """Name to the nodes to come the first domain that no other simulation has, and hold it.

    One that is stated is the only one. Raises `ParameterError` when none is free.
    """
    stated = os.environ.get(VARIABLE, '')
    if stated and not stated.isdecimal():
        raise ParameterError(f'{VARIABLE} must be a number, got {stated!r}')
    for number in [int(stated)] if stated else preferred:
        holder = hold(f'domain {number}')
        if holder is None:
            continue
        os.environ[VARIABLE] = str(number)
        try:
            yield number
        finally:
            holder.close()
            if not stated:
                del os.environ[VARIABLE]
        return
    which = f'{VARIABLE}={stated}' if stated else 'every ROS domain'
    raise ParameterError(
        f'another demo or loop runs in {which}: wait for its end, or state another {VARIABLE}'
    )


_PR_SET_PDEATHSIG = 1
"""Option of Linux's prctl that sends a signal to a process when its parent ends."""
_TERMINATE_S = 1.5
"""Time for a process to end after SIGTERM, s, enough to close a bag; then it is killed."""
_KILL_S = 1.0
"""Time for the system to end a killed process, s: only one that waits for a disk takes longer."""
_TAIL_LINES = 8
"""Last lines of a log that an error message shows: a traceback's last calls and its reason."""


class Child(NamedTuple):
    """A process that a supervisor has started, and the file of its output; None: the terminal."""

    name: str
    process: subprocess.Popen[bytes]  # leader of a group of its own
    log: Path | None


class Supervisor:
    """Starts processes and ends them together when its context is left.

    Each process is in a separate group, so that Ctrl-C reaches only the supervisor, which ends
    them in order. When the supervisor itself is killed, the system ends them (Linux). Their output
    goes to the folder ``logs``.
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
        """Start a process whose output goes to a log of its name, or to the terminal if asked."""
        log = None if on_terminal else self._logs / f'{name}.log'
        with contextlib.nullcontext() if log is None else log.open('wb') as stream:
            process = subprocess.Popen(
                list(command), stdin=subprocess.DEVNULL, stdout=stream,
                stderr=None if stream is None else subprocess.STDOUT, start_new_session=True,
                preexec_fn=partial(_prepare, os.getpid()),
            )  # fmt: skip
        self._children.append(Child(name, process, log))
        return self._children[-1]

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


def _prepare(parent: int) -> None:
    """Let the system kill the new process when its parent, by its number, ends (Linux)."""
    if sys.platform.startswith('linux'):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # it has ended before that
            os._exit(1)


PATIENCE_S = 180.0
"""Longest wait for all nodes and the first pose, s; kernels may have to be compiled meanwhile."""
# The board of the bags in bags/, from which config/demo_model.yaml is calibrated:
# anser calibrate bags/scan.mcap --out config/demo_model.yaml
BOARD_SEED = 1
# Half the usual rate, so that all processes together fit on two cores.
SAMPLE_RATE_HZ = 20e3
# The frozen chain shows the poses of a tracker without residual gate. With one it would withhold
# them near metal, and nobody would see the error that the refit avoids.
FROZEN_TRACKER = {'gate': NO_GATE, 'adaptive': False}
SHARED_TOPICS = ('setup', 'tool/flux', 'reference/flux')


def node_command(name: str, /, *words: str, **parameters: object) -> list[str]:
    """Return the command line of a node, with further ROS arguments and its parameters.

    ``NODE__NAME`` is a parameter of one of several nodes in one process.
    """
    module, _ = {**NODES, **COMPOSED}[name]
    command = [sys.executable, '-P', '-m', module, '--ros-args', *words]
    for key, value in parameters.items():
        text = str(value).lower() if isinstance(value, bool) else str(value)
        command += ['-p', f'{key.replace("__", ":")}:={text}']
    return command


def in_namespace(namespace: str) -> list[str]:
    """Return the ROS arguments of a node beside the others, which takes their setup and fluxes."""
    remaps = [f'{topic}:=/anser/{topic}' for topic in SHARED_TOPICS]
    return [word for remap in (f'__ns:={namespace}', *remaps) for word in ('-r', remap)]


def simulated_unit(port: Path, **parameters: object) -> list[str]:
    return node_command(
        'cu_simulator', link=port, board_seed=BOARD_SEED, sample_rate_hz=SAMPLE_RATE_HZ,
        **parameters,
    )  # fmt: skip
