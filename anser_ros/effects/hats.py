"""Straight lines between knots, as a linear basis in time."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

KNOTS = 21


def knots_of(duration: float) -> Array:
    """Evenly spread knots over a session, s."""
    return np.linspace(0.0, max(duration, 1e-3), KNOTS)


def hats(knots: Array, time: Array) -> Array:
    """Hat functions of the knots at each time, shape (F, n); constant beyond the ends."""
    share = np.interp(time, knots, np.arange(knots.size, dtype=np.float64))
    left = np.minimum(share.astype(int), knots.size - 2)
    out = np.zeros((time.size, knots.size))
    rows = np.arange(time.size)
    out[rows, left] = 1 - (share - left)
    out[rows, left + 1] = share - left
    return out
