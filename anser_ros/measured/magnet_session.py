"""Sessions of the magnet data: the magnet is the field generator, the patch the tool.

By reciprocity the layout of sessions fits as it stands: frame `fg` is the magnet's own, its one
emitter is a constant dipole (written as a tone of 1 Hz, since a tone is asked for; all phasors are
real), and every axis of every sensor is a tool sensor of the rigid body `patch`.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from anser_ros.measured.magnet_model import Recording
from anser_ros.measured.magnet_patch import HALF_LENGTH_M, RADIUS_M, file_names, load
from anser_ros.measured.session_file import SECOND_NS, vector, write_frames
from anser_ros.wire.setup import Coil, Emitter, SensorSpec, Setup

Array = NDArray[np.float64]

BODY = 'patch'
AXES = 'xyz'
UPWARDS = np.diag([1.0, -1.0, -1.0])
"""Turns the magnet's frame so that the patch is above it, as tools are above a board."""
VOLUME = ((-0.06, -0.06, 0.01), (0.06, 0.06, 0.08))
"""Where the patch may be, m."""
STATED = {'flux_noise_t': 3e-6, 'optical_position_m': 2e-4, 'optical_rotation_rad': 8e-3}
"""Noise of the magnetometers and jitter of the optical system, as this setup states them."""


def patch_in_fg(recording: Recording) -> tuple[Array, Array]:
    """Pose of the patch in the magnet's frame: rotations (F, 3, 3), positions (F, 3) in m.

    The patch's own frame has its origin at the middle of the sensors and the optical axes.
    """
    middle = recording.sensor_m.mean(axis=1)
    turn = UPWARDS @ recording.magnet_rotation.swapaxes(1, 2)
    return turn, np.einsum('fij,fj->fi', turn, middle - recording.magnet_m)


def setup_of(recording: Recording) -> Setup:
    """One emitter, three channels a sensor, as the first frame states them."""
    place = recording.sensor_m[0] - recording.sensor_m[0].mean(axis=0)
    turn = recording.sensor_rotation[0]
    sensors = tuple(
        SensorSpec(
            3 * k + axis,
            f'{BODY}/s{k + 1}/{AXES[axis]}',
            BODY,
            vector(place[k]),
            vector(turn[k, :, axis] / np.linalg.norm(turn[k, :, axis])),
            0.0,
        )
        for k in range(len(place))
        for axis in range(3)
    )
    geometry = {'radius_m': RADIUS_M, 'half_length_m': HALF_LENGTH_M}
    emitter = Emitter('cylinder_magnet', geometry, (Coil('magnet', (0.0, 0.0, 0.0), 0.0, 1.0),))
    rate = 1.0 / float(np.median(np.diff(recording.stamp_s)))
    return Setup('fg', rate, emitter, sensors, VOLUME, STATED)


def write_session(recording: Recording, path: Path) -> None:
    """Write one recording as an MCAP session.

    Raises
    ------
    BagError
        When the file exists already.
    """
    turn, place = patch_in_fg(recording)
    stamps = np.round(recording.stamp_s * SECOND_NS).astype(np.int64).tolist()
    flux = recording.field_t.reshape(len(stamps), -1, 1).astype(np.complex128)
    quaternion = Rotation.from_matrix(turn).as_quat()
    write_frames(path, setup_of(recording), stamps, flux, {BODY: (place, quaternion)})


def write_sessions(folder: Path, into: Path) -> list[Path]:
    """Every file of poses as a session; the files written."""
    into.mkdir(parents=True, exist_ok=True)
    out = []
    for name in file_names(folder):
        path = into / f'magnet_{name}.mcap'
        write_session(load(folder, name), path)
        out.append(path)
    return out
