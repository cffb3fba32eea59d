"""Ten sessions by `anser batch` on two local workers, beside `anser evaluate` of the same ten.

The rival is one process that takes one session after the other, which starts and loads its kernels
once; both are whole commands, from their start to the summary. The sessions are ten recordings of
40 s. Where they are missing, ten copies of a small simulated one stand in, and the rows say so:
there, what the workers need to start weighs more.
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import harness

from anser_ros.sessions.session import load_session
from anser_ros.sessions.starting_model import save_model

SESSIONS, WORKERS, MOST = 10, 2, 0.6


def seconds(bags: list[Path], model: Path, baseline: Path, *arguments: str) -> float:
    """Run a command of `anser` on all sessions and return how long it took."""
    options = ('--model', model, '--refit', '--baseline', baseline)
    with tempfile.TemporaryDirectory() as out:
        return harness.anser(*arguments, *bags, *options, '--out', out).wall_s


def recordings(folder: Path) -> tuple[list[Path], Path, Path, str]:
    """Ten sessions, their model and baseline, and how the rows call them."""
    shared = harness.SESSIONS / 'effects'
    bags = sorted(shared.glob('s*.mcap'))[:SESSIONS]
    if len(bags) == SESSIONS:
        model = folder / 'model.yaml'
        scan = shared / 'factory.mcap'
        save_model(model, harness.calibrated(load_session(scan), layout=None))
        return bags, model, scan, 'of effects/, 40 s each'
    for number in range(SESSIONS):
        shutil.copy(harness.BAGS / 'moving.mcap', folder / f'session_{number}.mcap')
    model, scan = harness.REPO / 'config' / 'demo_model.yaml', harness.BAGS / 'scan.mcap'
    return sorted(folder.glob('*.mcap')), model, scan, 'copies of bags/moving (own)'


def rows() -> list[harness.Row]:
    """The share of the time that is left."""
    with tempfile.TemporaryDirectory() as name:
        *given, what = recordings(Path(name))
        alone = seconds(*given, 'evaluate')
        shared = seconds(*given, 'batch', 'evaluate', '--workers', str(WORKERS))
    name = f'{SESSIONS} sessions {what}, evaluated on {WORKERS} workers'
    return [
        harness.row(name, shared, 's', ('one after the other in one process', alone)),
        harness.row(
            'the same as a share of the time one after the other', shared / alone, target=MOST
        ),
    ]
