"""Ten sessions by `anser batch` on two local workers, beside `anser evaluate` of the same ten.

The rival is one process that takes one session after the other, which starts and loads its kernels
once; both are whole commands, from their start to the summary. The sessions are ten recordings of
40 s. Where they are missing, ten copies of a small simulated one stand in, and the rows say so:
there, what the workers need to start weighs more.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from anser_ros.calibration.calibrate import Options
from anser_ros.sessions.calibration import calibrate_sessions
from anser_ros.sessions.session import load_session
from anser_ros.sessions.starting_model import save_model

REPO = Path(__file__).resolve().parents[2]
SESSIONS, WORKERS, MOST = 10, 2, 0.6


def seconds(bags: list[Path], model: Path, baseline: Path, *arguments: str) -> float:
    """Run a command of `anser` on all sessions and return how long it took."""
    command = [sys.executable, '-P', '-m', 'anser_ros.cli.main', *arguments, *map(str, bags)]
    command += ['--model', str(model), '--refit', '--baseline', str(baseline)]
    with tempfile.TemporaryDirectory() as out:
        began_s = time.monotonic()
        subprocess.run([*command, '--out', out], check=True, cwd=REPO, stdout=subprocess.DEVNULL)
        return time.monotonic() - began_s


def recordings(folder: Path) -> tuple[list[Path], Path, Path, str]:
    """Ten sessions, their model and baseline, and how the rows call them."""
    shared = Path(os.environ.get('ANSER_SHARED', REPO.parent / 'shared')) / 'sessions' / 'effects'
    bags = sorted(shared.glob('s*.mcap'))[:SESSIONS]
    if len(bags) == SESSIONS:
        model = folder / 'model.yaml'
        scan = shared / 'factory.mcap'
        save_model(model, calibrate_sessions([load_session(scan)], Options()).model)
        return bags, model, scan, 'of effects/, 40 s each'
    for number in range(SESSIONS):
        shutil.copy(REPO / 'bags' / 'moving.mcap', folder / f'session_{number}.mcap')
    model, scan = REPO / 'config' / 'demo_model.yaml', REPO / 'bags' / 'scan.mcap'
    return sorted(folder.glob('*.mcap')), model, scan, 'copies of bags/moving (own)'


def rows() -> list[dict[str, Any]]:
    """The share of the time that is left."""
    with tempfile.TemporaryDirectory() as name:
        *given, what = recordings(Path(name))
        alone = seconds(*given, 'evaluate')
        shared = seconds(*given, 'batch', 'evaluate', '--workers', str(WORKERS))
    return [
        {
            'name': f'{SESSIONS} sessions {what}, evaluated on {WORKERS} workers', 'value': shared,
            'unit': 's', 'rival': 'one after the other in one process', 'rival_value': alone,
        },
        {
            'name': 'the same as a share of the time one after the other',
            'value': shared / alone, 'unit': '', 'target': MOST,
        },
    ]  # fmt: skip
