"""Holds poses of one body over time, as a tracker with its own clock and rate reports them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LONGEST_GAP_S = 0.25
"""Longest gap between two optical poses, s, over which a pose is interpolated. A tracker at 60 Hz
that is silent for longer did not see the tool, whose motion meanwhile is not known; a hand moves
by centimetres in that time."""

VELOCITY_STEP_S = 0.02
"""Half the time, s, over which a velocity is taken: much shorter multiplies the jitter of the
poses, much longer smooths away how a hand accelerates."""


@dataclass(frozen=True)
class PoseTrack:
    """Holds a sequence of M poses of one body in ascending order of time.

    Attributes
    ----------
    time : ndarray, shape (M,)
        Stamps of the poses on the clock that gave them, s, ascending.
    position : ndarray, shape (M, 3)
        Origin of the body, m, frame fg.
    quaternion : ndarray, shape (M, 4)
        Rotation from the body's frame to fg, in the order x y z w.
    """

    time: Array
    position: Array
    quaternion: Array

    def at(
        self, time: Array, longest_gap: float = LONGEST_GAP_S
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Interpolate the poses at other times.

        Positions are interpolated linearly, rotations by spherical linear interpolation.

        Parameters
        ----------
        time : ndarray, shape (F,)
            Times on the clock of the track, s.
        longest_gap : float, optional
            Between two poses that are farther apart than this (s) nothing is interpolated.

        Returns
        -------
        position : ndarray, shape (F, 3)
            Origin of the body, m, frame fg.
        rotation : ndarray, shape (F, 3, 3)
            Rotation matrix from the body's frame to fg.
        valid : ndarray of bool, shape (F,)
            False before the first pose, after the last one and in gaps; the pose there is NaN.
        """
        position = np.full((time.size, 3), np.nan)
        rotation = np.full((time.size, 3, 3), np.nan)
        right = np.clip(np.searchsorted(self.time, time, side='left'), 0, self.time.size - 1)
        left = np.clip(right - 1, 0, None)
        exact = self.time[right] == time
        bracketed = (self.time[left] <= time) & (time <= self.time[right])
        valid = exact | (bracketed & (self.time[right] - self.time[left] <= longest_gap))
        if valid.any():
            # Loaded here, as each start of a node would pay for it that interpolates no poses.
            from scipy.spatial.transform import Rotation, Slerp

            inside = time[valid]
            for axis in range(3):
                position[valid, axis] = np.interp(inside, self.time, self.position[:, axis])
            if self.time.size == 1:
                rotation[valid] = Rotation.from_quat(self.quaternion[0]).as_matrix()
            else:
                slerp = Slerp(self.time, Rotation.from_quat(self.quaternion))
                rotation[valid] = slerp(inside).as_matrix()
        return position, rotation, valid

    def velocity(self, time: Array) -> Array:
        """Return the velocity (m/s) and angular velocity (rad/s) at some times, frame fg, shape
        (F, 6).

        Each is the mean over `VELOCITY_STEP_S` before and after, as far as the track goes.

        Parameters
        ----------
        time : ndarray, shape (F,)
            Times on the clock of the track, s.
        """
        low = np.clip(time - VELOCITY_STEP_S, self.time[0], self.time[-1])
        high = np.clip(time + VELOCITY_STEP_S, self.time[0], self.time[-1])
        before, turned_before, _ = self.at(low, np.inf)
        after, turned_after, _ = self.at(high, np.inf)
        span = np.maximum(high - low, 1e-9)[:, None]
        turn = turned_after @ turned_before.transpose(0, 2, 1)
        spin = 0.5 * np.stack(
            [
                turn[:, 2, 1] - turn[:, 1, 2],
                turn[:, 0, 2] - turn[:, 2, 0],
                turn[:, 1, 0] - turn[:, 0, 1],
            ],
            axis=1,
        )
        return np.concatenate([after - before, spin], axis=1) / span
