"""Holds measured fluxes of the sensors on a body, with the poses that another tracker gave it."""

from dataclasses import dataclass, replace

import numpy as np

from anser_ros.arrays import AnyArray, Array, Booleans, ComplexArray, Integers
from anser_ros.physics.pose_track import LONGEST_GAP_S, PoseTrack
from anser_ros.physics.sensor import SensorTable


@dataclass(frozen=True)
class Measurements:
    """Holds F frames of the S sensors on one body, with a flux for each of K emitters."""

    body: str  # name of the body; ``fg`` for reference sensors, whose pose is the identity
    sensors: SensorTable  # the sensors in the order of the second axis of the fluxes
    time: Array  # (F,), time since the session's first stamp on the clock of the fluxes, s
    # (F, S, K), complex, flux density along each sensor's axis, T; finite only where ``valid``
    flux: ComplexArray
    valid: Booleans  # (F, S), false where the value is missing, not finite or flagged
    # (F, S), flag bits of the flux messages (saturated 1, stale 2, dropped samples 4)
    flags: Integers
    position: Array  # (F, 3), origin of the body, m, frame fg; NaN where ``has_pose`` is False
    rotation: Array  # (F, 3, 3), rotation matrix from the body's frame to fg
    # (F,), whether the other instrument has a pose at the frame's time
    has_pose: Booleans
    # the stream of poses on the same time axis, for effects that shift the clocks
    track: PoseTrack | None = None
    session: str = ''  # whose frame the poses are in, and whose mount the body is on

    def __repr__(self) -> str:
        frames, sensors, emitters = self.flux.shape
        return f'Measurements({self.body}: {frames} frames, {sensors} coils, {emitters} emitters)'

    @property
    def usable(self) -> Booleans:
        """Return the mask (F, S) of the values that have a pose and are valid."""
        return np.asarray(self.valid & self.has_pose[:, None])

    @property
    def is_followed(self) -> bool:
        """Return whether the optical tracker followed the body, so that clocks can be compared."""
        if self.track is None or self.track.time.size < 2:
            return False
        return float(np.median(np.diff(self.track.time))) <= LONGEST_GAP_S

    def frames(self, rows: AnyArray | slice) -> 'Measurements':
        """Return the measurements of the frames given by index, mask or slice."""
        each = ('time', 'flux', 'valid', 'flags', 'position', 'rotation', 'has_pose')
        return replace(self, **{name: getattr(self, name)[rows] for name in each})

    def between(self, begin: float, end: float) -> 'Measurements':
        """Return the frames from a time to before another, s."""
        return self.frames((self.time >= begin) & (self.time < end))

    def with_track(self, track: PoseTrack) -> 'Measurements':
        """Return the measurements with the poses that another track has at their times."""
        position, rotation, has_pose = track.at(self.time)
        return replace(self, track=track, position=position, rotation=rotation, has_pose=has_pose)

    def sensors_only(self, rows: AnyArray) -> 'Measurements':
        """Return the measurements of the sensors given by index or mask."""
        each = {name: getattr(self, name)[:, rows] for name in ('flux', 'valid', 'flags')}
        return replace(self, sensors=self.sensors.select(rows), **each)

    def placed(self) -> tuple[Array, Array]:
        """Return the sensors' centres (m) and axes in fg, each of shape (F, S, 3)."""
        return self.sensors.placed(self.position, self.rotation)


def frame_power(flux: ComplexArray) -> Array:
    """Return the mean square of a phasor component in each frame of fluxes (F, S, K), T^2."""
    return np.asarray(np.nanmean(np.abs(flux) ** 2, axis=(1, 2)) / 2.0)
