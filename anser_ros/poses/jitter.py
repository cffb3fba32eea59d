"""Measures the jitter of a sensor's poses by what differs between neighbours."""

import numpy as np
from numpy.typing import NDArray

from anser_ros.poses.effect import Sensing
from anser_ros.poses.problem import PoseState

Array = NDArray[np.float64]

NEAR_S, NEAR_STEPS = 0.3, 3.0
"""Poses that are nearer in time, s or usual intervals, differ by noise and not by place."""


def jitter(sensing: Sensing) -> tuple[Array, Array]:
    """Return squared noise (n,) of poses beside near neighbours, and distances (n, 3).

    Squares are m^2, a coordinate; the distances, m, are those of the pose before, of the pose and
    of the one after it. Second differences of the residual across the velocity, so that neither a
    slow course nor an error of the stamps is in it.
    """
    rows = np.flatnonzero(sensing.used)
    time, velocity = sensing.view.time[rows], sensing.view.velocity[rows, :3]
    residual = sensing.residual[rows, :3]
    if rows.size < 3:
        return np.zeros(0), np.zeros((0, 3))
    along = velocity / np.maximum(np.linalg.norm(velocity, axis=1, keepdims=True), 1e-9)
    if sensing.stamp_s > 0:
        # Neighbours move another way, and errors of their stamps lie along theirs. What is the
        # same everywhere would change with the direction that is taken out of it.
        residual = _across(residual - np.median(residual, axis=0), along)
    second = residual[1:-1] - 0.5 * (residual[:-2] + residual[2:])
    second = _across(second, along[1:-1])
    usual = float(np.median(np.diff(time)))
    near = time[2:] - time[:-2] < max(NEAR_S, NEAR_STEPS * usual)
    square = np.sum(second**2, axis=1) / (1.5 * 2)
    distance = np.linalg.norm(sensing.view.measured[rows], axis=1)
    about = np.stack([distance[:-2], distance[1:-1], distance[2:]], axis=1)
    return square[near], about[near]


def _across(vectors: Array, along: Array) -> Array:
    """Vectors (n, 3) without their part along unit vectors (n, 3)."""
    return np.asarray(vectors - np.sum(vectors * along, axis=1, keepdims=True) * along)


def floor_of(state: PoseState) -> float:
    """Return the distance that jitter alone makes, m, from differences between neighbours."""
    squares = []
    for part in state.parts:
        is_resting = not part.view.velocity.any()  # each recording has an error of its own
        groups = np.unique(part.blocks) if is_resting else (None,)
        rows = [part.used if k is None else part.used & (part.blocks == k) for k in groups]
        sensings = [Sensing(part.view, part.residual, r, ~r, 0.0, 0.0, 0.0, 0.0) for r in rows]
        square = np.concatenate([jitter(sensing)[0] for sensing in sensings])
        noise = part.noise
        along = noise.stamp_s * np.linalg.norm(part.view.velocity[part.used, :3], axis=1)
        if square.size and along.size:
            squares.append(3 * float(np.mean(square)) + float(np.mean(along**2)))
    return float(np.sqrt(np.mean(squares))) if squares else 0.0
