"""Fills the optical body's path between its poses: smooth, with velocity, or behind a low pass."""

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from anser_ros.errors import DiagnosisError
from anser_ros.physics.pose_track import LONGEST_GAP_S, PoseTrack

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

FEWEST_PATH_POSES = 4
"""Poses without which there is no path: a cubic piece needs the poses about it."""
MEDIAN_GAPS = 2.5
"""Gap in median intervals over which a slow reference is interpolated: one pose may be lost."""
STEPS_A_TAU = 20
"""Steps of a filter's grid in its time constant. Straight lines between them round off motions;
eight make the time constant too short by three of its standard deviations."""
SMALLEST_STEP_S = 0.002  # grid of a filter, s: a hand moves by 0.2 mm in it


@dataclass(frozen=True, eq=False)
class OpticalPath:
    """Describes a body's path: cubic pieces through its poses, a parabola's slopes at each."""

    knots: Array  # (m,), times of the poses, s
    longest_gap: float  # gap over which nothing is interpolated, s
    # Whether all is at rest whenever there is a pose: what differs is noise and no velocity.
    is_at_rest: bool
    _spline: CubicHermiteSpline
    source: 'OpticalPath | None' = None  # of a filtered path, known where this is known

    @classmethod
    def through(cls, track: PoseTrack, is_at_rest: bool = False) -> 'OpticalPath':
        """Return the path through a track's poses.

        Raises `DiagnosisError` when there are too few poses.
        """
        time = track.time
        if time.size < FEWEST_PATH_POSES:
            raise DiagnosisError(
                f'the reference has {time.size} different poses, a path needs {FEWEST_PATH_POSES}'
            )
        turn = track.quaternion.copy()
        flips = np.sign(np.einsum('ij,ij->i', turn[1:], turn[:-1]))
        turn[1:] *= np.cumprod(np.where(flips < 0, -1.0, 1.0))[:, None]
        values = np.concatenate([track.position, turn], axis=1)
        gap = max(LONGEST_GAP_S, MEDIAN_GAPS * float(np.median(np.diff(time))))
        # Nothing is known of the motion in a gap: each side of it is a path of its own.
        slopes = np.zeros_like(values)
        edges = np.concatenate([[0], np.flatnonzero(np.diff(time) > gap) + 1, [time.size]])
        for a, b in pairwise(edges.tolist()):
            if b - a > 1:
                slopes[a:b] = np.gradient(values[a:b], time[a:b], axis=0)
        return cls(time, gap, is_at_rest, CubicHermiteSpline(time, values, slopes))

    def at(self, time: Array) -> tuple[Array, Array, Array, Mask]:
        """Return positions (n, 3), rotations (n, 3, 3), velocities (n, 6) in the optical frame,
        validity.

        Times without a valid path get the nearest pose, at rest.
        """
        inside, valid = np.clip(time, self.knots[0], self.knots[-1]), self._valid(time)
        values, slopes = self._spline(inside), self._spline(inside, 1)
        norm = np.maximum(np.linalg.norm(values[:, 3:], axis=1, keepdims=True), 1e-6)
        turn, rate = values[:, 3:] / norm, slopes[:, 3:] / norm
        velocity = np.zeros((time.size, 6))
        velocity[:, :3] = slopes[:, :3]
        vector, scalar, d_vector, d_scalar = turn[:, :3], turn[:, 3:], rate[:, :3], rate[:, 3:]
        velocity[:, 3:] = 2 * (d_vector * scalar - d_scalar * vector - np.cross(d_vector, vector))
        velocity[~valid | self.is_at_rest] = 0.0
        matrices = np.asarray(Rotation.from_quat(turn).as_matrix()).reshape(-1, 3, 3)
        if self.source is not None:
            valid = valid & self.source._valid(time)
        return values[:, :3], matrices, velocity, valid

    def _valid(self, time: Array) -> Mask:
        """Where it is interpolated: between poses that are near each other."""
        right = np.clip(np.searchsorted(self.knots, time, side='left'), 1, self.knots.size - 1)
        inside = (time >= self.knots[0]) & (time <= self.knots[-1])
        near = self.knots[right] - self.knots[right - 1] <= self.longest_gap
        return np.asarray(inside & near)

    def jitter(self, lever: Array) -> float:
        """Return the rms, m a coordinate, by which a point (3,) of the body leaves its own course.

        The course is the cubic through the two poses before and the two after; a hand's motion
        leaves it by some micrometres.
        """
        place, turn, _, _ = self.at(self.knots)
        point, time = place + turn @ lever, self.knots
        four = np.arange(time.size - 4) + np.array([[0], [1], [3], [4]])
        near, about = time[four] - time[2:-2], point[four]
        weight = np.stack([_share_at_zero(near, k) for k in range(4)])
        off = point[2:-2] - np.einsum('kn,kni->ni', weight, about)
        whole = near[3] - near[0] < 4 * self.longest_gap
        size = off[whole] / np.sqrt(1 + np.sum(weight**2, axis=0))[whole, None]
        return float(np.sqrt(np.mean(size**2))) if size.size else 0.0

    def filtered(self, tau: float, two_sided: bool = False) -> 'OpticalPath':
        """Return the path behind a first-order low pass with a time constant, s.

        Two-sided, it looks as far ahead as back, with the same width and no delay.
        """
        return _behind(self, tau, two_sided)


def _share_at_zero(nodes: Array, k: int) -> Array:
    """Lagrange's weight of node k of nodes (4, n) at zero."""
    others = [j for j in range(4) if j != k]
    return np.asarray(np.prod([-nodes[j] / (nodes[k] - nodes[j]) for j in others], axis=0))


@lru_cache(maxsize=8)
def _behind(path: OpticalPath, tau: float, two_sided: bool) -> OpticalPath:
    """Return what `OpticalPath.filtered` does; a fit asks again and again for the same filter."""
    tau = tau / np.sqrt(2) if two_sided else tau
    step = max(SMALLEST_STEP_S, tau / STEPS_A_TAU)
    grid = np.arange(path.knots[0], path.knots[-1] + step, step)
    values = path._spline(np.minimum(grid, path.knots[-1]))
    keep = float(np.exp(-step / tau))
    # A straight line between samples goes through the filter exactly.
    late = (1 - keep) * tau / step
    passed = values
    for way in (1, -1) if two_sided else (1,):
        turned = passed[::way]
        driven = lfilter([1 - late, late - keep], [1.0, -keep], turned - turned[0], axis=0)
        passed = (driven + turned[0])[::way]
    spline = CubicHermiteSpline(grid, passed, np.gradient(passed, grid, axis=0))
    return OpticalPath(grid, path.longest_gap, path.is_at_rest, spline, path)
