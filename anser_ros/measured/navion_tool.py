"""Tracks a three-axis sensor as a tool: 6-DoF pose from three coils' fields, from a cold start.

Three coils and three axes give nine numbers for six unknowns. The Gram matrix of the three fields
doesn't depend on the sensor's orientation, so a table of it over the volume gives the start.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.measured.navion_plate import HallSensorErrors, Plate, Sources, rotation_matrices

Array = NDArray[np.float64]

_TABLE_STEP = 0.02
"""Distance of neighbouring start positions in the table, m."""
_MAX_STEP = 0.02
"""Longest Gauss-Newton step of the position, m."""
_STARTS = 3
"""Start positions that are refined; the one with the smallest residual wins."""
_START_SPACING = 0.04
"""Smallest distance between start positions that are refined, m."""


@dataclass(frozen=True)
class ToolErrors:
    """Holds distance (m) and angle (rad) of each tracked sensor from where it was put."""

    position_m: Array
    angle_rad: Array

    def rmse(self) -> tuple[float, float]:
        """Return root mean squares over all sensors, m and rad; none is left out."""
        return (
            float(np.sqrt(np.mean(self.position_m**2))),
            float(np.sqrt(np.mean(self.angle_rad**2))),
        )


def track_sensors(
    reading_t: Array, matrix: Array, sources: Sources, low: Array, high: Array
) -> tuple[Array, Array]:
    """Track sensors one by one, each from nothing but its own reading.

    Parameters
    ----------
    reading_t : ndarray, shape (K, S, 3)
        Reading for each coil, T.
    matrix : ndarray, shape (S, 3, 3)
        Each sensor's gains and axes.
    sources : Sources
        The field model.
    low, high : ndarray, shape (3,)
        Box (m) that the table of start values covers.

    Returns
    -------
    position : ndarray, shape (S, 3)
        m.
    rotation : ndarray, shape (S, 3, 3)
        Sensor to frame.
    """
    seen = np.einsum('sij,ksj->sik', np.linalg.inv(matrix), reading_t)
    reading = reading_t.transpose(1, 2, 0)
    best = _refine(reading, matrix, sources, *_start(seen, sources, low, high, 0))
    for rank in range(1, _STARTS):
        other = _refine(reading, matrix, sources, *_start(seen, sources, low, high, rank))
        better = other[2] < best[2]
        best = (
            np.where(better[:, None], other[0], best[0]),
            np.where(better[:, None, None], other[1], best[1]),
            np.where(better, other[2], best[2]),
        )
    return best[0], best[1]


def _refine(
    reading: Array, matrix: Array, sources: Sources, position: Array, rotation: Array
) -> tuple[Array, Array, Array]:
    """Levenberg-Marquardt for all sensors at once: position, rotation, sum of squares (S,)."""
    damping = np.full(len(position), 1e-3)
    cost, residual = _cost(reading, matrix, sources, position, rotation)
    for _ in range(30):
        jacobian = _jacobian(matrix, sources, position, rotation)
        normal = jacobian.transpose(0, 2, 1) @ jacobian
        scale = np.einsum('saa->sa', normal)
        lifted = normal + (damping[:, None] * scale)[:, :, None] * np.eye(6)
        pull = jacobian.transpose(0, 2, 1) @ residual.reshape(len(position), 9, 1)
        step = np.linalg.solve(lifted, pull)[..., 0]
        length = np.linalg.norm(step[:, :3], axis=1)
        step *= np.minimum(1.0, _MAX_STEP / np.maximum(length, 1e-12))[:, None]
        new_position = position + step[:, :3]
        new_rotation = rotation_matrices(step[:, 3:]) @ rotation
        new_cost, new_residual = _cost(reading, matrix, sources, new_position, new_rotation)
        better = new_cost < cost
        position = np.where(better[:, None], new_position, position)
        rotation = np.where(better[:, None, None], new_rotation, rotation)
        residual = np.where(better[:, None, None], new_residual, residual)
        cost = np.where(better, new_cost, cost)
        damping = np.where(better, damping / 5.0, damping * 5.0)
    return position, rotation, cost


def tool_errors(
    reading_t: Array,
    sources: Sources,
    errors: HallSensorErrors,
    grid_m: Array,
    height_m: float,
    state: Array | None = None,
) -> ToolErrors:
    """Track every sensor of a plate and compare with its place on it.

    `state` is the plate's own pose and bend where it is known; the nominal one otherwise.
    """
    plate = Plate(grid_m)
    known = np.zeros(plate.n_state) if state is None else state
    truth, turned = plate.place(height_m, known, errors.shift_m)
    reach = np.array([0.06, 0.06, 0.12])
    position, rotation = track_sensors(
        reading_t, errors.matrix, sources, grid_m.min(axis=0) - reach, grid_m.max(axis=0) + reach
    )
    cosine = (np.einsum('sij,sij->s', rotation, turned) - 1.0) / 2.0
    return ToolErrors(
        np.linalg.norm(position - truth, axis=1), np.arccos(np.clip(cosine, -1.0, 1.0))
    )


def _start(
    seen: Array, sources: Sources, low: Array, high: Array, rank: int
) -> tuple[Array, Array]:
    """Start number `rank`: best table point that is well apart from the better starts."""
    axes = [np.arange(a, b + _TABLE_STEP / 2, _TABLE_STEP) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing='ij'), axis=-1).reshape(-1, 3)
    table = _signature(sources.field(points))
    position = []
    for wanted in _signature(seen):
        distance = ((table - wanted) ** 2).sum(axis=1)
        for _ in range(rank):
            taken = points[np.argmin(distance)]
            distance[np.linalg.norm(points - taken, axis=1) < _START_SPACING] = np.inf
        position.append(points[np.argmin(distance)])
    place = np.array(position)
    return place, _align(sources.field(place), seen)


def _signature(field: Array) -> Array:
    """Numbers that no rotation changes, compressed so that weak fields count too: (n, 7)."""
    gram = field.transpose(0, 2, 1) @ field
    norm = np.sqrt(np.einsum('saa->sa', gram))
    cosine = gram / (norm[:, :, None] * norm[:, None, :])
    hand = np.linalg.det(field) / norm.prod(axis=1)
    pairs = cosine[:, [0, 0, 1], [1, 2, 2]]
    return np.concatenate([np.log(norm), pairs, hand[:, None]], axis=1)


def _align(field: Array, seen: Array) -> Array:
    """Rotation that takes the sensor's view to the field (Kabsch's algorithm)."""
    u, _, vt = np.linalg.svd(field @ seen.transpose(0, 2, 1))
    sign = np.sign(np.linalg.det(u @ vt))
    u[:, :, 2] *= sign[:, None]
    return np.asarray(u @ vt)


def _cost(
    reading: Array, matrix: Array, sources: Sources, position: Array, rotation: Array
) -> tuple[Array, Array]:
    seen = np.einsum('sij,slj,slk->sik', matrix, rotation, sources.field(position))
    residual = reading - seen
    return (residual**2).sum(axis=(1, 2)), residual


def _jacobian(matrix: Array, sources: Sources, position: Array, rotation: Array) -> Array:
    field, gradient = sources.field(position), sources.gradient(position)
    sensing = np.einsum('sij,slj->sil', matrix, rotation)
    shift = np.einsum('sil,slmk->sikm', sensing, gradient)
    turn = np.cross(np.eye(3)[None, None], field.transpose(0, 2, 1)[:, :, None])  # (S, K, 3, l)
    turned = -np.einsum('sil,skql->sikq', sensing, turn)
    return np.asarray(np.concatenate([shift, turned], axis=3).reshape(len(position), 9, 6))
