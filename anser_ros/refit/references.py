"""Predicts what reference coils read of sources, and what errors of their survey do.

A surveyed coil differs slightly from the table in place, direction and gain. Without metal this is
part of its baseline and cancels; in the change caused by metal it leaves an error proportional to
the change. To first order it is the reading of a few displaced, turned and scaled copies of the
coil (`survey_variants`).
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from anser_ros.physics.dipole import flux_basis
from anser_ros.physics.sensor import SensorTable
from anser_ros.physics.tangent import tangents
from anser_ros.settings import Accuracy

Array = NDArray[np.float64]

STEP_M = 1e-4
"""Step of the numerical derivative by a reference's position, m."""


def vector_basis(points: Array, axes: Array, lengths: Array | None, sources: Array) -> Array:
    """Return each coil's flux per unit moment along x, y and z of each source, (S, M, 3)."""
    out = np.empty((points.shape[0], sources.shape[0], 3))
    for component, unit in enumerate(np.eye(3)):
        directions = np.broadcast_to(unit, sources.shape)
        out[:, :, component] = flux_basis(points, axes, lengths, sources, directions)
    return out


def survey_variants(
    references: SensorTable, sources: Array, accuracy: Accuracy
) -> Iterator[Array]:
    """Yield the change (S, M, 3) of `vector_basis` by one deviation of each survey error."""
    p, n, lengths = references.position, references.axis, references.length
    if accuracy.reference_gain > 0.0:
        yield accuracy.reference_gain * vector_basis(p, n, lengths, sources)
    if accuracy.reference_axis_rad > 0.0:
        across = tangents(n)
        for side in range(2):
            yield accuracy.reference_axis_rad * vector_basis(p, across[:, side], lengths, sources)
    if accuracy.reference_position_m > 0.0:
        for unit in np.eye(3) * STEP_M:
            ahead = vector_basis(p + unit, n, lengths, sources)
            ahead -= vector_basis(p - unit, n, lengths, sources)
            yield ahead * (accuracy.reference_position_m / (2.0 * STEP_M))
