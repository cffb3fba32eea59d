"""Holds measured fluxes of the sensors on a body, with the poses that another tracker gave it."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.physics.pose_track import LONGEST_GAP_S, PoseTrack
from anser_ros.physics.sensor import SensorTable

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class Measurements:
    """Holds F frames of the S sensors on one body, with a flux for each of K emitters.

    Attributes
    ----------
    body : str
        Name of the body; ``fg`` for reference sensors, whose pose is the identity.
    sensors : SensorTable
        The sensors in the order of the second axis of the fluxes.
    time : ndarray, shape (F,)
        Time since the session's first stamp on the clock of the fluxes, s.
    flux : ndarray, shape (F, S, K), complex
        Flux density along each sensor's axis, T; finite only where ``valid``.
    valid : ndarray of bool, shape (F, S)
        False where the value is missing, not finite or flagged.
    flags : ndarray of int, shape (F, S)
        Flag bits of the flux messages (saturated 1, stale 2, dropped samples 4).
    position : ndarray, shape (F, 3)
        Origin of the body, m, frame fg; NaN where ``has_pose`` is False.
    rotation : ndarray, shape (F, 3, 3)
        Rotation matrix from the body's frame to fg.
    has_pose : ndarray of bool, shape (F,)
        Whether the other instrument has a pose at the frame's time.
    track : PoseTrack or None
        The stream of poses on the same time axis, for effects that shift the clocks.
    """

    body: str
    sensors: SensorTable
    time: Array
    flux: ComplexArray
    valid: NDArray[np.bool_]
    flags: NDArray[np.int64]
    position: Array
    rotation: Array
    has_pose: NDArray[np.bool_]
    track: PoseTrack | None = None

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Return the mask (F, S) of the values that have a pose and are valid."""
        return np.asarray(self.valid & self.has_pose[:, None])

    @property
    def is_followed(self) -> bool:
        """Return whether the optical tracker followed the body, so that clocks can be compared.

        A recording with one pose for each point of rest contains no information about clocks, and
        each place once.
        """
        if self.track is None or self.track.time.size < 2:
            return False
        return float(np.median(np.diff(self.track.time))) <= LONGEST_GAP_S

    def frames(self, rows: NDArray[np.generic] | slice) -> 'Measurements':
        """Return the measurements of the frames given by index, mask or slice."""
        return replace(
            self,
            time=self.time[rows],
            flux=self.flux[rows],
            valid=self.valid[rows],
            flags=self.flags[rows],
            position=self.position[rows],
            rotation=self.rotation[rows],
            has_pose=self.has_pose[rows],
        )

    def sensors_only(self, rows: NDArray[np.generic]) -> 'Measurements':
        """Return the measurements of the sensors given by index or mask."""
        return replace(
            self,
            sensors=self.sensors.select(rows),
            flux=self.flux[:, rows],
            valid=self.valid[:, rows],
            flags=self.flags[:, rows],
        )

    def placed(self) -> tuple[Array, Array]:
        """Return the sensors' centres (m) and axes in fg, each of shape (F, S, 3)."""
        return self.sensors.placed(self.position, self.rotation)
