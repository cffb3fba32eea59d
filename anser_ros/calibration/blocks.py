"""Spatial blocks for held-out error: whole frames, in cells of space, dealt to folds."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import FitError

Array = NDArray[np.float64]

FOLDS = 5
CELLS_ALONG = 5
SMALLEST_SHARE = 0.15
"""A direction whose extent is a smaller part of the largest one's is not divided."""


def fold_of_frames(positions: Sequence[Array], folds: int = FOLDS) -> list[NDArray[np.int64]]:
    """Fold of every frame.

    Space is cut into equal cells, five along the longest direction; cell (i, j, k) goes to fold
    (i + 2 j + 3 k) mod ``folds``, so that a fold is spread over the volume and its cells do not
    touch. A single point is never held out alone: all frames of a cell go together.

    Parameters
    ----------
    positions : sequence of ndarray, shape (F, 3)
        Body positions, m, one array a body and session.

    Raises
    ------
    FitError
        When the frames fill fewer than two folds.
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
        out.append(np.asarray(cell @ np.array([1, 2, 3]) % folds, dtype=np.int64))
    used = np.unique(np.concatenate(out))
    if used.size < 2:
        raise FitError(
            'held-out error needs frames in at least 2 separate cells of space, got 1: '
            'all frames are at one place'
        )
    return out
