"""Ten sessions by `anser batch` on two local workers, beside `anser evaluate` of the same ten.

The rival is one process that takes one session after the other, which starts and loads its kernels
once; both are whole commands, from their start to the summary. The sessions are ten copies of a
small simulated one, so what the workers need to start weighs more than with longer recordings.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

REPO = Path(__file__).resolve().parents[2]
SESSIONS, WORKERS, MOST = 10, 2, 0.6


def seconds(folder: Path, *arguments: str) -> float:
    """Run a command of `anser` on all sessions and return how long it took."""
    bags = sorted(str(path) for path in folder.glob('*.mcap'))
    model = str(REPO / 'config' / 'demo_model.yaml')
    command = [sys.executable, '-P', '-m', 'anser_ros.cli.main', *arguments, *bags]
    began_s = time.monotonic()
    out = str(folder / arguments[0])
    command += ['--model', model, '--refit', '--baseline', str(REPO / 'bags' / 'scan.mcap')]
    subprocess.run([*command, '--out', out], check=True, cwd=REPO, stdout=subprocess.DEVNULL)
    return time.monotonic() - began_s


def rows() -> list[dict[str, Any]]:
    """The share of the time that is left."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for number in range(SESSIONS):
            shutil.copy(REPO / 'bags' / 'moving.mcap', folder / f'session_{number}.mcap')
        alone = seconds(folder, 'evaluate')
        shared = seconds(folder, 'batch', 'evaluate', '--workers', str(WORKERS))
    return [
        {
            'name': f'{SESSIONS} sessions evaluated on {WORKERS} workers', 'value': shared,
            'unit': 's', 'rival': 'one after the other in one process', 'rival_value': alone,
        },
        {
            'name': 'the same as a share of the time one after the other',
            'value': shared / alone, 'unit': '', 'target': MOST,
        },
    ]  # fmt: skip
