"""Holds poses of one body over time, as a tracker with its own clock and rate reports them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from anser_ros.arrays import Array, Booleans, Integers

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation


LONGEST_GAP_S = 0.25
"""Longest gap, s, over which optical poses are interpolated: a hand moves centimetres in it."""

VELOCITY_STEP_S = 0.02
"""Half the time, s, over which a velocity is taken, between jitter and a hand's acceleration."""

REACH = (2, 3, 4)
"""Poses before and after an interval by which its curvature is determined: of three estimates the
middle one counts, since a reflected pose is in one of them only."""


@dataclass(frozen=True)
class PoseTrack:
    """Holds a sequence of M poses of one body in ascending order of time."""

    time: Array  # (M,), stamps of the poses on the clock that gave them, s, ascending
    position: Array  # (M, 3), origin of the body, m, frame fg
    quaternion: Array  # (M, 4), rotation from the body's frame to fg, in the order x y z w

    @cached_property
    def _aligned(self) -> Array:
        """Quaternions (M, 4) with signs by which each is near the one before."""
        near = np.einsum('mi,mi->m', self.quaternion[1:], self.quaternion[:-1]) >= 0.0
        sign = np.cumprod(np.concatenate([[1.0], np.where(near, 1.0, -1.0)]))
        return np.asarray(self.quaternion * sign[:, None])

    @cached_property
    def _slerp(self) -> Callable[[Array], Rotation]:
        """The rotations between the samples along great arcs."""
        from scipy.spatial.transform import Rotation, Slerp

        slerp: Callable[[Array], Rotation] = Slerp(self.time, Rotation.from_quat(self.quaternion))
        return slerp

    def at(self, time: Array, longest_gap: float = LONGEST_GAP_S) -> tuple[Array, Array, Booleans]:
        """Interpolate the poses at other times.

        Positions are interpolated along the chord between two poses, rotations along the great
        arc, and both are curved as the velocity changes there: a hand's path lies outside its
        chords, and a field that was fitted along chords is too small by a part in ten thousand. If
        a track is too slow or too short to determine its curvature, the chord is used.

        Returns positions (F, 3), m, rotations (F, 3, 3) from the body's frame to fg, and where
        they are valid (F,): not before the first pose, after the last one, and in gaps longer than
        ``longest_gap``, s. The pose there is NaN.
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
            from scipy.spatial.transform import Rotation

            inside, bent = time[valid], _Bend(self.time, left[valid], right[valid], time[valid])
            for axis in range(3):
                position[valid, axis] = np.interp(inside, self.time, self.position[:, axis])
            position[valid] += bent.of(self.position)
            if self.time.size == 1:
                rotation[valid] = Rotation.from_quat(self.quaternion[0]).as_matrix()
            else:
                samples, turned = self._aligned, self._slerp(inside).as_quat()
                same = np.einsum('fi,fi->f', turned, samples[left[valid]]) >= 0.0
                turned = np.where(same[:, None], turned, -turned) + bent.of(samples)
                rotation[valid] = Rotation.from_quat(turned).as_matrix()
        return position, rotation, valid

    def velocity(self, time: Array) -> Array:
        """Return velocity (m/s) and angular velocity (rad/s) at times (F,), s; (F, 6), frame fg.

        Each is the mean over `VELOCITY_STEP_S` before and after, as far as the track goes.
        """
        low = np.clip(time - VELOCITY_STEP_S, self.time[0], self.time[-1])
        high = np.clip(time + VELOCITY_STEP_S, self.time[0], self.time[-1])
        before, turned_before, _ = self.at(low, np.inf)
        after, turned_after, _ = self.at(high, np.inf)
        span = np.maximum(high - low, 1e-9)[:, None]
        turn = turned_after @ turned_before.transpose(0, 2, 1)
        skew = turn - turn.transpose(0, 2, 1)
        spin = 0.5 * np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
        return np.concatenate([after - before, spin], axis=1) / span


class _Bend:
    """How far a path lies beside the chords between its samples, by its acceleration there.

    Over an interval h, at the fraction u of the way, that is ``-u (1 - u) h^2 / 2`` times the
    acceleration, which follows from the difference between the velocities after and before the
    interval. The samples have times (M,), s; ``left`` and ``right`` (F,) are those before and
    after each of the times ``at``.
    """

    def __init__(self, time: Array, left: Integers, right: Integers, at: Array) -> None:
        self.time, last = time, time.size - 1
        first, final = np.maximum(left - REACH[-1], 0), np.minimum(right + REACH[-1], last)
        is_whole = (left - first == REACH[-1]) & (final - right == REACH[-1]) & (left < right)
        self.rows = np.flatnonzero(is_whole & (time[final] - time[first] <= LONGEST_GAP_S))
        self.left, self.right, self.count = left[self.rows], right[self.rows], at.size
        at, begin, end = at[self.rows], time[self.left], time[self.right]
        self.factor = -0.5 * (at - begin) * (end - at)

    def of(self, samples: Array) -> Array:
        """Return what to add to samples (M, D) interpolated along chords, shape (F, D)."""
        out = np.zeros((self.count, samples.shape[1]))
        middle = np.median([self._acceleration(samples, reach) for reach in REACH], axis=0)
        out[self.rows] = self.factor[:, None] * middle
        return out

    def _acceleration(self, samples: Array, reach: int) -> Array:
        before, after = self.left - reach, self.right + reach
        t0, t1, t2, t3 = (self.time[i] for i in (before, self.left, self.right, after))
        s0, s1, s2, s3 = (samples[i] for i in (before, self.left, self.right, after))
        change = (s3 - s2) / (t3 - t2)[:, None] - (s1 - s0) / (t1 - t0)[:, None]
        return np.asarray(change / ((t3 + t2 - t1 - t0) / 2.0)[:, None])
