"""Cuts spatial blocks for held-out errors: whole frames in cells of space, dealt to folds."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import FitError

Array = NDArray[np.float64]

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
