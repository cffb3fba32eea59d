"""Faults of the processes: killed, stopped, without resources, late."""

import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from fault import Fault, Off, nothing
from rig import Rig


def _killed(node: str) -> Callable[..., Off]:
    def on(rig: Rig, _rng: np.random.Generator) -> Off:
        rig.kill(node)
        return lambda: rig.restart(node)

    return on


def _stopped(node: str) -> Callable[..., Off]:
    def on(rig: Rig, _rng: np.random.Generator) -> Off:
        rig.signal(node, signal.SIGSTOP)
        return lambda: rig.signal(node, signal.SIGCONT)

    return on


def _flicker(node: str) -> Callable[..., Off]:
    def on(rig: Rig, rng: np.random.Generator) -> Off:
        for _ in range(8):
            off = _stopped(node)(rig, rng)
            time.sleep(0.25)
            off()
            time.sleep(0.25)
        return nothing

    return on


def _busy(rig: Rig, _rng: np.random.Generator) -> Off:
    loops = [
        subprocess.Popen([sys.executable, '-c', 'while True: pass'])
        for _ in range(2 * (os.cpu_count() or 1))
    ]

    def off() -> None:
        for loop in loops:
            loop.kill()
            loop.wait()

    return off


def _full_disk(rig: Rig, _rng: np.random.Generator) -> Off:
    """A recorder whose files may not grow beyond 200 kB."""
    rig.start('recorder', directory=rig.folder, name=f'full_{time.monotonic_ns()}')
    limit = 200_000
    resource.prlimit(rig.pid('recorder'), resource.RLIMIT_FSIZE, (limit, limit))
    return lambda: rig.kill('recorder')


def _limited(node: str, kind: int, most: Callable[[int], int]) -> Callable[..., Off]:
    """Limit a resource of a node, by its process id."""

    def on(rig: Rig, _rng: np.random.Generator) -> Off:
        pid = rig.pid(node)
        before = resource.prlimit(pid, kind)
        resource.prlimit(pid, kind, (most(pid), before[1]))
        return lambda: resource.prlimit(pid, kind, before)

    return on


def _little_memory(node: str) -> Callable[..., Off]:
    def most(pid: int) -> int:
        pages = int(Path(f'/proc/{pid}/statm').read_text().split()[0])
        return pages * resource.getpagesize() + 4_000_000

    return _limited(node, resource.RLIMIT_AS, most)


def _joins_late(rig: Rig, _rng: np.random.Generator) -> Off:
    rig.kill('tracker')
    rig.kill('field_model')
    rig.restart('tracker')
    rig.restart('field_model')
    return nothing


NODES = ('acquisition', 'field_model', 'tracker', 'cu_simulator')
PROCESSES = (
    *(Fault(f'kill-{n}', f'{n} is killed and started again', _killed(n), 1.0) for n in NODES),
    *(Fault(f'stop-{n}', f'{n} is stopped for 2 s', _stopped(n), 2.0) for n in NODES),
    Fault('kill-field_model-metal', 'field_model is killed while metal moves',
          _killed('field_model'), 4.0, 'metal'),
    Fault('stop-field_model-metal', 'field_model is stopped for 6 s while metal moves',
          _stopped('field_model'), 6.0, 'metal'),
    Fault('flicker-acquisition', 'acquisition is stopped eight times for 0.25 s',
          _flicker('acquisition'), 0.5),
    Fault('flicker-tracker', 'tracker is stopped eight times for 0.25 s',
          _flicker('tracker'), 0.5),
    Fault('busy', 'two busy loops a processor', _busy, 4.0),
    Fault('late-model', 'the tracker is there before its model', _joins_late, 1.0),
    Fault('full-disk', 'the disk is full for the recorder', _full_disk, 5.0),
    Fault('memory-tracker', 'the tracker gets 4 MB more at most', _little_memory('tracker'), 4.0),
    Fault('memory-acquisition', 'acquisition gets 4 MB more at most',
          _little_memory('acquisition'), 4.0),
    Fault('files-tracker', 'the tracker may open no file more',
          _limited('tracker', resource.RLIMIT_NOFILE, lambda _: 8), 3.0),
)  # fmt: skip
"""The processes themselves, and what they have."""
