"""Imports a plate of Hall sensors over three electromagnets; every height predicts the others.

The data (Boehler et al., IEEE T-RO 2022, doi 10.1109/TRO.2022.3197107, Apache-2.0) are read where
they lie. The emitters are the magnets' three coils, each driven with a constant current (written
as tones of 1, 2 and 3 Hz, since tones are asked for and must differ; all phasors are real). Eight
combinations of currents +-35 A were measured: a flux is a coil's share of them, at 35 A. The plate
is a body of three channels a sensor, with a frame for each height. Its poses are the nominal ones,
the only ones that the data set has.
"""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.apps.lab.measured.recipe import (
    Recipe,
    ReportRow,
    calibrations,
    existing,
    figure,
    ran,
    vector,
    write_frames,
)
from anser_ros.arrays import Array
from anser_ros.errors import FitError
from anser_ros.wire.setup import Coil, Emitter, SensorSpec, Setup
from anser_ros.wire.tables import read_table

NAME, PLATE, AXES = 'navion', 'plate', 'xyz'
TURN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""From the data set's axes to those of fg: the magnets stand beside the plate, towards +y."""
PLANE_M = 0.29
"""The data set's y at which fg has its plane z = 0: about where the magnets begin."""
RADIUS_M = 0.11
"""Distance of the three magnets from the middle, about; they stand 120 degrees apart."""
VOLUME = ((-0.15, -0.15, 0.1), (0.15, 0.15, 0.45))
"""Where the plate and its sensors may be, m, fg."""
STATED = {'flux_noise_t': 2e-4, 'optical_position_m': 1e-3, 'optical_rotation_rad': 5e-3}
"""Readings with what sensors differ by, and the errors of the nominal poses."""
CURRENT_A = 35.0
"""Nominal current of the electromagnets, A, that fluxes are referred to."""
TARGETS_MT = {'all heights': 0.12, 'inner heights': 0.10}
"""What the error of the field should not exceed."""
SPECIAL_MT = {'all heights': 0.110, 'inner heights': 0.0912}
"""What code for these data alone reached: see docs/results/README.md."""
SPREADS = (
    ('spread of the gains found', 'sensor_gain_spread', 1e2, '%'),
    ('tilt of the axes found, along each tangent', 'sensor_axis_spread', 1e3, 'mrad'),
)
"""What `calibrate` finds of the sensors, by its effect; factor to the unit."""
CHOSEN = 'everything on the other heights; scored on the height left out, at its nominal pose'


def read(folder: Path) -> tuple[Array, Array]:
    """Return places (P, S, 3), m, and fields (P, S, 3, K), T, of one coil at its full current.

    Raises `FitError` when the file is missing, lacks a state of a sensor, or has other
    combinations of currents.
    """
    path = existing(folder / 'navion_steady.csv')
    table = read_table(path)

    def take(*names: str) -> Array:
        return table.numbers(names)

    current = take('I0_A', 'I1_A', 'I2_A')
    driven = np.abs(current).min(axis=1) > 0.0
    sensor, plane, state = take('sensor', 'plane', 'state')[driven].T
    shape = tuple(len(np.unique(values)) for values in (plane, sensor, state))
    if int(driven.sum()) != np.prod(shape):
        raise FitError(f'{path.name}: {int(driven.sum())} rows, expected {np.prod(shape)}')
    order = np.lexsort((state, sensor, plane))
    sign = np.sign(current[driven][order]).reshape(*shape, 3)
    product = np.einsum('psic,psid->pscd', sign, sign)
    if not np.array_equal(product, np.broadcast_to(shape[2] * np.eye(3), product.shape)):
        raise FitError(f'{path.name}: the currents are not all combinations of both signs')
    field = 1e-3 * take('Bx_mT', 'By_mT', 'Bz_mT')[driven][order].reshape(*shape, 3)
    place = take('x_m', 'y_m', 'z_m')[driven][order].reshape(*shape, 3)[:, :, 0]
    return place, np.einsum('psic,psix->psxc', sign, field) / shape[2]


def write_sessions(folder: Path, into: Path) -> list[Path]:
    """Write the data set as a session; return its file. Raises `BagError` when it exists."""
    place, field = read(folder)
    middle = place.mean(axis=1) * np.array([0.0, 0.0, 1.0])
    sensors = tuple(
        SensorSpec(3 * k + x, f'{PLATE}/s{k}/{AXES[x]}', PLATE, vector(at), vector(unit), 0.0)
        for k, at in enumerate(place[0] - middle[0])
        for x, unit in enumerate(np.eye(3))
    )
    angles = np.deg2rad([90.0, 210.0, 330.0])
    coils = tuple(
        Coil(f'coil{k}', vector(RADIUS_M * np.array([np.cos(a), np.sin(a), 0.0])), 0.0, 1.0 + k)
        for k, a in enumerate(angles.tolist())
    )
    setup = Setup(
        'fg', 1.0, Emitter('electromagnet', {'current_a': CURRENT_A}, coils), sensors, VOLUME,
        STATED,
    )  # fmt: skip
    flux = field.reshape(len(place), len(sensors), -1).astype(complex)
    upright = np.tile(Rotation.from_matrix(TURN).as_quat(), (len(place), 1))
    position = middle @ TURN.T + [0.0, 0.0, PLANE_M]
    path = into / f'{NAME}_{PLATE}.mcap'
    write_frames(path, setup, flux, {PLATE: (position, upright)})
    return [path]


def commands(bags: list[Path], out: Path) -> list[list[str]]:
    """Return the commands that predict each height, with sensors as stated and as found."""
    return calibrations(bags, out, ('--estimate', 'gains,axes,bend'))


def rows(folder: Path, bags: list[Path], out: Path) -> list[ReportRow]:
    """Return the errors of heights that took no part, without and with what was found."""
    documents = [ran(out / kind, 'calibration.json') for kind in ('plain', 'full')]
    before, after = map(_errors_mt, documents)
    spreads = {e['name']: e['parameters'].get('spread') for e in documents[1]['effects']}
    found = [
        ReportRow(NAME, what, float('nan'), scale * figure(spreads, name), unit, 'all heights')
        for what, name, scale, unit in SPREADS
    ]
    return [
        ReportRow(
            NAME, f'field of one coil at 35 A, component RMSE, {which}', before[which],
            after[which], 'mT', CHOSEN, goal,
            None if goal is None else bool(after[which] <= goal), SPECIAL_MT.get(which),
        )
        for which in before
        for goal in [TARGETS_MT.get(which)]
    ] + found  # fmt: skip


def _errors_mt(document: dict[str, Any]) -> dict[str, float]:
    """Error of all heights, of those with others above and below, and of each."""
    poses = sorted(document['heldout_by_pose'], key=lambda pose: pose['position_m'][1])
    error = 1e3 * np.array([figure(pose, 'flux_rmse_t') for pose in poses])
    return {
        'all heights': float(np.sqrt(np.mean(error**2))),
        'inner heights': float(np.sqrt(np.mean(error[1:-1] ** 2))),
        **{f'height {number} from below': float(one) for number, one in enumerate(error, 1)},
    }


RECIPE = Recipe(NAME, write_sessions, commands, rows)
