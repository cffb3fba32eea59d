"""Says where a calibrated field is uncertain: in the gaps of the scan that it was fitted to."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import ModelFileError
from anser_ros.physics.dipole import flux_basis

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ScanGaps:
    """Holds what a scan leaves open of the field, alike for all emitters."""

    # positions, directions: (N, 3), dipoles, m and unit vectors, frame fg
    positions: Array
    directions: Array
    # (R, N), A m^2. The variance of a phasor component of any emitter's flux is the sum of the
    # squares of the fluxes of these R combinations of the dipoles.
    moments: Array

    def sigma_t(self, points: Array, axes: Array, lengths: Array) -> Array:
        """Return how far the modelled flux may be off, T a phasor component.

        Parameters
        ----------
        points, axes : ndarray, shape (F, S, 3)
            Sensor centres (m) and unit axes, frame fg.
        lengths : ndarray, shape (S,)
            Coil lengths, m.

        Returns
        -------
        ndarray, shape (F, S)
        """
        frames, sensors = points.shape[:2]
        basis = flux_basis(
            points.reshape(-1, 3), axes.reshape(-1, 3), np.tile(lengths, frames),
            self.positions, self.directions,
        )  # fmt: skip
        squares = np.sum((basis @ self.moments.T) ** 2, axis=1)
        return np.asarray(np.sqrt(squares).reshape(frames, sensors))


def gaps_document(gaps: ScanGaps) -> list[list[float]]:
    """Return gaps as plain lists, a row per dipole: place, direction and its R moments."""
    table: list[list[float]] = np.concatenate(
        [gaps.positions, gaps.directions, gaps.moments.T], axis=1
    ).tolist()
    return table


def parse_gaps(document: Any) -> ScanGaps:
    """Return what `gaps_document` wrote; raises `ModelFileError` with the rule it breaks."""
    try:
        table = np.array(document, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ModelFileError('model: gaps are no table of numbers') from error
    if table.ndim != 2 or table.shape[1] < 7 or not np.isfinite(table).all():
        raise ModelFileError(
            f'model: gaps must be rows of at least 7 finite numbers, got {table.shape}'
        )
    return ScanGaps(table[:, :3].copy(), table[:, 3:6].copy(), table[:, 6:].T.copy())
