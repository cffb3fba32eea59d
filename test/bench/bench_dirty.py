"""A laboratory where everything is a little wrong, by the commands that are shipped.

Both scans of the recorded sessions `dirty/` are calibrated by default, and the clean session and
those with known effects are diagnosed with both models. Errors of positions are exact, of all
coils of the tool in the clean session. The rival is the same scan with ``--estimate none``, which
trusts the setup. Without the recorded sessions there are no rows.

    python test/bench/run.py dirty
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent / 'world'))

from scoring import exact_errors

REPO = Path(__file__).resolve().parents[2]
SESSIONS = Path(os.environ.get('ANSER_SHARED', REPO.parent / 'shared')) / 'sessions' / 'dirty'
CLEAN = 'check'


def command(*arguments: Any) -> float:
    """Run `anser` and return the processor time that it took, s."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        [sys.executable, '-P', '-m', 'anser_ros.cli.main', *map(str, arguments)],
        check=True, cwd=REPO, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def coil_errors(folder: Path, model: Path) -> tuple[list[float], float]:
    """RMSE of each coil in the clean session, m, and the share of ok poses over 3 sigma."""
    command('evaluate', SESSIONS / f'{CLEAN}.mcap', '--model', model, '--out', folder)
    truth = np.load(SESSIONS / f'{CLEAN}_truth.npz')
    coils, _, errors, sigmas, _ = exact_errors(folder / 'poses.csv', truth['t_ns'], truth['p'])
    each = [float(np.sqrt(np.mean(errors[coils == coil] ** 2))) for coil in np.unique(coils)]
    return each, float(np.mean(errors > 3.0 * sigmas))


def parameters_of(calibration: dict[str, Any], name: str) -> dict[str, Any]:
    """Parameters of the one effect of a name that a calibration found."""
    (found,) = [e['parameters'] for e in calibration['effects'] if e['name'] == name]
    return dict(found)


def scan_rows(folder: Path, truth: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """What the models of both scans are worth; they are left in the folder."""
    trusting = folder / 'trusting.yaml'
    scan = SESSIONS / 'scan.mcap'
    command('calibrate', scan, '--out', trusting, '--estimate', 'none', '--force')
    rival, _ = coil_errors(folder / 'trusting', trusting)
    for name, most in (('scan', 1e-4), ('scan_metal', 1.2e-4)):
        bag, model = SESSIONS / f'{name}.mcap', folder / f'{name}.yaml'
        taken_s = command('calibrate', bag, '--out', model, '--report', folder / name)
        each, over = coil_errors(folder / f'{name}_check', model)
        calibration = json.loads((folder / name / 'calibration.json').read_text())
        offset_s = parameters_of(calibration, 'time_offset')['offset_s']
        yield {
            'name': f'dirty/{name}: exact error of all coils',
            'value': 1e3 * float(np.sqrt(np.mean(np.square(each)))), 'unit': 'mm',
            'rival': 'scan, --estimate none', 'target': 1e3 * most,
            'rival_value': 1e3 * float(np.sqrt(np.mean(np.square(rival)))),
        }  # fmt: skip
        yield {
            'name': f'dirty/{name}: worst coil', 'value': 1e3 * max(each), 'unit': 'mm',
            'rival': 'scan, --estimate none', 'rival_value': 1e3 * max(rival), 'target': 0.15,
        }  # fmt: skip
        yield {
            'name': f'dirty/{name}: ok poses over 3 sigma', 'value': 100 * over, 'unit': '%',
            'target': 1.0,
        }  # fmt: skip
        yield {
            'name': f'dirty/{name}: error of the time offset', 'unit': 'ms', 'target': 0.1,
            'value': 1e3 * abs(offset_s - truth['_lab']['dt']),
        }  # fmt: skip
        limit = {'target': 60.0} if name == 'scan' else {}
        yield {'name': f'dirty/{name}: processor time', 'value': taken_s, 'unit': 's', **limit}
    metal = truth['scan_metal']['moving_metal']
    found = parameters_of(calibration, 'moving_metal')
    wrong = [found[key] - metal[key] for key in ('t_start_s', 't_end_s')]
    yield {
        'name': 'dirty/scan_metal: error of the times of the metal', 'unit': 's',
        'value': float(np.abs(wrong).max()), 'target': 1.5,
    }  # fmt: skip


def session_rows(folder: Path, truth: dict[str, Any], scan: str) -> Iterator[dict[str, Any]]:
    """What is named in the sessions, with the model of a scan."""
    clean = np.nan
    for name in [key for key in truth if not key.startswith(('_', 'scan'))]:
        bag, out = SESSIONS / f'{name}.mcap', folder / f'{scan}_{name}'
        command('diagnose', bag, '--model', folder / f'{scan}.yaml', '--out', out)
        found = json.loads((out / 'diagnosis.json').read_text())
        names = sorted(effect['name'] for effect in found['effects'])
        what = f'dirty/{name}, model of {scan}'
        yield {
            'name': f'{what}: {", ".join(truth[name]) or "nothing"} and no other named',
            'value': float(names == sorted(truth[name])), 'unit': '', 'target': 1.0,
            'target_is': 'least',
        }  # fmt: skip
        left = found['held_out']['flux_rms_after_t']
        clean = left if name == CLEAN else clean
        yield {
            'name': f'{what}: flux left, over that of {CLEAN}', 'value': left / clean,
            'unit': '', 'target': 1.15,
        }  # fmt: skip


def rows() -> Iterator[dict[str, Any]]:
    """All of them; some minutes."""
    if not SESSIONS.is_dir():
        print('  no folder of recorded sessions beside the repository: no rows')
        return
    truth = json.loads((SESSIONS / 'truth.json').read_text())
    with tempfile.TemporaryDirectory() as name:
        yield from scan_rows(Path(name), truth)
        for scan in ('scan', 'scan_metal'):
            yield from session_rows(Path(name), truth, scan)
