"""Computes where moving metal is at each time: straight from rest to rest, or along a spline."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

Array = NDArray[np.float64]

SHORTEST = 0.2
"""Shortest time (s) that a straight way may take: a hand is no faster."""
FINE_STEP_S = 0.05
"""Step (s) in which the length of a way is summed up, a quarter of the shortest way."""
NODES, NODES_PER_KNOT = 41, 6
"""Nodes on a path, in which fields are found; between them they are interpolated."""
KEPT_SPLINES = 64
"""Sets of spline weights that are kept, 0.2 MB each, for a few paths fitted side by side."""
NEGLIGIBLE_WAY = 0.02
"""Share (0 to 1) of a way that counts as not yet begun, or as over: 2 to 5 mm of a hand's way."""


@dataclass(frozen=True)
class StraightPath:
    """Leads straight on; its parameters are start and end (m), start and end time (s), ease.

    The centre rests, goes straight from start to end between the two times, and rests. An ease of
    0 is constant speed, of 1 a smooth step.
    """

    count: int = 9
    knots: tuple[float, ...] = ()

    def progress(self, theta: Array, time: Array) -> Array:
        """Return the share of the way made at each time, 0 to 1."""
        u = np.clip((time - theta[6]) / max(float(theta[7] - theta[6]), SHORTEST), 0.0, 1.0)
        return np.asarray(u + theta[8] * u * (1 - u) * (2 * u - 1))

    def centre(self, theta: Array, time: Array) -> Array:
        """Return the body's centre at each time, shape (F, 3), m."""
        way = theta[3:6] - theta[:3]
        return np.asarray(theta[:3] + self.progress(theta, time)[:, None] * way)

    def rates(self, theta: Array, time: Array) -> Array:
        """Return the derivative of the centre by the parameters, (F, 3, 9)."""
        span = max(float(theta[7] - theta[6]), SHORTEST)
        u = np.clip((time - theta[6]) / span, 0.0, 1.0)
        going = ((u > 0) & (u < 1)).astype(np.float64)
        speed = going * (1 + theta[8] * (6 * u - 6 * u**2 - 1)) / span
        share = self.progress(theta, time)
        out = np.zeros((time.size, 3, 9))
        for axis in range(3):
            out[:, axis, axis], out[:, axis, 3 + axis] = 1 - share, share
        scalar = np.stack([-(1 - u) * speed, -u * speed, u * (1 - u) * (2 * u - 1)], axis=1)
        out[:, :, 6:9] = (theta[3:6] - theta[:3])[None, :, None] * scalar[:, None, :]
        return out

    def nodes(self, theta: Array, time: Array) -> tuple[Array, Array, Array]:
        """Return shares of the way, the places there, m, and the share made at each time."""
        way = theta[3:6] - theta[:3]
        share = np.linspace(0.0, 1.0, NODES)
        made = np.clip(self.progress(theta, time), 0.0, 1.0)
        return share, theta[:3] + share[:, None] * way, made

    def prior(self) -> Array:
        """Expect places within decimetres, times within tens of seconds, and any ease."""
        return np.concatenate([np.full(6, 0.1), np.full(2, 10.0), [0.5]])

    def bounded(self, theta: Array) -> Array:
        """Put the end after the start, and keep the body from going back."""
        out = theta.copy()
        out[7] = max(out[7], out[6] + SHORTEST)
        out[8] = np.clip(out[8], -0.5, 1.0)
        return out


@dataclass(frozen=True)
class FreePath:
    """Leads along a natural spline; its parameters are the centre (m) at each knot."""

    knots: tuple[float, ...]  # s, ascending, at least three

    @property
    def count(self) -> int:
        """Return three parameters for each knot of the path."""
        return 3 * len(self.knots)

    def _weights(self, time: Array) -> Array:
        """Share of each knot in the centre at each time, (F, n)."""
        knots = np.array(self.knots)
        return spline_weights(knots, np.clip(time, knots[0], knots[-1]), 'natural')

    def centre(self, theta: Array, time: Array) -> Array:
        """Return the body's centre at each time, shape (F, 3), m."""
        return np.asarray(self._weights(time) @ theta.reshape(-1, 3))

    def rates(self, theta: Array, time: Array) -> Array:
        """Return the derivative of the centre by the parameters, (F, 3, count)."""
        weights = self._weights(time)
        rates = weights[:, None, :, None] * np.eye(3)[None, :, None, :]
        return np.asarray(rates.reshape(time.size, 3, -1))

    def nodes(self, theta: Array, time: Array) -> tuple[Array, Array, Array]:
        """Use the time as coordinate: a free path may turn back."""
        count = NODES_PER_KNOT * (len(self.knots) - 1) + 1
        times = np.linspace(self.knots[0], self.knots[-1], count)
        return times, self.centre(theta, times), np.clip(time, times[0], times[-1])

    def prior(self) -> Array:
        """Return a spread of 0.1 m: the path stays within decimetres of its start value."""
        return np.full(self.count, 0.1)

    def bounded(self, theta: Array) -> Array:
        """Return the parameters unchanged, as a free path has no bounds."""
        return theta

    @staticmethod
    def through(knots: Array, time: Array, centres: Array) -> tuple['FreePath', Array]:
        """Return the path nearest to a course (F, 3) at ascending times, and its parameters."""
        path = FreePath(tuple(float(k) for k in knots))
        weights = path._weights(time)
        bend = 1e-3 * np.diff(np.eye(len(knots)), 2, axis=0)
        normal = weights.T @ weights + bend.T @ bend
        course = np.linalg.solve(normal, weights.T @ centres)
        return path, np.asarray(course.ravel(), dtype=np.float64)


MetalPath = StraightPath | FreePath
"""Leads along ``count`` parameters, through ``knots`` (s) where it is free."""


def spline_weights(nodes: Array, at: Array, ends: str) -> Array:
    """Return what each node's value weighs in a cubic spline's values, shape (F, N); to be read.

    ``nodes`` (N,) ascend, values are wanted ``at`` (F,), ``ends`` is scipy's ``bc_type``. Many
    splines through the same nodes are wanted at the same places: the weights are kept for a while.
    """
    return _spline_weights(nodes.tobytes(), at.tobytes(), ends)


@lru_cache(maxsize=KEPT_SPLINES)
def _spline_weights(nodes: bytes, at: bytes, ends: str) -> Array:
    grid = np.frombuffer(nodes)
    weights = np.asarray(CubicSpline(grid, np.eye(grid.size), bc_type=ends)(np.frombuffer(at)))
    weights.flags.writeable = False
    return weights


def distance_travelled(path: MetalPath, theta: Array, time: Array) -> tuple[Array, Array]:
    """Return fine times over those given, and the way made since the first, (T,) each, s and m."""
    count = max(3, int((time.max() - time.min()) / FINE_STEP_S) + 1)
    fine = np.linspace(time.min(), time.max(), count)
    steps = np.linalg.norm(np.diff(path.centre(theta, fine), axis=0), axis=1)
    return fine, np.concatenate([[0.0], np.cumsum(steps)])


def moving_times(path: MetalPath, theta: Array, time: Array) -> tuple[float, float]:
    """Return when the body begins and ends its way, s."""
    if not path.knots:
        return float(theta[6]), float(theta[7])
    fine, way = distance_travelled(path, theta, time)
    share = way / max(float(way[-1]), 1e-9)
    first = int(np.searchsorted(share, NEGLIGIBLE_WAY))
    last = int(np.searchsorted(share, 1 - NEGLIGIBLE_WAY))
    return float(fine[max(first - 1, 0)]), float(fine[min(last, fine.size - 1)])
