"""Imports a real AC tracker of three source coils and a triaxial sensor on a stage.

The data (github robmacl/ilemt_cal_data, IEEE Sensors J. 2025, doi 10.1109/JSEN.2025.3533436; no
licence file, the paper states Apache-2.0 for its software) are read where they lie: `stage`
(F, 6), mm and degrees as commanded, and `coupling` (F, band, sensor, source), complex, without a
unit, of which 1 is written as 10 uT. Frame fg turns with the source: in its home fixture z points
to the sensor and x up. The body's origin is the middle of the sensor's fixture. Each pair of
fixtures is a session; a model of all coarse patterns (`md`) tracks the fine ones (`ld`). What
happened to some files, or is done to one here, `diagnose` has to name.
"""

from collections import Counter
from itertools import product
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.apps.lab.measured import recipe
from anser_ros.arrays import Array
from anser_ros.wire.setup import Coil, Emitter, SensorSpec, Setup

NAME, BODY = 'ilemt', 'premo'
X, Y, Z = np.eye(3)  # unit vectors of any frame
FG = np.stack([Z, X, Y])  # rows: axes of fg in the source fixture's frame
HOME_M = np.array([0.0, 0.243, 0.012])  # the stage's zero in that frame, by a ruler
FIXTURES = {
    'YoutZup': (Y, Z), 'ZinXdown': (-Z, -X), 'ZinYup': (-Z, Y), 'XinYup': (-X, Y),
    'XoutZup': (X, Z), 'ZoutYup': (Z, Y),
}  # fmt: skip
"""Axes of what a fixture holds that point away from the source and up."""
HOME = 'YoutZup'
SENSOR = tuple((HOME, held) for held in (HOME, 'ZinXdown', 'ZinYup'))  # fixtures of both
SOURCE = tuple((held, HOME) for held in ('XinYup', 'XoutZup', 'ZoutYup'))
AXES = (Y, X, -Z)  # of the sensor's three coils on its mover
DIPOLE = ((0.030, 0.045, -0.020), (-0.035, 0.050, -0.020), (0.0, 0.055, 0.035))
CONCENTRIC = ((-0.015, 0.0, 0.010),) * 3
"""Middles of the source's coils in its fixture's frame, m, by a ruler."""
TONES = (7500.0, 10500.0, 13500.0), (300.0, 330.0, 360.0)  # of the bands, Hz
MD, LD = PATTERNS = 'so{}_se{}_md', 'so{}_se{}_ld'
ROTATED, SIMPLE = 'cal_9_16_premo_rotated_dipole', SENSOR[:1]
SETS = {
    'dipole': (ROTATED, DIPOLE, 0, SENSOR, PATTERNS),
    'concentric': ('cal_7_30_premo_cmu', CONCENTRIC, 0, SENSOR, PATTERNS),
    'low': (ROTATED, DIPOLE, 1, SENSOR, PATTERNS),
    'turned': (ROTATED, DIPOLE, 0, (*SENSOR, *SOURCE), PATTERNS),
    'again': ('cal_9_2_premo_rotated_dipole', DIPOLE, 0, SIMPLE, (MD, f'{MD}2')),
    'later': ('cal_08_31_premo_rotated_dipole', DIPOLE, 0, SIMPLE, PATTERNS),
    'crossed': ('cal_9_15_premo_cmu', CONCENTRIC, 0, SOURCE[1:2], (LD, MD)),
    'reversed': ('cal_5_19_premo_cmu', CONCENTRIC, 0, SIMPLE, ('Z_rot_md', 'Z_rot_ld')),
}
"""Folder, places of the coils and band of each set, its fixtures, files to learn and to track."""
ASKED = {
    'again': (), 'later': ('common_gain',), 'reversed': ('sensor_polarity',),
    'crossed': ('coil_phase', 'coil_phase', 'coil_polarity'),
    'moved': ('registration', 'coil_turned', 'coil_moved'), 'commanded': ('optical_scale',),
    'fixture': ('body_turned',), 'gain': ('common_gain',),
    'both': ('coil_polarity', 'sensor_polarity'), 'phases': ('coil_phase',) * 3,
    'step': ('coil_fluctuation',), 'shifted': ('registration',),
}  # fmt: skip
"""Effects to name, and no others: in the last files of sets, where the dipole's source was moved
and one emitter by itself, the concentric one's differs, and where the fine pattern is changed."""
OTHERS = {'moved': ('dipole', 'cal_9_1_premo_rotated_dipole', MD),
          'shifted': ('concentric', 'cal_7_30_premo_cmu', LD)}  # fmt: skip
"""Set whose model tells what happened, folder and pattern, where these are not the dipole's."""
FACTORS = {  # of the readings, by sensor and emitter
    'reversed_md': np.array([[1.0], [1.0], [-1.0]]), 'gain': np.full((1, 1), 1.003),
    'both': np.outer([1.0, 1.0, -1.0], [-1.0, 1.0, 1.0]),
    'phases': np.exp(1e-3j * np.array([[4.0, -3.0, 6.0]])),
}  # fmt: skip
STEP = np.array([1.006, 1.0, 1.0])  # of the emitters, from two fifths of the time on
PAPER = {'dipole': (0.272, 0.210), 'concentric': (0.416, 0.273), 'turned': (3.60, 1.49)}
"""Errors of the makers' own calibration, mm and degrees rms, on data of the same source."""
KEYS = 'position_rmse_m', 'orientation_rmse_rad', 'tracked_fraction'
SCALES = 1e3, np.degrees(1.0), 100.0  # to mm, degrees, per cent
TESLA = 1e-5  # T of a unit of the readings: nominal, cancels in all errors
STATED = {'flux_noise_t': 2e-10, 'optical_position_m': 6.2e-5, 'optical_rotation_rad': 1.7e-3}
BEFORE, AROUND = ((-0.09, -0.11, 0.14), (0.12, 0.11, 0.35)), ((-0.35,) * 3, (0.35,) * 3)  # m
STAGE = (  # from axis, to axis, place and error, mm: the makers' measurement of their stage
    (2, 0, ((-46, -20, 0, 20, 50), (-0.14, -0.01, 0.05, 0.085, 0.1))),
    (2, 2, ((-46, -21, 4, 29, 49), (0.0, -0.05, -0.09, -0.115, -0.13))),
    (0, 0, ((-50, -25, 0, 25, 50), (0.155, 0.05, 0.04, 0.04, 0.0))),
    (1, 1, ((-50, -25, -15, 0, 25, 50), (-0.35, -0.31, -0.255, -0.2, -0.13, 0.0))),
)


def held(fixture: str) -> Array:
    """Return the rotation to a fixture's frame from that of what it holds."""
    out, up = FIXTURES[fixture]
    return np.stack([np.cross(out, up), out, up])


def poses(stage: Array, source: str, sensor: str, told: bool = True) -> tuple[Array, Array]:
    """Return positions (F, 3), m, and quaternions (F, 4) of the body, of a stage's (F, 6).

    ``told``: where the stage was, as its makers measured, and not where it was sent.
    """
    off = np.zeros((len(stage), 3))
    for of, target, (place, error) in STAGE if told else ():
        off[:, target] += np.interp(stage[:, of], place, error) - np.interp(0.0, place, error)
    spin = Rotation.from_euler('z', stage[:, 5:6], degrees=True)
    to_fg = FG @ held(source).T
    turn = Rotation.from_matrix(to_fg @ spin.as_matrix() @ held(sensor))
    return (1e-3 * (stage[:, :3] + spin.apply(off)) + HOME_M) @ to_fg.T, turn.as_quat()


def _write(bag: Path, file: Path, setup: Setup, band: int, source: str, sensor: str) -> Path:
    """Write a session of a file, changed as the bag's name says."""
    what = bag.stem.partition('_')[2].replace(f'_{HOME}', '')
    with np.load(recipe.existing(file)) as kept:
        flux, stage = TESLA * kept['coupling'][:, band], kept['stage']
    flux = flux * FACTORS.get(what, 1.0)
    if what == 'step':
        flux[2 * len(flux) // 5 :] *= STEP
    at = poses(stage, source, 'ZinYup' if what == 'fixture' else sensor, what != 'commanded')
    recipe.write_frames(bag, setup, flux, {BODY: at})
    return bag


def write_sessions(folder: Path, into: Path) -> list[Path]:
    """Write a session of each set, pattern and pair of fixtures, and of each fault."""
    bags, setups = [], {}
    for name, (where, places, band, fixtures, patterns) in SETS.items():
        coils = tuple(
            Coil(axis, recipe.vector(FG @ np.array(place)), 0.0, tone)
            for axis, place, tone in zip('xyz', places, TONES[band], strict=True)
        )
        sensors = tuple(
            SensorSpec(k, f'{BODY}/{"xyz"[k]}', BODY, (0.0, 0.0, 0.0), recipe.vector(axis), 0.0)
            for k, axis in enumerate(AXES)
        )
        volume = BEFORE if {source for source, _ in fixtures} == {HOME} else AROUND
        kind = Emitter(f'{NAME}_{name}', {}, coils)
        setups[name] = Setup('fg', 1.0, kind, sensors, volume, STATED)
        for pattern, (source, sensor) in product(patterns, fixtures):
            file = folder / where / f'{pattern.format(source, sensor)}.npz'
            bag = into / f'{NAME}_{name}_{source}_{sensor}_{pattern.rpartition("_")[2]}.mcap'
            bags.append(_write(bag, file, setups[name], band, source, sensor))
    for name in (name for name in ASKED if name not in SETS):
        of, where, pattern = OTHERS.get(name, ('dipole', ROTATED, LD))
        file = folder / where / f'{pattern.format(HOME, HOME)}.npz'
        bags.append(_write(into / f'{NAME}_{name}.mcap', file, setups[of], 0, HOME, HOME))
    return bags


def tried(bags: list[Path]) -> dict[str, tuple[list[Path], list[Path]]]:
    """Return what is learnt and what is tracked: each set's patterns, and one the other way."""
    found = {}
    for name in SETS:
        own = [bag for bag in bags if bag.stem.split('_')[1] == name]
        found[name] = own[: len(own) // 2], own[len(own) // 2 :]
    return {**found, 'dipole-backwards': found['dipole'][::-1]}


def commands(bags: list[Path], out: Path) -> list[list[str]]:
    """Return the commands that learn on one pattern and track the other, and that tell faults."""
    made = []
    for name, (learnt, tracked) in tried(bags).items():
        model = str(out / f'{name}.yaml')
        made.append(['calibrate', *map(str, learnt), '--out', model])
        verb = 'diagnose' if name in ASKED else 'evaluate'
        made += [[verb, str(b), '--model', model, '--out', str(out / b.stem)] for b in tracked]
    for bag in (bag for bag in bags if bag.stem.partition('_')[2] in ASKED):
        of, *_ = OTHERS.get(bag.stem.partition('_')[2], ('dipole',))
        known = out / f'{of}.yaml'
        made.append(['diagnose', str(bag), '--model', str(known), '--out', str(out / bag.stem)])
    return made


def rows(folder: Path, bags: list[Path], out: Path) -> list[recipe.ReportRow]:
    """Return the errors of the patterns that were tracked, of all frames, beside the makers'."""
    found, nan = [], float('nan')
    for name, (_, tracked) in tried(bags).items():
        if name in ASKED:
            continue
        own = [bag for bag in tracked if name != 'turned' or bag.stem.split('_')[2] != HOME]
        each = [recipe.ran(out / bag.stem, 'evaluation.json') for bag in own]
        paper = *PAPER.get(name, (None, None)), None
        for key, scale, unit, theirs in zip(KEYS, SCALES, ('mm', 'deg', '%'), paper, strict=True):
            values = np.array([recipe.figure(one, 'bodies', BODY, key) for one in each])
            value = float(scale * np.sqrt((values**2).mean()))
            words = f'{name}: {key.rpartition("_")[0].replace("_", " ")}'
            note = 'the other pattern'
            found.append(recipe.ReportRow(NAME, words, nan, value, unit, note, special=theirs))
    for name, asked in ASKED.items():
        bag = [bag for bag in bags if bag.stem.split('_')[1] == name][-1]
        told = recipe.ran(out / bag.stem, 'diagnosis.json')
        named = Counter(effect['name'] for effect in told['effects'])
        wrong = (named - Counter(asked)).total() + (Counter(asked) - named).total()
        words = f'{name}: {", ".join(named.elements()) or "nothing"}: names missing or too many'
        note = f'asked: {", ".join(asked) or "nothing"}'
        found.append(recipe.ReportRow(NAME, words, nan, wrong, '', note, 0.0, wrong == 0))
        words, keys = f'{name}: position rmse, held out', ('before', 'after')
        both = (recipe.figure(told, 'held_out', f'position_rmse_{key}_m') for key in keys)
        before, after = (1e3 * value for value in both)
        found.append(recipe.ReportRow(NAME, words, before, after, 'mm', 'the other blocks'))
    return found


RECIPE = recipe.Recipe(NAME, write_sessions, commands, rows)
