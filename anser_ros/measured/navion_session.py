"""Makes sessions of a plate over three magnets: the plate as one tool, and one sensor as a tool.

The emitters are the three coils, driven with a constant current (written as tones of 1, 2 and 3
Hz, since tones are asked for and must differ; all phasors are real). A flux is a coil's share of
the eight states' readings, at its full current. Poses are the nominal ones, the only ones that the
data set has.

`navion_plate` is what was measured: 363 channels on the body `plate`, a frame a height. In
`navion_sensor` one three-axis sensor visits all places of all heights in turn, a frame a place, as
if the 121 sensors were the same; it has the many frames that calibration and diagnosis ask for.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from anser_ros.measured.navion_data import NavionData, load
from anser_ros.measured.navion_sources import locate_magnets
from anser_ros.measured.session_file import vector, write_frames
from anser_ros.stamps import SECOND_NS
from anser_ros.wire.setup import Coil, Emitter, SensorSpec, Setup

Array = NDArray[np.float64]

PLATE, SENSOR = 'plate', 'sensor'
AXES = 'xyz'
KIND = 'electromagnet'
TURN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""From the data set's axes to those of fg: the magnets stand beside the plate, towards +y."""
PLANE_M = 0.29
"""The data set's y at which fg has its plane z = 0: where one dipole a magnet is found to lie."""
VOLUME = ((-0.15, -0.15, 0.1), (0.15, 0.15, 0.45))
"""Where the plate and its sensors may be, m, fg."""
STATED = {'flux_noise_t': 2e-4, 'optical_position_m': 1e-3, 'optical_rotation_rad': 5e-3}
"""Readings with what sensors differ by, and the errors of the nominal poses."""
CURRENT_A = 35.0
"""Nominal current of the electromagnets, A, that fluxes are referred to."""


def in_fg(points: Array) -> Array:
    """Return points (P, 3) of the data set's frame in fg, m: the magnets lie below, the sensors
    above.
    """
    return np.asarray(points @ TURN.T + [0.0, 0.0, PLANE_M])


def emitter_of(data: NavionData) -> Emitter:
    """Return three coils, each where one dipole explains its field best."""
    coils = tuple(
        Coil(f'coil{k}', vector(place), 0.0, float(1 + k))
        for k, place in enumerate(in_fg(np.array(locate_magnets(data.coils))))
    )
    return Emitter(KIND, {'current_a': CURRENT_A}, coils)


def _axes(body: str, name: str, first: int, place: Array) -> list[SensorSpec]:
    """The three channels of a sensor."""
    return [
        SensorSpec(first + k, f'{name}/{AXES[k]}', body, vector(place), vector(unit), 0.0)
        for k, unit in enumerate(np.eye(3))
    ]


def _write(
    path: Path, emitter: Emitter, sensors: Sequence[SensorSpec], flux: Array, place: Array
) -> None:
    """Frames of one body, a second apart: flux (F, S, K), places (F, 3) in the data's frame."""
    setup = Setup('fg', 1.0, emitter, tuple(sensors), VOLUME, STATED)
    upright = np.tile(Rotation.from_matrix(TURN).as_quat(), (len(place), 1))
    stamps = [SECOND_NS * (1 + frame) for frame in range(len(place))]
    body = sensors[0].body
    write_frames(path, setup, stamps, flux.astype(complex), {body: (in_fg(place), upright)})


def write_plate(data: NavionData, emitter: Emitter, path: Path) -> None:
    """Write the plate's session; raises `BagError` when the file exists."""
    heights, grid = data.coils.height_m, data.coils.grid_m
    sensors = [
        spec
        for k, place in enumerate(grid)
        for spec in _axes(PLATE, f'{PLATE}/s{k}', 3 * k, place)
    ]
    # (P, K, S, 3) to a row per sensor and axis, (P, 3 S, K)
    flux = data.coils.field_t.transpose(0, 2, 3, 1).reshape(heights.size, len(sensors), -1)
    _write(path, emitter, sensors, flux, heights[:, None] * np.array([0.0, 0.0, 1.0]))


def write_sensor(data: NavionData, emitter: Emitter, path: Path) -> None:
    """Write a session in which one sensor stands for all; raises `BagError` where the file is."""
    heights, grid = data.coils.height_m, data.coils.grid_m
    flux = data.coils.field_t.transpose(0, 2, 3, 1).reshape(heights.size * len(grid), 3, -1)
    places = (grid[None] + heights[:, None, None] * np.array([0.0, 0.0, 1.0])).reshape(-1, 3)
    _write(path, emitter, _axes(SENSOR, SENSOR, 0, np.zeros(3)), flux, places)


def write_sessions(folder: Path, into: Path) -> list[Path]:
    """Write the data set as two sessions; return the files written."""
    into.mkdir(parents=True, exist_ok=True)
    data = load(folder)
    emitter = emitter_of(data)
    paths = []
    for body, write in ((PLATE, write_plate), (SENSOR, write_sensor)):
        path = into / f'navion_{body}.mcap'
        write(data, emitter, path)
        paths.append(path)
    return paths
