"""Imports the 50 Hz field in front of a power transformer, scanned by a three-axis probe.

The data (github giaccone/field_measurements; Freschi et al., Physics in Medicine and Biology 2018,
doi 10.1088/1361-6560/aa9915; without a licence, so that they are read where they lie) are phasors
at places of a wooden frame. The probe never turns. The published grid is partly interpolated: the
planes that were measured are taken, and of the farthest every second point each way, as measured.
One plane takes no part in the calibration and judges it.
"""

from pathlib import Path

import numpy as np
from scipy.interpolate import RBFInterpolator

from anser_ros.apps.lab.measured import recipe
from anser_ros.arrays import Array, ComplexArray
from anser_ros.errors import FitError
from anser_ros.sessions.session import load_session
from anser_ros.sessions.starting_model import load_model
from anser_ros.wire.setup import Coil, Emitter, SensorSpec, Setup
from anser_ros.wire.tables import read_table

NAME, PROBE = 'transformer', 'probe'
COLUMNS = 9
"""Places, m, real and imaginary parts of the field, T."""
FINE_M, COARSE_M = (0.5, 0.6, 0.8), 1.0
"""The data set's x of the planes that were measured each 0.1 m, and of the one each 0.2 m."""
KEPT_M = 0.8
"""The plane that judges: between the others, so that nothing is extrapolated."""
HEIGHT_M = 1.0
"""The data set's z that is y = 0 of fg; its x, away from the transformer, is z of fg."""
VOLUME = ((-0.6, -1.1, 0.4), (0.6, 1.1, 1.1))
"""Where the probe was, m, fg, and some centimetres more."""
KERNEL = 'linear'
"""Of the interpolation beside: of scipy's kernels without a length the best on the plane left out
(4.8 uT; thin plates 10.2, cubic 13.3), so that nothing speaks for the model."""
STATED = {'flux_noise_t': 2e-7, 'optical_position_m': 3e-3, 'optical_rotation_rad': 1e-2}
"""Resolution of the meter, and what a wooden frame may be off by."""


def read(folder: Path) -> tuple[Array, ComplexArray]:
    """Return places (P, 3), m, fg, and fields (P, 3), T, complex, along the axes of fg.

    Raises `FitError` when the file is missing, or is no table of nine columns.
    """
    path = recipe.existing(folder / 'data_set.txt')
    found = read_table(path)
    table = found.numbers(found.names)
    if table.shape[1] != COLUMNS:
        raise FitError(f'{path.name}: {table.shape[1]} columns, expected {COLUMNS}')
    decimetres = np.rint(10 * table[:, :3]).astype(int)
    fine = np.isin(decimetres[:, 0], np.rint(10 * np.array(FINE_M)).astype(int))
    coarse = decimetres[:, 0] == round(10 * COARSE_M)
    corner = decimetres[:, 1:].min(axis=0)
    measured = fine | (coarse & np.all((decimetres[:, 1:] - corner) % 2 == 0, axis=1))
    place, field = table[measured, :3], table[measured, 3:6] + 1j * table[measured, 6:]
    return np.roll(place - [0.0, 0.0, HEIGHT_M], -1, axis=1), np.roll(field, -1, axis=1)


def write_sessions(folder: Path, into: Path) -> list[Path]:
    """Write the planes to calibrate with and the one that judges; return the two files."""
    place, field = read(folder)
    sensors = tuple(
        SensorSpec(k, f'{PROBE}/{axis}', PROBE, (0.0, 0.0, 0.0), recipe.vector(unit), 0.0)
        for k, (axis, unit) in enumerate(zip('xyz', np.eye(3), strict=True))
    )
    coil = Coil(NAME, (0.0, 0.0, 0.0), 0.0, 50.0)
    setup = Setup('fg', 1.0, Emitter('transformer', {}, (coil,)), sensors, VOLUME, STATED)
    kept = np.isclose(place[:, 2], KEPT_M)
    paths = []
    for name, chosen in (('planes', ~kept), ('kept', kept)):
        count = int(chosen.sum())
        path = into / f'{NAME}_{name}.mcap'
        pose = (place[chosen], np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)))
        recipe.write_frames(path, setup, field[chosen][:, :, None], {PROBE: pose})
        paths.append(path)
    return paths


def commands(bags: list[Path], out: Path) -> list[list[str]]:
    """Return the commands that model three planes, and look for what they leave on the fourth."""
    model = str(out / 'model.yaml')
    return [
        ['calibrate', str(bags[0]), '--out', model, '--report', str(out / 'calibration')],
        ['diagnose', str(bags[1]), '--model', model, '--out', str(out / 'diagnosis')],
    ]


def rows(folder: Path, bags: list[Path], out: Path) -> list[recipe.ReportRow]:
    """Return the error of the model on the plane left out, beside that of an interpolation."""
    known, judge = (load_session(bag).tools[0] for bag in bags)
    parts = known.flux[:, :, 0].view(float)
    between = RBFInterpolator(known.position, parts, kernel=KERNEL)(judge.position).view(complex)
    model, (count, channels, _) = load_model(out / 'model.yaml'), judge.flux.shape
    axes = np.tile(judge.sensors.axis, (count, 1))
    predicted = model.flux(np.repeat(judge.position, channels, axis=0), axes)

    def rmse_ut(flux: ComplexArray) -> float:
        error = (flux.reshape(count, channels) - judge.flux[:, :, 0]).view(float)
        return float(1e6 * np.sqrt(np.mean(error**2)))

    named = recipe.ran(out / 'diagnosis', 'diagnosis.json')['effects']
    chosen = 'everything on three planes; scored on the plane between them'
    figures = (
        ('field on the plane left out, interpolated and by the model, RMSE', rmse_ut(between),
         rmse_ut(predicted), 'uT'),
        ('effects named on the plane left out', float('nan'), float(len(named)), ''),
    )  # fmt: skip
    return [recipe.ReportRow(NAME, *values, chosen) for values in figures]


RECIPE = recipe.Recipe(NAME, write_sessions, commands, rows)
