"""Imports a magnet before a patch of 16 three-axis magnetometers, and has its recipe.

By reciprocity the layout of sessions fits as it stands: frame `fg` is the magnet's own, turned so
that the patch is above it; its one emitter is a constant dipole (written as a tone of 1 Hz, since
a tone is asked for; all phasors are real), and every axis of every sensor is a tool sensor of the
rigid body `patch`. Each file states the sensors' axes again, up to a degree apart, so a model of
one file is taken to another with ``--resurveyed patch``.

The file `magnet_step` beside them has their layout: a robot carries a larger magnet past the
patch without turning it, so that no tracked volume above it is stated; the fields of the
surroundings are not taken off, since the data set has none for it.

The data (github xpy-zju/Dual-stage-magnetic-localization, MIT) are read where they lie.
"""

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.apps.lab.measured import recipe
from anser_ros.arrays import Array
from anser_ros.errors import FitError
from anser_ros.stamps import SECOND_NS
from anser_ros.wire.setup import Coil, Emitter, SensorSpec, Setup
from anser_ros.wire.setup_values import Vector
from anser_ros.wire.tables import read_table

NAME, BODY, AXES = 'magnet_patch', 'patch', 'xyz'
SENSORS = 16
"""Sensors of the patch."""
GEOMETRY = {'radius_m': 5e-3, 'half_length_m': 5e-3}
"""The magnet of the data sheet; nothing is computed from it."""
UPWARDS = np.diag([1.0, -1.0, -1.0])
"""Turns the magnet's frame so that the patch is above it, as tools are above a board."""
VOLUME = ((-0.06, -0.06, 0.01), (0.06, 0.06, 0.08))
"""Where the patch may be, m."""
STATED = {'flux_noise_t': 3e-6, 'optical_position_m': 2e-4, 'optical_rotation_rad': 8e-3}
"""Noise of the magnetometers and jitter of the optical system, as the setup states them."""
TARGET_MM, TARGET_DEG = 0.19, 0.53
"""Position and orientation errors that the recipe should reach."""
SPECIAL = {
    ('data1', 'data2'): (0.171, 0.455), ('data1', 'data3'): (0.162, 0.462),
    ('data2', 'data1'): (0.184, 0.508), ('data2', 'data3'): (0.164, 0.441),
    ('data3', 'data1'): (0.178, 0.504), ('data3', 'data2'): (0.167, 0.448),
}  # fmt: skip
"""Errors, mm and degrees, of code that was written for these data alone (docs/results/README.md):
learnt on the first file, the second one tracked."""


@dataclass(frozen=True)
class Recording:
    """Holds F poses of a magnet before S three-axis sensors, frame of the optical system."""

    name: str
    field_t: Array  # (F, S, 3), flux density in each sensor's own axes, ambient field removed, T
    sensor_m: Array  # (F, S, 3), stated sensor positions, m
    sensor_rotation: Array  # (F, S, 3, 3), stated rotations, sensor to optical frame
    magnet_m: Array  # (F, 3), stated magnet centre, m
    # (F, 3, 3), magnet to optical frame; the moment lies along the magnet's +z
    magnet_rotation: Array
    stamp_s: Array  # (F,)


def read_poses(path: Path, magnet: str) -> dict[str, Array]:
    """Return columns of a file of 16 sensors a pose, (F, 16, 3), the magnet's by their prefix.

    Raises `FitError` when a column is missing, or the rows are not whole poses.
    """
    table = read_table(recipe.existing(path))
    if len(table.cells) % SENSORS:
        raise FitError(f'{path.name}: {len(table.cells)} rows are not poses of {SENSORS} sensors')
    groups = {
        'field': ('Bx', 'By', 'Bz'),
        'place': ('sensor_x', 'sensor_y', 'sensor_z'),
        'turn': ('sensor_ox', 'sensor_oy', 'sensor_oz'),
        'magnet': tuple(f'{magnet}_{c}' for c in ('x', 'y', 'z')),
        'magnet_turn': tuple(f'{magnet}_{c}' for c in ('ox', 'oy', 'oz')),
    }
    out: dict[str, Array] = {}
    for key, names in groups.items():
        lost = [name for name in names if name not in table.names]
        if lost:
            raise FitError(f'{path.name} lacks the columns {", ".join(lost)}')
        out[key] = table.numbers(names, with_gaps=True).reshape(-1, SENSORS, 3)
    if 'timestamp' in table.names:
        out |= {'stamp': table.numbers(['timestamp'], with_gaps=True).reshape(-1, SENSORS)}
    return out


def as_recording(name: str, parts: dict[str, Array], background_t: Array) -> Recording:
    """Return a table in SI units, with matrices for rotations, and the ambient field removed."""
    turn = Rotation.from_rotvec(parts['turn'].reshape(-1, 3)).as_matrix()
    frames = len(parts['field'])
    stamp = parts['stamp'].mean(axis=1) if 'stamp' in parts else np.arange(frames, dtype=float)
    return Recording(
        name=name,
        field_t=parts['field'] * 1e-6 - background_t,
        sensor_m=parts['place'] * 1e-3,
        sensor_rotation=turn.reshape(frames, SENSORS, 3, 3),
        magnet_m=parts['magnet'][:, 0] * 1e-3,
        magnet_rotation=Rotation.from_rotvec(parts['magnet_turn'][:, 0]).as_matrix(),
        stamp_s=stamp,
    )


def load(folder: Path, name: str) -> Recording:
    """Read one file of poses, its own background subtracted."""
    parts = read_poses(folder / f'{name}.csv', 'm')
    table = read_table(recipe.existing(folder / f'{name}_background_uT.csv'))
    background = table.numbers(table.names) * 1e-6
    if background.shape != (SENSORS, 3):
        raise FitError(f'{name}: background of shape {background.shape}, expected (16, 3)')
    return as_recording(name, parts, background)


def file_names(folder: Path) -> list[str]:
    """Return the names of the files of poses that are there."""
    names = sorted(path.stem for path in folder.glob('data*.csv') if not path.stem.endswith('_uT'))
    if len(names) < 2:
        raise FitError(f'{folder} must hold at least two files of poses, found {len(names)}')
    return names


def patch_in_fg(recording: Recording) -> tuple[Array, Array]:
    """Return the pose of the patch in the frame fg: rotations (F, 3, 3), positions (F, 3) in m.

    The patch's own frame has its origin at the middle of the sensors and the optical axes.
    """
    middle = recording.sensor_m.mean(axis=1)
    turn = UPWARDS @ recording.magnet_rotation.swapaxes(1, 2)
    return turn, np.einsum('fij,fj->fi', turn, middle - recording.magnet_m)


def setup_of(
    recording: Recording,
    volume: tuple[Vector, Vector] | None = VOLUME,
    stated: Mapping[str, float] = STATED,
    geometry: Mapping[str, float] = GEOMETRY,
) -> Setup:
    """Return a setup of one emitter, and three channels a sensor as the first frame has them."""
    place = recording.sensor_m[0] - recording.sensor_m[0].mean(axis=0)
    turn = recording.sensor_rotation[0]
    sensors = tuple(
        SensorSpec(
            3 * k + axis,
            f'{BODY}/s{k + 1}/{AXES[axis]}',
            BODY,
            recipe.vector(place[k]),
            recipe.vector(turn[k, :, axis] / np.linalg.norm(turn[k, :, axis])),
            0.0,
        )
        for k in range(len(place))
        for axis in range(3)
    )
    emitter = Emitter('cylinder_magnet', geometry, (Coil('magnet', (0.0, 0.0, 0.0), 0.0, 1.0),))
    rate = 1.0 / float(np.median(np.diff(recording.stamp_s)))
    return Setup('fg', rate, emitter, sensors, volume, stated)


def write_session(recording: Recording, path: Path, setup: Setup | None = None) -> None:
    """Write one recording as a session, by default with the setup of `setup_of`."""
    turn, place = patch_in_fg(recording)
    stamps = np.round(recording.stamp_s * SECOND_NS).astype(np.int64).tolist()
    flux = recording.field_t.reshape(len(stamps), -1, 1).astype(np.complex128)
    quaternion = Rotation.from_matrix(turn).as_quat()
    poses = {BODY: (place, quaternion)}
    recipe.write_frames(path, setup or setup_of(recording), flux, poses, stamps)


def write_sessions(folder: Path, into: Path) -> list[Path]:
    """Write every file of poses as a session; return the files written."""
    paths = {name: into / f'magnet_{name}.mcap' for name in file_names(folder)}
    for name, path in paths.items():
        write_session(load(folder, name), path)
    return list(paths.values())


def commands(bags: list[Path], out: Path) -> list[list[str]]:
    """Return the commands that model each file, with and without effects, and track the others."""
    found = []
    for bag in bags:
        for kind, options in (('plain', ['--estimate', 'none']), ('full', [])):
            model = out / f'{bag.stem}_{kind}.yaml'
            report = ['--report', str(out / f'{bag.stem}_{kind}')]
            found.append(['calibrate', str(bag), '--out', str(model), *report, *options])
            found += [
                [
                    'evaluate', str(other), '--model', str(model), '--resurveyed', BODY,
                    '--out', str(out / f'{bag.stem}_{kind}_{other.stem}'),
                ]
                for other in bags
                if other != bag
            ]  # fmt: skip
    return found


def rows(folder: Path, bags: list[Path], out: Path) -> list[recipe.ReportRow]:
    """Return the errors before and after, on files that took no part."""
    made = []
    for bag, other in itertools.permutations(bags, 2):
        learnt, tracked = (path.stem.removeprefix('magnet_') for path in (bag, other))
        found = recipe.ran(out / f'{bag.stem}_full', 'calibration.json')['effects']
        chosen = f'{", ".join(e["name"] for e in found)}: on {learnt} alone; scored on {tracked}'
        for k, (kind, unit, scale, goal) in enumerate(
            (
                ('position', 'mm', 1e3, TARGET_MM),
                ('orientation', 'deg', math.degrees(1.0), TARGET_DEG),
            )
        ):
            key = f'{kind}_rmse_{"m" if kind == "position" else "rad"}'
            before, after = (
                recipe.figure(
                    recipe.ran(out / f'{bag.stem}_{model}_{other.stem}', 'evaluation.json'),
                    'sources', BODY, key,
                )
                for model in ('plain', 'full')
            )  # fmt: skip
            made.append(
                recipe.ReportRow(
                    NAME, f'learnt on {learnt}, {tracked} tracked: {kind} RMSE', scale * before,
                    scale * after, unit, chosen, goal, bool(scale * after <= goal),
                    SPECIAL.get((learnt, tracked), (None, None))[k],
                )
            )  # fmt: skip
    return made


RECIPE = recipe.Recipe(NAME, write_sessions, commands, rows)


STEP, STEP_FILE = 'magnet_step', 'step1'
STEP_STATED = {'flux_noise_t': 3e-6, 'optical_position_m': 1e-5, 'optical_rotation_rad': 1e-4}
"""Noise of the magnetometers and jitter of the robot."""
STEP_SPECIAL_UT = 5.67
"""What code that was written for this file alone reached: constant fields of every channel and
the size of the source, together (docs/results/README.md)."""


def write_step(folder: Path, into: Path) -> list[Path]:
    """Write the robot's file as a session; return it. Raises `BagError` when it exists."""
    parts = read_poses(folder / f'{STEP_FILE}.csv', 'M')
    recording = as_recording(STEP_FILE, parts, np.zeros(3))
    path = into / f'magnet_{STEP_FILE}.mcap'
    write_session(recording, path, setup_of(recording, None, STEP_STATED, {}))
    return [path]


def step_rows(folder: Path, bags: list[Path], out: Path) -> list[recipe.ReportRow]:
    """Return the errors of the field at blocks of poses that took no part."""
    before, after = (
        1e6 * recipe.figure(recipe.ran(out / kind, 'calibration.json'), 'heldout_flux_rmse_t')
        for kind in ('plain', 'full')
    )
    chosen = 'everything on the other blocks of poses; scored on the block left out'
    return [
        recipe.ReportRow(
            STEP, 'field at poses left out, RMSE', before, after, 'uT', chosen,
            special=STEP_SPECIAL_UT,
        )
    ]  # fmt: skip


STEP_RECIPE = recipe.Recipe(STEP, write_step, recipe.calibrations, step_rows, folder=NAME)
