"""Adds to tracked positions a trend, and a smooth function on top of it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RBFInterpolator

Array = NDArray[np.float64]

FLAT = 1e-6
"""A direction in which the points extend less than this part of the largest extent carries no
trend and no distance: what differs there is the rounding of the numbers."""


@dataclass(frozen=True)
class Shape:
    """Describes a choice of map."""

    trend: int  # polynomial degree of the trend; -1 for no map
    length_m: float  # covariance length, m; 0 for a trend alone
    noise: float  # noise as a part of the errors' standard deviation about the trend

    def describe(self) -> str:
        """Return the shape in words for a report."""
        if self.trend < 0:
            return 'no correction'
        trend = 'shift' if self.trend == 0 else 'affine'
        if self.length_m == 0.0:
            return trend
        return f'{trend}, smooth over {1e3 * self.length_m:.0f} mm'


IDENTITY = Shape(-1, 0.0, 0.0)
"""The shape of a map that corrects nothing."""


class PositionMap:
    """Holds what a map of one shape, fitted to some points, adds to tracked positions.

    ``places`` (M, 3): tracked positions, m. ``errors`` (M, 3): true less tracked positions, m.
    """

    def __init__(self, places: Array, errors: Array, shape: Shape) -> None:
        self.shape = shape
        self._middle = places.mean(axis=0)
        _, spread, axes = np.linalg.svd(places - self._middle, full_matrices=False)
        self._axes = axes[spread > FLAT * spread[0]]
        if shape.length_m > 0.0:
            self._smooth = RBFInterpolator(
                self._reduced(places),
                errors,
                kernel='gaussian',
                epsilon=np.sqrt(0.5) / shape.length_m,
                smoothing=shape.noise**2,
                degree=shape.trend,
            )
        elif shape.trend >= 0:
            columns = _trend_columns(self._reduced(places), shape.trend)
            self._trend = np.linalg.lstsq(columns, errors, rcond=None)[0]

    def __call__(self, tracked: Array) -> Array:
        """Return what to add to tracked positions (P, 3), m."""
        if self.shape.trend < 0:
            return np.zeros_like(tracked)
        where = self._reduced(tracked)
        if self.shape.length_m > 0.0:
            return np.asarray(self._smooth(where))
        return np.asarray(_trend_columns(where, self.shape.trend) @ self._trend)

    def _reduced(self, places: Array) -> Array:
        return np.asarray((places - self._middle) @ self._axes.T)


def _trend_columns(places: Array, degree: int) -> Array:
    ones = np.ones((len(places), 1))
    return ones if degree == 0 else np.concatenate([ones, places], axis=1)
