"""Imports a real AC tracker of three source coils and a triaxial sensor on a stage.

The data (github robmacl/ilemt_cal_data, IEEE Sensors J. 2025, doi 10.1109/JSEN.2025.3533436; no
licence file, the paper states Apache-2.0 for its software) are read where they lie: `stage`
(F, 6), mm and degrees as commanded, and `coupling` (F, band, sensor, source), complex, without a
unit, of which 1 is written as 10 uT. Frame fg is the source fixture's: z to the sensor, x up. The
body's origin is the middle of the sensor's fixture. A model of coarse patterns (`md`) tracks
fine ones (`ld`), the three sensor fixtures together.
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.apps.lab.measured.recipe import (
    Recipe,
    ReportRow,
    existing,
    figure,
    ran,
    vector,
    write_frames,
)
from anser_ros.arrays import Array
from anser_ros.wire.setup import Coil, Emitter, SensorSpec, Setup

NAME, BODY = 'ilemt', 'premo'
X, Y, Z = np.eye(3)  # unit vectors of any frame
FG = np.stack([Z, X, Y])  # rows: axes of fg in the source fixture's frame
HOME_M = np.array([0.0, 0.243, 0.012])  # the stage's zero in that frame, by a ruler
FIXTURES = {'YoutZup': (Y, Z), 'ZinXdown': (-Z, -X), 'ZinYup': (-Z, Y)}
"""Axes of the sensor that point away from the source and up."""
AXES = (Y, X, -Z)  # of the sensor's three coils on its mover
DIPOLE = ((0.030, 0.045, -0.020), (-0.035, 0.050, -0.020), (0.0, 0.055, 0.035))
CONCENTRIC = ((-0.015, 0.0, 0.010),) * 3
"""Middles of the source's coils in its fixture's frame, m, by a ruler."""
SETS = {
    'dipole': ('cal_9_16_premo_rotated_dipole', DIPOLE, 0, (7500.0, 10500.0, 13500.0)),
    'concentric': ('cal_7_30_premo_cmu', CONCENTRIC, 0, (7500.0, 10500.0, 13500.0)),
    'low': ('cal_9_16_premo_rotated_dipole', DIPOLE, 1, (300.0, 330.0, 360.0)),
}
"""Folder, places of the coils, band and tones, Hz, of each set."""
PAPER = {'dipole': (0.272, 0.210), 'concentric': (0.416, 0.273)}
"""Errors of the makers' own calibration, mm and degrees rms, on data of the same source."""
TESLA = 1e-5  # T of a unit of the readings: nominal, cancels in all errors
STATED = {'flux_noise_t': 2e-10, 'optical_position_m': 6.2e-5, 'optical_rotation_rad': 1.7e-3}
"""Noise at rest, and what is left of the stage's errors."""
VOLUME = ((-0.09, -0.11, 0.14), (0.12, 0.11, 0.35))  # m: all poses, and some beside
STAGE = (  # from axis, to axis, place and error, mm: the makers' measurement of their stage
    (2, 0, ((-46, -20, 0, 20, 50), (-0.14, -0.01, 0.05, 0.085, 0.1))),
    (2, 2, ((-46, -21, 4, 29, 49), (0.0, -0.05, -0.09, -0.115, -0.13))),
    (0, 0, ((-50, -25, 0, 25, 50), (0.155, 0.05, 0.04, 0.04, 0.0))),
    (1, 1, ((-50, -25, -15, 0, 25, 50), (-0.35, -0.31, -0.255, -0.2, -0.13, 0.0))),
)


def poses(stage: Array, fixture: str) -> tuple[Array, Array]:
    """Return positions (F, 3), m, and quaternions (F, 4) of the body, of a stage's (F, 6)."""
    off = np.zeros((len(stage), 3))
    for source, target, (place, error) in STAGE:
        off[:, target] += np.interp(stage[:, source], place, error) - np.interp(0.0, place, error)
    spin = Rotation.from_euler('z', stage[:, 5:6], degrees=True)
    out, up = FIXTURES[fixture]
    held = np.stack([np.cross(out, up), out, up])
    turn = Rotation.from_matrix(FG @ spin.as_matrix() @ held)
    return (1e-3 * (stage[:, :3] + spin.apply(off)) + HOME_M) @ FG.T, turn.as_quat()


def write_sessions(folder: Path, into: Path) -> list[Path]:
    """Write a session of each set and pattern, with all sensor fixtures; return the files."""
    bags = []
    for name, (where, places, band, tones) in SETS.items():
        coils = tuple(
            Coil(axis, vector(FG @ np.array(place)), 0.0, tone)
            for axis, place, tone in zip('xyz', places, tones, strict=True)
        )
        sensors = tuple(
            SensorSpec(k, f'{BODY}/{"xyz"[k]}', BODY, (0.0, 0.0, 0.0), vector(axis), 0.0)
            for k, axis in enumerate(AXES)
        )
        setup = Setup('fg', 1.0, Emitter(f'{NAME}_{name}', {}, coils), sensors, VOLUME, STATED)
        for pattern in ('md', 'ld'):
            flux, held = [], []
            for fixture in FIXTURES:
                file = existing(folder / where / f'soYoutZup_se{fixture}_{pattern}.npz')
                with np.load(file) as kept:
                    flux.append(TESLA * kept['coupling'][:, band])
                    held.append(poses(kept['stage'], fixture))
            bags.append(into / f'{NAME}_{name}_{pattern}.mcap')
            position, quaternion = (np.concatenate(part) for part in zip(*held, strict=True))
            at = {BODY: (position, quaternion)}
            write_frames(bags[-1], setup, np.concatenate(flux), at)
    return bags


def commands(bags: list[Path], out: Path) -> list[list[str]]:
    """Return the commands that learn on one pattern and track the other, both ways."""
    made = []
    for learnt, tracked in [*zip(bags[::2], bags[1::2], strict=True), bags[1::-1]]:
        model = str(out / f'{learnt.stem}.yaml')
        made.append(['calibrate', str(learnt), '--out', model])
        result = str(out / f'{learnt.stem}_tracked')
        made.append(['evaluate', str(tracked), '--model', model, '--out', result])
    return made


def rows(folder: Path, bags: list[Path], out: Path) -> list[ReportRow]:
    """Return the errors of the patterns that were tracked, beside the makers'."""
    found = []
    for learnt in (*bags[::2], bags[1]):
        _, name, pattern = learnt.stem.split('_')
        error = ran(out / f'{learnt.stem}_tracked', 'evaluation.json')
        paper = PAPER.get(name, (None, None)) if pattern == 'md' else (None, None)
        note = f'{pattern}; scored on the other'
        for key, scale, unit, theirs in (
            ('position_rmse_m', 1e3, 'mm', paper[0]),
            ('orientation_rmse_rad', np.degrees(1.0), 'deg', paper[1]),
            ('tracked_fraction', 100.0, '%', None),
        ):
            value = float(scale * figure(error, 'bodies', BODY, key))
            what = key.rpartition('_')[0].replace('_', ' ')
            words = f'{name}, learnt on {pattern}: {what}'
            found.append(ReportRow(NAME, words, float('nan'), value, unit, note, special=theirs))
    return found


RECIPE = Recipe(NAME, write_sessions, commands, rows)
