"""What the benchmarks share: where things are, recordings and models, commands, times and rows.

It is imported before numpy, as imports sort: it states one thread, and puts the folders of the
worlds on the path.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

THREADS = ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS', 'MKL_NUM_THREADS', 'NUMBA_NUM_THREADS')
for variable in THREADS:
    os.environ.setdefault(variable, '1')

HERE = Path(__file__).resolve().parent
REPO = HERE.parents[1]
BAGS = REPO / 'bags'
SESSIONS = Path(os.environ.get('ANSER_SHARED', REPO.parent / 'shared')) / 'sessions'
"""Recorded sessions, which are not part of the repository."""
sys.path[1:1] = [str(REPO), str(HERE), str(HERE / 'world'), str(HERE.parent)]

if TYPE_CHECKING:
    from anser_ros.field.model import FieldModel
    from anser_ros.sessions.session import Session

Row = dict[str, Any]
"""A row of the table, as `run.py` describes it."""


def row(
    name: str, value: Any, unit: str = '', rival: tuple[str, Any] | None = None, **more: Any
) -> Row:
    """Return a row; the ``rival`` is another way and what it gives."""
    if rival is not None:
        more |= {'rival': rival[0], 'rival_value': rival[1]}
    return {'name': name, 'value': value, 'unit': unit, **more}


def online_recordings() -> tuple[Path, dict[str, Path]]:
    """Calibration scan and baseline, and the sessions by the name that rows call them.

    Without the recordings, the small simulated bags of this package stand in.
    """
    names = ('online/approach', 'online/sweep', 'effects/s05', 'effects/s01')
    if all((SESSIONS / f'{name}.mcap').is_file() for name in names):
        return SESSIONS / 'effects/factory.mcap', {n: SESSIONS / f'{n}.mcap' for n in names}
    return BAGS / 'factory.mcap', {
        'bags/metal (own)': BAGS / 'metal.mcap', 'bags/moving (own)': BAGS / 'moving.mcap',
    }  # fmt: skip


def calibrated(scan: Session) -> FieldModel:
    """Return the model of a scan with a layout that takes no minutes to choose.

    It is the one with which the choice by held-out error ends on the shared scan.
    """
    from anser_ros.calibration.calibrate import Options
    from anser_ros.calibration.layouts import Layout
    from anser_ros.sessions.calibration import calibrate_sessions

    layout = Layout('drawing', 144, 1.0, 0.0, prior='nominal', moved=True)
    return calibrate_sessions([scan], Options(layout=layout)).model


class Done(NamedTuple):
    """What a command has printed, and how long it took of processors, s."""

    printed: str
    cpu_s: float


def anser(*arguments: object) -> Done:
    """Run a command of `anser` to its end; raises `RuntimeError` with what it says if it fails."""
    command = [sys.executable, '-P', '-m', 'anser_ros.cli.main', *map(str, arguments)]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(command, cwd=REPO, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(done.stderr)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Done(done.stdout, cpu_s)


def timed(work: Callable[[], Any], rounds: int = 1) -> tuple[list[float], Any]:
    """Return the times, s, that work took in each round, and its last result."""
    spent = []
    for _ in range(rounds):
        begin = time.perf_counter()
        found = work()
        spent.append(time.perf_counter() - begin)
    return spent, found


def integers(text: str) -> list[int]:
    """Return the numbers of an option, which has commas between them."""
    return [int(part) for part in text.split(',')]


def print_lines(lines: Iterable[tuple[str, str]], path: Path | None) -> None:
    """Print lines of a table of the documents as they come, and keep them by their names."""
    kept: list[dict[str, str]] = []
    for name, line in lines:
        print(line, flush=True)
        kept.append({'name': name, 'line': line})
        if path is not None:
            path.write_text(json.dumps(kept, indent=1, ensure_ascii=False) + '\n', 'utf-8')


def print_rows(rows: Iterator[Row]) -> None:
    """Print rows as they come, for a benchmark that is run by itself."""
    for one in rows:
        target = one.get('target')
        words = '' if target is None else f'   (target {target})'
        print(f'{one["name"]}: {one["value"]:.4g} {one["unit"]}{words}', flush=True)
