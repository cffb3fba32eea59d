"""A smooth map from tracked to true positions, learnt where the true positions are known.

This is the usual calibration of trackers that give poses and no fluxes, and the article's last
step of distortion compensation (Table V, "compensated and corrected"). The three components of the
error are Gaussian processes of the tracked position with one squared-exponential covariance
(Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, chapter 2) on top of a
constant or affine trend; their mean is the interpolant that `scipy.interpolate.RBFInterpolator`
solves for. Trend, length and noise are chosen by the error in held-out blocks of space. Further
blocks that took no part in that choice decide whether the map helps; if not, it is the identity.
The error that is reported is that of a third set of blocks, which took part neither in the choice
nor in that decision nor in the fit.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RBFInterpolator

from anser_ros.calibration.blocks import fold_of_frames
from anser_ros.errors import FitError

Array = NDArray[np.float64]

FEWEST_POINTS = 8
"""Points with both positions below which no map is learnt: an affine trend has four parameters a
component, and as many points again have to judge it."""
MOST_POINTS = 500
"""Points that a map is learnt from at most; more are thinned evenly, because the map is smooth and
the time grows with the third power of the points."""
LENGTHS = (0.15, 0.3, 0.6, 1.2, 2.5)
"""Covariance lengths that are tried, as a fraction of the points' largest extent: from the
distance between neighbouring blocks to nearly a quadratic trend."""
NOISES = (0.03, 0.1, 0.3, 1.0)
"""Standard deviations of the noise that are tried, as a fraction of the errors' own: from a map
that follows nearly every point to one that hardly follows any."""
TRENDS = (0, 1)
"""Degrees of the polynomial trend that are tried: a constant shift and an affine map."""
FLAT = 1e-6
"""A direction in which the points extend less than this part of the largest extent carries no
trend and no distance: what differs there is the rounding of the numbers."""


@dataclass(frozen=True)
class Shape:
    """A choice of map.

    Attributes
    ----------
    trend : int
        Polynomial degree of the trend; -1 for no map.
    length_m : float
        Covariance length, m; 0 for a trend alone.
    noise : float
        Noise as a part of the errors' standard deviation about the trend.
    """

    trend: int
    length_m: float
    noise: float

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
    """What a map of one shape, fitted to some points, adds to tracked positions.

    Parameters
    ----------
    places : ndarray, shape (M, 3)
        Tracked positions, m.
    errors : ndarray, shape (M, 3)
        True less tracked positions, m.
    shape : Shape
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


@dataclass(frozen=True)
class ErrorMap:
    """A fitted map from tracked to true positions.

    Attributes
    ----------
    correction : PositionMap
        What it adds to tracked positions.
    n_points : int
        Points that it was learnt from.
    before_m, after_m : float
        Root mean square error (m) without a map and with one, in blocks held out of choice,
        decision and fit. The latter may be the larger: then the map does not help.
    tried : tuple of (Shape, float)
        Every shape with its held-out error (m), by which the shape was chosen.
    """

    correction: PositionMap
    n_points: int
    before_m: float
    after_m: float
    tried: tuple[tuple[Shape, float], ...]

    @property
    def shape(self) -> Shape:
        """The shape that was chosen."""
        return self.correction.shape

    @property
    def helps(self) -> bool:
        """Whether the map is more than the identity."""
        return self.shape.trend >= 0

    def apply(self, tracked: Array) -> Array:
        """Return corrected positions (P, 3), m."""
        return np.asarray(tracked + self.correction(tracked))


def learn_error_map(tracked: Array, true: Array) -> ErrorMap:
    """Learn a map from points at which both positions are known.

    Parameters
    ----------
    tracked, true : ndarray, shape (M, 3)
        m, in one frame.

    Raises
    ------
    FitError
        When shapes differ, or there are too few points, or all are at one place.
    """
    if tracked.shape != true.shape or tracked.ndim != 2 or tracked.shape[1] != 3:
        raise FitError(
            f'an error map needs tracked and true positions (n, 3), '
            f'got {tracked.shape} and {true.shape}'
        )
    good = np.isfinite(tracked).all(axis=1) & np.isfinite(true).all(axis=1)
    if int(good.sum()) < FEWEST_POINTS:
        raise FitError(
            f'an error map needs at least {FEWEST_POINTS} points with both positions, '
            f'got {int(good.sum())}'
        )
    rows = np.flatnonzero(good)
    rows = rows[:: -(-rows.size // MOST_POINTS)]
    places, errors = tracked[rows], true[rows] - tracked[rows]
    held_out = _HeldOut(places, errors, fold_of_frames([places])[0], _shapes(places))
    shape = held_out.shapes[held_out.decide(held_out.everything)]
    return ErrorMap(
        PositionMap(places, errors, shape),
        len(places),
        float(np.sqrt((errors**2).sum(axis=1).mean())),
        float(np.sqrt(held_out.square_of_decisions() / len(places))),
        held_out.tried(),
    )


def _shapes(places: Array) -> list[Shape]:
    extent = float(np.ptp(places, axis=0).max())
    shapes = [IDENTITY] + [Shape(trend, 0.0, 0.0) for trend in TRENDS]
    shapes += [
        Shape(trend, length * extent, noise)
        for trend in TRENDS
        for length in LENGTHS
        for noise in NOISES
    ]
    return shapes


class _HeldOut:
    """Square errors of every shape in folds that its fit has not seen, worked out when asked for.

    A set of folds is what is *known*: what is chosen or decided with it takes nothing from the
    others.
    """

    def __init__(
        self, places: Array, errors: Array, folds: NDArray[np.int64], shapes: Sequence[Shape]
    ) -> None:
        self.shapes = shapes
        self.everything = frozenset(int(fold) for fold in np.unique(folds))
        self._points = places, errors, folds
        self._squares: dict[tuple[frozenset[int], int], Array] = {}

    def squares(self, known: frozenset[int], fold: int) -> Array:
        """Return the sum of squares (m^2) in a fold, by shape, of maps fitted to known folds."""
        key = known, fold
        if key not in self._squares:
            places, errors, folds = self._points
            train, test = np.isin(folds, list(known)), folds == fold
            self._squares[key] = np.array(
                [
                    np.sum((errors[test] - part(places[test])) ** 2)
                    for part in (
                        PositionMap(places[train], errors[train], shape) for shape in self.shapes
                    )
                ]
            )
        return self._squares[key]

    def choose(self, known: frozenset[int]) -> int:
        """Return the shape with the smallest held-out error; none of one fold alone."""
        if len(known) < 2:
            return 0
        return int(np.argmin(self._crossed(known)))

    def decide(self, known: frozenset[int]) -> int:
        """Return the chosen shape, or the identity where choosing so has not helped."""
        if len(known) < 2:
            return 0
        rests = {fold: known - {fold} for fold in known}
        plain = sum(self.squares(rest, fold)[0] for fold, rest in rests.items())
        chosen = sum(self.squares(rest, fold)[self.choose(rest)] for fold, rest in rests.items())
        return self.choose(known) if chosen < plain else 0

    def square_of_decisions(self) -> float:
        """Return the sum of squares (m^2) in each fold of what the other folds decide."""
        rests = {fold: self.everything - {fold} for fold in self.everything}
        return float(
            sum(self.squares(rest, fold)[self.decide(rest)] for fold, rest in rests.items())
        )

    def tried(self) -> tuple[tuple[Shape, float], ...]:
        """Return every shape with its held-out error, m."""
        squares = self._crossed(self.everything)
        return tuple(
            (shape, float(np.sqrt(square / len(self._points[0]))))
            for shape, square in zip(self.shapes, squares, strict=True)
        )

    def _crossed(self, known: frozenset[int]) -> Array:
        return np.asarray(np.sum([self.squares(known - {fold}, fold) for fold in known], axis=0))
