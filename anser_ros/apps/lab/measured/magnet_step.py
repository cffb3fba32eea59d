"""Imports a large magnet that a robot carries past the patch of magnetometers, with its recipe.

The file lies beside those of `magnet_patch` and has their layout. The magnet never turns and
passes beside the patch, so that no tracked volume above it is stated; the fields of the
surroundings are not taken off, since the data set has none for this file.
"""

from pathlib import Path

import numpy as np

from anser_ros.apps.lab.measured import magnet_patch
from anser_ros.apps.lab.measured.recipe import Recipe, ReportRow, calibrations, figure, ran

NAME, FILE = 'magnet_step', 'step1'
STATED = {'flux_noise_t': 3e-6, 'optical_position_m': 1e-5, 'optical_rotation_rad': 1e-4}
"""Noise of the magnetometers and jitter of the robot."""
SPECIAL_UT = 5.67
"""What code that was written for this file alone reached: constant fields of every channel and
the size of the source, together (docs/results/README.md)."""


def write_sessions(folder: Path, into: Path) -> list[Path]:
    """Write the file as a session; return its file. Raises `BagError` when it exists."""
    table = folder / f'{FILE}.csv'
    parts = magnet_patch.read_poses(table, 'M')
    recording = magnet_patch.as_recording(FILE, parts, np.zeros(3))
    path = into / f'magnet_{FILE}.mcap'
    setup = magnet_patch.setup_of(recording, None, STATED, {})
    magnet_patch.write_session(recording, path, setup)
    return [path]


def commands(bags: list[Path], out: Path) -> list[list[str]]:
    """Return the commands that model the file, with sensors as stated and as found."""
    return calibrations(bags[0], out)


def rows(folder: Path, bags: list[Path], out: Path) -> list[ReportRow]:
    """Return the errors of the field at blocks of poses that took no part."""
    before, after = (
        1e6 * figure(ran(out / kind, 'calibration.json'), 'heldout_flux_rmse_t')
        for kind in ('plain', 'full')
    )
    chosen = 'everything on the other blocks of poses; scored on the block left out'
    return [
        ReportRow(
            NAME, 'field at poses left out, RMSE', before, after, 'uT', chosen,
            special=SPECIAL_UT,
        )
    ]  # fmt: skip


RECIPE = Recipe(NAME, write_sessions, commands, rows, folder=magnet_patch.NAME)
