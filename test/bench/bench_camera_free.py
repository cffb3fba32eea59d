"""What calibration without a camera is worth on a recorded board, by height, with a picture.

Each recording is calibrated by the shipped command, and its model tracks single coils on another
one, whose places are exactly known. Errors are after one rigid registration, as the frame is only
the drawing's, and as they are. A full scan is the first half
of the recording that the waved tool is judged by, with its optical poses, judged by the second.

    python test/bench/run.py camera_free
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import harness
import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial.transform import Rotation
from shortened import beginning

from anser_ros.cli.page import legend_under
from anser_ros.sessions.session import load_session
from anser_ros.sessions.starting_model import load_model
from anser_ros.sessions.tracked_session import track_session

SESSIONS = harness.SESSIONS / 'nocamera'
PLOT = harness.REPO / 'docs' / 'howto' / 'camera_free.png'
HALF_S = 20.0
EFFORTS = {
    'grid_one': ('49 places, one height', 'check_probe', 0.16),
    'grid_two': ('49 places, two heights', 'check_probe', 0.14),
    'waved_short': ('waved for 10 s', 'check_tool', 0.13),
    'waved': ('waved for 60 s', 'check_tool', 0.11),
    'scan': ('20 s with a camera', 'check_tool', None),
}
"""Name, session that judges it, and the target of the registered error, mm, by recording."""
EDGES_M = np.arange(0.07, 0.245, 0.02)
MIDDLES_MM = 1e3 * (EDGES_M[:-1] + EDGES_M[1:]) / 2


def judged(model_file: Path, check: str, since_s: float) -> dict[str, np.ndarray]:
    """Heights, errors after a registration and as they are, and sigmas without and with the
    frame's part, m, of all coils in a session, from a time on.
    """
    session, truth = load_session(SESSIONS / f'{check}.mcap'), SESSIONS / f'{check}_truth.npz'
    late = session.tools[0].time >= since_s
    session = replace(session, tools=tuple(tool.frames(late) for tool in session.tools))
    model, places = load_model(model_file), np.load(truth)['p'][late].swapaxes(0, 1)
    series = track_session(session, model).sensors.values()
    each = [(e, p) for s, own in zip(series, places, strict=True) for e, p, ok in
            zip(s.estimates, own, s.ok, strict=True) if ok]  # fmt: skip
    found, true = (np.array(one) for one in zip(*((e.position, p) for e, p in each), strict=True))
    sigma = np.array([e.sigma_position_m for e, _ in each])
    turn, _ = Rotation.align_vectors(true - true.mean(axis=0), found - found.mean(axis=0))
    registered = turn.apply(found - found.mean(axis=0)) + true.mean(axis=0)
    return {
        'height': true[:, 2], 'lost': np.array(1.0 - len(each) / places[..., 0].size),
        'error': np.linalg.norm(registered - true, axis=1),
        'error in the frame': np.linalg.norm(found - true, axis=1),
        'sigma': np.sqrt(np.maximum(sigma**2 - 3.0 * model.shift_sigma_m**2, 0.0)),
        'sigma in the frame': sigma,
    }  # fmt: skip


def rms_mm(values: np.ndarray) -> float:
    """Root mean square, mm."""
    return float(1e3 * np.sqrt(np.mean(values**2))) if values.size else np.nan


def plot(found: dict[str, dict[str, np.ndarray]]) -> None:
    """Draw errors and sigmas by height."""
    figure, panels = plt.subplots(1, 2, figsize=(10, 4.6), layout='constrained')
    for panel, kind, title in zip(
        panels, ('', ' in the frame'), ('after one registration', 'in the frame of the drawing'),
        strict=True,
    ):  # fmt: skip
        for number, (name, one) in enumerate(found.items()):
            bands = np.digitize(one['height'], EDGES_M)
            for what, line, label in (('error', '.-', name), ('sigma', '--', None)):
                each = one[f'{what}{kind}']
                values = [rms_mm(each[bands == band]) for band in range(1, len(EDGES_M))]
                panel.plot(MIDDLES_MM, values, line, color=f'C{number}', label=label)
        panel.set(title=title, xlabel='height / mm', ylabel='rms / mm: error (-), sigma (- -)')
        panel.set_ylim(0.0)
        panel.grid(alpha=0.3)
        legend_under(panel, 0.16)
    figure.savefig(PLOT, dpi=90)


def rows() -> Iterator[harness.Row]:
    """Figures of each effort; half a minute."""
    if not SESSIONS.is_dir():
        print('  no folder of recorded sessions beside the repository: no rows')
        return
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, (words, check, target) in EFFORTS.items():
            bag, model = SESSIONS / f'{name}.mcap', Path(folder) / f'{name}.yaml'
            if name == 'scan':
                bag = beginning(SESSIONS / f'{check}.mcap', Path(folder) / 'scan.mcap', HALF_S)
            cpu_s = harness.anser('calibrate', bag, '--out', model).cpu_s
            one = found[words] = judged(model, check, HALF_S if name == 'scan' else 0.0)
            over = float(np.mean(one['error in the frame'] > 3.0 * one['sigma in the frame']))
            for what, unit, value, most in (
                ('error', 'mm', rms_mm(one['error']), target),
                ('in the frame', 'mm', rms_mm(one['error in the frame']), 0.6),
                ('over 3 sigma', '%', 100.0 * over, 1.0),
                ('without a pose', '%', 100.0 * float(one['lost']), None),
                ('processor time', 's', cpu_s, 10.0),
            ):
                yield harness.row(f'{words}: {what}', value, unit, target=most)
    plot(found)
