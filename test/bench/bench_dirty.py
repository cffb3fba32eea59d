"""A laboratory where everything is a little wrong, by the commands that are shipped.

Both scans of the recorded sessions `dirty/` are calibrated by default, and the clean session and
those with known effects are diagnosed with both models. Errors of positions are exact, of all
coils of the tool in the clean session. The rival is the same scan with ``--estimate none``, which
trusts the setup. Without the recorded sessions there are no rows.

    python test/bench/run.py dirty
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import harness
import numpy as np
from scoring import exact_errors

SESSIONS = harness.SESSIONS / 'dirty'
CLEAN = 'check'


def coil_errors(folder: Path, model: Path) -> tuple[list[float], float]:
    """RMSE of each coil in the clean session, m, and the share of ok poses over 3 sigma."""
    harness.anser('evaluate', SESSIONS / f'{CLEAN}.mcap', '--model', model, '--out', folder)
    truth = np.load(SESSIONS / f'{CLEAN}_truth.npz')
    coils, _, errors, sigmas, _ = exact_errors(folder / 'poses.csv', truth['t_ns'], truth['p'])
    each = [float(np.sqrt(np.mean(errors[coils == coil] ** 2))) for coil in np.unique(coils)]
    return each, float(np.mean(errors > 3.0 * sigmas))


def parameters_of(calibration: dict[str, Any], name: str) -> dict[str, Any]:
    """Parameters of the one effect of a name that a calibration found."""
    (found,) = [e['parameters'] for e in calibration['effects'] if e['name'] == name]
    return dict(found)


def scan_rows(folder: Path, truth: dict[str, Any]) -> Iterator[harness.Row]:
    """What the models of both scans are worth; they are left in the folder."""
    trusting = folder / 'trusting.yaml'
    scan = SESSIONS / 'scan.mcap'
    harness.anser('calibrate', scan, '--out', trusting, '--estimate', 'none', '--force')
    rival, _ = coil_errors(folder / 'trusting', trusting)
    for name, most in (('scan', 1e-4), ('scan_metal', 1.2e-4)):
        bag, model = SESSIONS / f'{name}.mcap', folder / f'{name}.yaml'
        taken_s = harness.anser('calibrate', bag, '--out', model, '--report', folder / name).cpu_s
        each, over = coil_errors(folder / f'{name}_check', model)
        calibration = json.loads((folder / name / 'calibration.json').read_text())
        offset_s = parameters_of(calibration, 'time_offset')['offset_s']
        what, without = f'dirty/{name}', 'scan, --estimate none'
        whole, old = (1e3 * float(np.sqrt(np.mean(np.square(one)))) for one in (each, rival))
        yield harness.row(
            f'{what}: exact error of all coils', whole, 'mm', (without, old), target=1e3 * most
        )
        worst, old = 1e3 * max(each), (without, 1e3 * max(rival))
        yield harness.row(f'{what}: worst coil', worst, 'mm', old, target=0.15)
        yield harness.row(f'{what}: ok poses over 3 sigma', 100 * over, '%', target=1.0)
        late_ms = 1e3 * abs(offset_s - truth['_lab']['dt'])
        yield harness.row(f'{what}: error of the time offset', late_ms, 'ms', target=0.1)
        limit = {'target': 60.0} if name == 'scan' else {}
        yield harness.row(f'{what}: processor time', taken_s, 's', **limit)
    metal = truth['scan_metal']['moving_metal']
    found = parameters_of(calibration, 'moving_metal')
    wrong = [found[key] - metal[key] for key in ('t_start_s', 't_end_s')]
    yield harness.row(
        'dirty/scan_metal: error of the times of the metal', float(np.abs(wrong).max()), 's',
        target=1.5,
    )  # fmt: skip


def session_rows(folder: Path, truth: dict[str, Any], scan: str) -> Iterator[harness.Row]:
    """What is named in the sessions, with the model of a scan."""
    clean = np.nan
    for name in [key for key in truth if not key.startswith(('_', 'scan'))]:
        bag, out = SESSIONS / f'{name}.mcap', folder / f'{scan}_{name}'
        harness.anser('diagnose', bag, '--model', folder / f'{scan}.yaml', '--out', out)
        found = json.loads((out / 'diagnosis.json').read_text())
        names = sorted(effect['name'] for effect in found['effects'])
        what = f'dirty/{name}, model of {scan}'
        yield harness.row(
            f'{what}: {", ".join(truth[name]) or "nothing"} and no other named',
            float(names == sorted(truth[name])), target=1.0, target_is='least',
        )  # fmt: skip
        left = found['held_out']['flux_rms_after_t']
        clean = left if name == CLEAN else clean
        yield harness.row(f'{what}: flux left, over that of {CLEAN}', left / clean, target=1.15)


def rows() -> Iterator[harness.Row]:
    """All of them; some minutes."""
    if not SESSIONS.is_dir():
        print('  no folder of recorded sessions beside the repository: no rows')
        return
    truth = json.loads((SESSIONS / 'truth.json').read_text())
    with tempfile.TemporaryDirectory() as name:
        yield from scan_rows(Path(name), truth)
        for scan in ('scan', 'scan_metal'):
            yield from session_rows(Path(name), truth, scan)
