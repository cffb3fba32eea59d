"""Turns measurements into rows: usable readings, the fluxes of dipoles in them, held-out
blocks. Readings are taken in blocks of frames that fit into memory (`usable_readings`);
`basis_rows` is the article's matrix of what each dipole does to them; whole frames in cells of
space are dealt to the folds by which errors are held out (`fold_of_frames`).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import FitError
from anser_ros.field.measurements import Measurements
from anser_ros.physics.dipole import flux_basis, flux_jacobian
from anser_ros.physics.sensor import along_each_axis

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


@dataclass(frozen=True)
class DipoleSites:
    """Holds positions (m) and unit directions of N virtual dipoles, shape (N, 3), frame fg."""

    positions: Array
    directions: Array

    def __len__(self) -> int:
        return int(self.positions.shape[0])

    @staticmethod
    def of_any_direction(places: Array) -> 'DipoleSites':
        """Return three dipoles, along x, y and z, at each of P places (P, 3), m."""
        return DipoleSites(*along_each_axis(places))

    def joined(self, other: 'DipoleSites') -> 'DipoleSites':
        """Return these dipoles, then the others."""
        return DipoleSites(
            np.concatenate([self.positions, other.positions]),
            np.concatenate([self.directions, other.directions]),
        )


def basis_rows(measurements: Measurements, dipoles: DipoleSites) -> Array:
    """Return the article's matrix M for all readings, shape (F S, N), T / (A m^2)."""
    return flux_basis(*_rows(measurements), dipoles.positions, dipoles.directions)


def flux_slopes(
    measurements: Measurements, dipoles: DipoleSites, moments: ComplexArray
) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """Return modelled fluxes (F, S, K), T, and their derivatives (F, S, 3, K).

    These are by the sensors' centres (T/m) and axes (T).
    """
    rows, sites = _rows(measurements), (dipoles.positions, dipoles.directions)
    flux, by_place, by_axis = flux_jacobian(*rows, *sites, moments)
    shape = (len(measurements.time), len(measurements.sensors), 3, moments.shape[1])
    return flux.reshape(*shape[:2], -1), by_place.reshape(shape), by_axis.reshape(shape)


def _rows(measurements: Measurements) -> tuple[Array, Array, Array]:
    points, axes = measurements.placed()
    lengths = np.tile(measurements.sensors.length, len(points))
    return points.reshape(-1, 3), axes.reshape(-1, 3), lengths


FOLDS = 5
"""Number of folds. Each fit then uses four fifths of the readings; more folds cost a fit each."""
CELLS_ALONG = 5
"""Cells along the longest direction. They must be larger than the distance over which the errors
of a fit are alike, or held-out errors are too small; with fewer cells each fold is one place."""
SMALLEST_SHARE = 0.15
"""A direction is not divided if its extent is a smaller fraction of the longest one's; the cells
of a flat volume would otherwise hold frames of the same places."""


def fold_of_frames(positions: Sequence[Array]) -> list[NDArray[np.int64]]:
    """Return the fold of every frame.

    Space is cut into equal cells, `CELLS_ALONG` along the longest direction. Cell (i, j, k) goes
    to fold (i + 2 j + 3 k) mod `FOLDS`, so that a fold is spread over the volume and its cells
    do not touch. All frames of a cell are held out together, never a single point.

    ``positions`` (F, 3) are the bodies', m, one array per body and session.
    Returns (F,): folds of the frames, one array per body and session.
    Raises `FitError` when the frames fill fewer than two folds.
    """
    everywhere = np.concatenate(positions)
    low, high = everywhere.min(axis=0), everywhere.max(axis=0)
    extent = high - low
    size = max(float(extent.max()) / CELLS_ALONG, 1e-9)
    out = []
    for where in positions:
        cell = np.floor((where - low) / size).astype(np.int64)
        cell = np.minimum(cell, CELLS_ALONG - 1)
        cell[:, extent < SMALLEST_SHARE * extent.max()] = 0
        out.append(np.asarray(cell @ np.array([1, 2, 3]) % FOLDS, dtype=np.int64))
    used = np.unique(np.concatenate(out))
    if used.size < 2:
        raise FitError(
            'held-out error needs frames in at least 2 separate cells of space, got 1: '
            'all frames are at one place'
        )
    return out
