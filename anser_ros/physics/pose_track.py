"""A body's poses over time, from a tracker with its own clock and rate."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PoseTrack:
    """M poses by ascending time.

    Attributes
    ----------
    time : ndarray, shape (M,)
        s, ascending, on the clock of the poses' own stamps.
    position : ndarray, shape (M, 3)
        m, frame fg.
    quaternion : ndarray, shape (M, 4)
        x y z w.
    """

    time: Array
    position: Array
    quaternion: Array

    def at(self, time: Array, longest_gap: float) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Poses at other times: positions by linear interpolation, rotations by slerp.

        Parameters
        ----------
        time : ndarray, shape (F,)
            s.
        longest_gap : float
            A time farther than this (s) from the poses on both sides has no pose.

        Returns
        -------
        position : ndarray, shape (F, 3)
        rotation : ndarray, shape (F, 3, 3)
        valid : ndarray of bool, shape (F,)
            False where the track doesn't reach or has a gap; the pose there is NaN.
        """
        position = np.full((time.size, 3), np.nan)
        rotation = np.full((time.size, 3, 3), np.nan)
        right = np.clip(np.searchsorted(self.time, time, side='left'), 0, self.time.size - 1)
        left = np.clip(right - 1, 0, None)
        exact = self.time[right] == time
        bracketed = (self.time[left] <= time) & (time <= self.time[right])
        valid = exact | (bracketed & (self.time[right] - self.time[left] <= longest_gap))
        if valid.any():
            inside = time[valid]
            for axis in range(3):
                position[valid, axis] = np.interp(inside, self.time, self.position[:, axis])
            if self.time.size == 1:
                rotation[valid] = Rotation.from_quat(self.quaternion[0]).as_matrix()
            else:
                slerp = Slerp(self.time, Rotation.from_quat(self.quaternion))
                rotation[valid] = slerp(inside).as_matrix()
        return position, rotation, valid
