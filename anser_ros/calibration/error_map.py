"""A smooth map from tracked to true positions, learnt where the true positions are known.

This is the usual calibration of trackers that give poses and no fluxes, and the article's last
step of distortion compensation (Table V, "compensated and corrected"). The three components of the
error are Gaussian processes of the tracked position with one squared-exponential covariance
(Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, chapter 2) on top of a
constant or affine trend. Trend, length and noise are chosen by the error in held-out blocks of
space. Further blocks that took no part in that choice decide whether the map helps; if not, it is
the identity.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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


@dataclass(frozen=True)
class Shape:
    """The degree of a map's trend (-1 for no map), its covariance length (m) and its noise (m)."""

    trend: int
    length_m: float
    noise_m: float

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


@dataclass(frozen=True)
class ErrorMap:
    """A fitted map from tracked to true positions.

    Attributes
    ----------
    shape : Shape
        The chosen trend, length and noise.
    places : ndarray, shape (M, 3)
        Tracked positions that the map was learnt from, m.
    weights : ndarray, shape (M, 3)
        Weights of the Gaussian process at these positions, m.
    trend : ndarray, shape (T, 3)
        Coefficients of the trend (T = 0 for no map, 1 for a shift, 4 for an affine map).
    middle : ndarray, shape (3,)
        Position from which the affine trend is counted, m.
    before_m, after_m : float
        Root mean square error without and with a map in blocks that took part neither in the
        choice nor in the fit, m.
    tried : tuple of (Shape, float)
        Every shape with its held-out error, m.
    """

    shape: Shape
    places: Array
    weights: Array
    trend: Array
    middle: Array
    before_m: float
    after_m: float
    tried: tuple[tuple[Shape, float], ...] = ()

    @property
    def helps(self) -> bool:
        """Whether the map is more than the identity."""
        return self.shape.trend >= 0

    def correction(self, tracked: Array) -> Array:
        """Return the corrections (P, 3), m, to be added to tracked positions (P, 3), m."""
        if not self.helps:
            return np.zeros_like(tracked)
        out = _trend_columns(tracked - self.middle, self.shape.trend) @ self.trend
        if self.shape.length_m > 0.0:
            out = out + _covariance(tracked, self.places, self.shape.length_m) @ self.weights
        return np.asarray(out)

    def apply(self, tracked: Array) -> Array:
        """Return the corrected positions (P, 3), m, of tracked positions (P, 3), m."""
        return np.asarray(tracked + self.correction(tracked))


def _trend_columns(places: Array, degree: int) -> Array:
    ones = np.ones((len(places), 1))
    return ones if degree == 0 else np.concatenate([ones, places], axis=1)


def _covariance(one: Array, other: Array, length: float) -> Array:
    square = ((one[:, None] - other[None]) ** 2).sum(axis=2)
    return np.asarray(np.exp(-0.5 * square / length**2))


def _fit(places: Array, errors: Array, shape: Shape, middle: Array) -> tuple[Array, Array]:
    """Return the coefficients of the trend and the weights of the Gaussian process about it."""
    if shape.trend < 0:
        return np.zeros((0, 3)), np.zeros((len(places), 3))
    columns = _trend_columns(places - middle, shape.trend)
    if shape.length_m == 0.0:
        plain = np.asarray(np.linalg.lstsq(columns, errors, rcond=None)[0])
        return plain, np.zeros((len(places), 3))
    plain = errors - columns @ np.linalg.lstsq(columns, errors, rcond=None)[0]
    amplitude = max(float(plain.std()), 1e-9)
    noise = (shape.noise_m / amplitude) ** 2
    kernel = _covariance(places, places, shape.length_m) + noise * np.eye(len(places))
    solved = np.linalg.solve(kernel, np.concatenate([columns, errors], axis=1))
    left, right = solved[:, : columns.shape[1]], solved[:, columns.shape[1] :]
    trend = np.linalg.lstsq(columns.T @ left, columns.T @ right, rcond=None)[0]
    return np.asarray(trend), np.asarray(right - left @ trend)


def learn_error_map(
    tracked: Array, true: Array, groups: Sequence[int] | NDArray[np.int64] | None = None
) -> ErrorMap:
    """Learn a map from points at which both positions are known.

    Parameters
    ----------
    tracked, true : ndarray, shape (M, 3)
        Positions, m, in one frame; points that are not finite are left out.
    groups : sequence of int, optional
        Fold of each point; blocks of space by default.

    Raises
    ------
    FitError
        When the shapes differ or there are fewer than `FEWEST_POINTS` points.
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
    folds = fold_of_frames([places])[0] if groups is None else np.asarray(groups)[rows]
    shapes = _shapes(places, errors)
    before = float(np.sqrt((errors**2).sum(axis=1).mean()))
    after = _nested_rms(places, errors, folds, shapes)
    tried = tuple((shape, held_out_rms(places, errors, folds, shape)) for shape in shapes)
    shape = _best(tried) if after < before else IDENTITY
    middle = places.mean(axis=0)
    trend, weights = _fit(places, errors, shape, middle)
    return ErrorMap(shape, places, weights, trend, middle, before, min(after, before), tried)


def _best(tried: Sequence[tuple[Shape, float]]) -> Shape:
    return min(tried, key=lambda pair: pair[1])[0]


def _nested_rms(
    places: Array, errors: Array, folds: NDArray[np.int64], shapes: Sequence[Shape]
) -> float:
    """Return the error (m, rms) over folds of maps whose shape the other folds have chosen."""
    square = 0.0
    for fold in np.unique(folds):
        rest, test = folds != fold, folds == fold
        inner = (places[rest], errors[rest], folds[rest])
        shape = _best([(shape, held_out_rms(*inner, shape)) for shape in shapes])
        square += _square_error(places, errors, rest, test, shape)
    return float(np.sqrt(square / len(places)))


def _shapes(places: Array, errors: Array) -> list[Shape]:
    extent = float(np.ptp(places, axis=0).max())
    spread = max(float(errors.std()), 1e-9)
    shapes = [IDENTITY] + [Shape(trend, 0.0, 0.0) for trend in TRENDS]
    shapes += [
        Shape(trend, length * extent, noise * spread)
        for trend in TRENDS
        for length in LENGTHS
        for noise in NOISES
    ]
    return shapes


def held_out_rms(places: Array, errors: Array, folds: NDArray[np.int64], shape: Shape) -> float:
    """Return the root mean square error (m) of maps of one shape in held-out folds.

    Parameters
    ----------
    places, errors : ndarray, shape (M, 3)
        Tracked positions and true minus tracked positions, m.
    folds : ndarray of int, shape (M,)
        Fold of each point.
    shape : Shape
        The shape to judge.
    """
    square = sum(
        _square_error(places, errors, folds != fold, folds == fold, shape)
        for fold in np.unique(folds)
    )
    return float(np.sqrt(square / len(places)))


def _square_error(
    places: Array,
    errors: Array,
    train: NDArray[np.bool_],
    test: NDArray[np.bool_],
    shape: Shape,
) -> float:
    middle = places[train].mean(axis=0)
    trend, weights = _fit(places[train], errors[train], shape, middle)
    part = ErrorMap(shape, places[train], weights, trend, middle, 0.0, 0.0)
    return float(((errors[test] - part.correction(places[test])) ** 2).sum())
