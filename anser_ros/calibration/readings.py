"""Takes the usable readings of measurements in blocks of frames that fit into memory."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from anser_ros.field.measurements import Measurements

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

BLOCK_ROWS = 8192
"""Readings that are in memory at a time as rows of a matrix. With 400 dipoles such a block takes
26 MB; smaller blocks cost more calls, larger ones only memory."""


class Readings(NamedTuple):
    """Holds P usable readings of sensors with a pose, for K emitters."""

    # points, axes (P, 3): sensor centres (m) and unit axes, frame fg
    points: Array
    axes: Array
    lengths: Array  # (P,): coil lengths, m
    flux: ComplexArray  # (P, K): measured flux density along the axes, T


def frame_blocks(count: int, sensors: int, rows: int = BLOCK_ROWS) -> list[slice]:
    """Return slices of whole frames with at most ``rows`` readings each, but at least a frame."""
    step = max(1, rows // max(1, sensors))
    return [slice(start, min(start + step, count)) for start in range(0, count, step)]


def usable_readings(measurements: Sequence[Measurements]) -> Iterator[Readings]:
    """Yield the usable readings of measurements at their poses, block by block."""
    for whole in measurements:
        for block in frame_blocks(len(whole.time), len(whole.sensors)):
            part = whole.frames(block)
            used = part.usable
            if used.any():
                points, axes = part.placed()
                lengths = np.broadcast_to(part.sensors.length, used.shape)[used]
                yield Readings(points[used], axes[used], lengths, part.flux[used])


def weighted_readings(
    measurements: Sequence[Measurements], weights: Sequence[Array]
) -> tuple[Readings, Array]:
    """Return the P readings that have weight, at their poses, and the roots of their weights."""
    parts, roots = [], []
    for m, weight in zip(measurements, weights, strict=True):
        points, axes = m.placed()
        used = weight > 0.0
        lengths = np.broadcast_to(m.sensors.length, used.shape)[used]
        parts.append((points[used], axes[used], lengths, m.flux[used]))
        roots.append(np.sqrt(weight[used]))
    return Readings(*map(np.concatenate, zip(*parts, strict=True))), np.concatenate(roots)


def usable_weights(measurements: Measurements) -> Array:
    """Return weights of the readings, shape (F, S): 1 where a reading is usable, else 0."""
    return np.asarray(measurements.usable, dtype=np.float64)


def with_pose(measurements: Measurements) -> Measurements:
    """Return the frames with a pose and a valid reading; fluxes that are not usable become 0."""
    kept = measurements.frames(np.asarray(measurements.usable.any(axis=1)))
    flux = np.where(kept.usable[:, :, None], kept.flux, 0.0)
    return replace(kept, flux=flux)
