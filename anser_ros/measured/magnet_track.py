"""The magnet's position and axis from one frame of readings, from a cold start.

A coarse grid before the patch with the axis solved linearly gives the start; Gauss-Newton with
the readings' covariance finishes it. No stated pose of the magnet is used anywhere.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from anser_ros.measured.magnet_fit import MagnetFit
from anser_ros.measured.magnet_model import Recording
from anser_ros.physics.dipole import field_basis

Array = NDArray[np.float64]

REACH_M = 0.06
"""Half size of the grid of start positions, m."""
NEAREST_M = 0.012
"""Smallest distance of a start position from a sensor, m: the magnet is about as large."""
STEP_M = 0.008
"""Distance of neighbouring start positions, m."""
POSITION_SCALE_M = 1e-3
"""Unit of the position in the least-squares search, m."""
ANGLE_SCALE_RAD = 1e-2
"""Unit of the tilt in the least-squares search, rad."""


@dataclass(frozen=True)
class ReadingError:
    """Covariance of a sensor's reading: white noise, and a gain that may have changed since.

    Attributes
    ----------
    noise_t : float
        T, each axis.
    gain : float
        Relative standard deviation, the same for the three axes of a sensor.
    """

    noise_t: float
    gain: float

    def whitener(self, reading: Array) -> Array:
        """Inverse Cholesky factors for readings (S, 3), shape (S, 3, 3)."""
        along = (self.gain * reading)[:, :, None]
        covariance = self.noise_t**2 * np.eye(3) + along @ along.swapaxes(1, 2)
        return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))


@dataclass(frozen=True)
class MagnetTrack:
    """Tracked poses: position (F, 3) in m and axis (F, 3), in the frame of the sensors."""

    position_m: Array
    axis: Array

    def errors(self, recording: Recording) -> tuple[Array, Array]:
        """Distance (m) and angle (rad) of every frame to the stated pose, each (F,)."""
        offset = np.linalg.norm(self.position_m - recording.magnet_m, axis=1)
        stated = recording.magnet_rotation[:, :, 2]
        cross = np.linalg.norm(np.cross(self.axis, stated), axis=1)
        angle = np.arctan2(cross, np.einsum('fi,fi->f', self.axis, stated))
        return offset, angle


def _grid(place: Array) -> Array:
    """Points around the sensors' positions (S, 3), none too close to one."""
    middle = place.mean(axis=0)
    line = np.arange(-REACH_M, REACH_M + 1e-9, STEP_M)
    points = np.stack(np.meshgrid(line, line, line, indexing='ij'), axis=-1).reshape(-1, 3)
    points = points + middle
    gap = np.linalg.norm(points[:, None] - place[None], axis=2).min(axis=1)
    return np.asarray(points[gap > NEAREST_M])


class MagnetTracker:
    """Tracks a magnet before one array.

    Parameters
    ----------
    model : MagnetFit
        Strength and effects, learnt elsewhere.
    error : ReadingError
    sensor_m : ndarray, shape (S, 3)
    sensor_rotation : ndarray, shape (S, 3, 3)
    """

    def __init__(
        self, model: MagnetFit, error: ReadingError, sensor_m: Array, sensor_rotation: Array
    ) -> None:
        self._model, self._error = model, error
        self._place, self._turn = sensor_m, sensor_rotation
        self._grid = _grid(sensor_m)
        count, sensors = len(self._grid), len(sensor_m)
        unit = np.stack(
            [
                field_basis(sensor_m, self._grid, np.broadcast_to(axis, self._grid.shape))
                for axis in np.eye(3)
            ],
            axis=3,
        )
        basis = unit.transpose(1, 0, 2, 3).reshape(count, 3 * sensors, 3)
        weight = np.linalg.norm(basis, axis=(1, 2))[:, None, None]
        self._range, _ = np.linalg.qr(basis / weight)

    def move(self, sensor_m: Array, sensor_rotation: Array) -> None:
        """The sensors' poses of the frame to come; the grid of starts stays where it is."""
        self._place, self._turn = sensor_m, sensor_rotation

    def start(self, reading: Array) -> tuple[Array, Array]:
        """Grid point and axis whose dipole field comes closest to readings (S, 3)."""
        world = np.einsum('sij,sj->si', self._turn, reading).ravel()
        share = np.linalg.norm(np.einsum('gij,i->gj', self._range, world), axis=1)
        point = self._grid[int(np.argmax(share))]
        basis = np.stack(
            [field_basis(self._place, point[None], axis[None])[:, 0] for axis in np.eye(3)],
            axis=2,
        ).reshape(-1, 3)
        axis = np.linalg.lstsq(basis, world, rcond=None)[0]
        return point, np.asarray(axis / np.linalg.norm(axis))

    def track(self, reading: Array) -> tuple[Array, Array]:
        """Position (m) and axis of one frame's readings (S, 3)."""
        point, axis = self.start(reading)
        turn = Rotation.align_vectors(axis[None], np.array([[0.0, 0.0, 1.0]]))[0].as_matrix()
        white = self._error.whitener(reading)

        def pose(x: Array) -> tuple[Array, Array]:
            tilt = Rotation.from_rotvec([ANGLE_SCALE_RAD * x[3], ANGLE_SCALE_RAD * x[4], 0.0])
            return point + POSITION_SCALE_M * x[:3], turn @ tilt.as_matrix()

        def misfit(x: Array) -> Array:
            place, rotation = pose(x)
            frame = Recording(
                '',
                reading[None],
                self._place[None],
                self._turn[None],
                place[None],
                rotation[None],
                np.zeros(1),
            )
            left = self._model.predict(frame)[0] - reading
            return np.asarray(np.einsum('sij,sj->si', white, left).ravel())

        solution = least_squares(misfit, np.zeros(5), method='lm')
        place, rotation = pose(solution.x)
        return place, rotation[:, 2]


def track(recording: Recording, model: MagnetFit, error: ReadingError) -> MagnetTrack:
    """Track every frame; the sensors' stated poses are those of the first frame's grid."""
    tracker = MagnetTracker(model, error, recording.sensor_m[0], recording.sensor_rotation[0])
    poses = []
    for frame, reading in enumerate(recording.field_t):
        tracker.move(recording.sensor_m[frame], recording.sensor_rotation[frame])
        poses.append(tracker.track(reading))
    return MagnetTrack(np.array([p for p, _ in poses]), np.array([a for _, a in poses]))
