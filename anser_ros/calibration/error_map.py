"""Learns corrections of tracked positions from places that are known: a trend and what is smooth.

Shapes of maps are compared by nested cross-validation over blocks of space (`_HeldOut`), so that
neither the choice of a shape nor the decision to correct at all has seen what judges it.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RBFInterpolator
from scipy.spatial.transform import Rotation

from anser_ros.arrays import Array, Booleans
from anser_ros.calibration.readings import fold_of_frames
from anser_ros.errors import FitError

FLAT = 1e-6
"""Part of the largest extent below which a direction carries no trend: only rounding differs."""


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


FEWEST_POINTS = 8
"""Points needed: an affine trend has four parameters a component, and as many judge it."""
MOST_POINTS = 500
"""Points at most, thinned evenly: the time grows with their third power."""
LENGTHS = (0.15, 0.3, 0.6, 1.2, 2.5)
"""Covariance lengths that are tried, as a fraction of the points' largest extent: from the
distance between neighbouring blocks to nearly a quadratic trend."""
NOISES = (0.03, 0.1, 0.3, 1.0)
"""Standard deviations of the noise that are tried, as a fraction of the errors' own: from a map
that follows nearly every point to one that hardly follows any."""
TRENDS = (0, 1)
"""Degrees of the polynomial trend that are tried: a constant shift and an affine map."""
LEAST_GAIN_SIGMAS = 2.0
"""Standard errors by which the held-out error must fall for a gain to be claimed: with five blocks
chance alone does so once in twenty."""
PLANE = 0.02
"""Thickness of the true places (root mean square) over their extent, below which they count as a
plane: a board that is drilled on a machine is thinner, a volume is not."""


@dataclass(frozen=True)
class HeldOutError:
    """Holds root mean square errors, m, of places that took no part."""

    whole: float  # of the distance
    # in_plane, out_of_plane: along and across the plane of the true places, where these were
    # registered and lie in one
    in_plane: float | None = None
    out_of_plane: float | None = None

    @property
    def judged(self) -> float:
        """Return the one that a map is chosen and judged by."""
        return self.whole if self.in_plane is None else self.in_plane


@dataclass(frozen=True)
class ErrorMap:
    """Maps tracked to true positions as it was fitted."""

    correction: PositionMap  # what it adds to tracked positions
    # rotation, translation (3, 3) and (3,): from the frame of the true positions to that of the
    # tracked ones, m; none where both are in one frame
    rotation: Array
    translation: Array
    # places, errors (M, 3): the tracked positions that it was learnt from, and what they lacked, m
    places: Array
    errors: Array
    # before, after: without a map and with one, in blocks held out of registration, choice,
    # decision and fit. The latter may be the larger: then the map does not help.
    before: HeldOutError
    after: HeldOutError
    # the fall of the held-out mean square from one to the other, in its standard errors
    clearness: float
    # every shape with its held-out error (m), by which the shape was chosen
    tried: tuple[tuple[Shape, float], ...]

    @property
    def shape(self) -> Shape:
        """Return the shape of correction that was chosen."""
        return self.correction.shape

    @property
    def helps(self) -> bool:
        """Return whether the map is more than the identity."""
        return self.shape.trend >= 0

    @property
    def is_confirmed(self) -> bool:
        """Return whether unseen blocks confirm the map clearly, so that it may be used."""
        return bool(self.helps and self.clearness > LEAST_GAIN_SIGMAS)

    def apply(self, tracked: Array) -> Array:
        """Return corrected positions (P, 3), m."""
        return np.asarray(tracked + self.correction(tracked))


def learn_error_map(tracked: Array, true: Array, *, registers: bool = False) -> ErrorMap:
    """Learn a map from points at which both positions are known.

    ``tracked``, ``true`` (M, 3): m, in one frame, or in two. ``registers``: whether each has a
    frame of its own. Then a shift or turn of all is no error.
    Raises `FitError` when shapes differ, or there are too few points, or all are at one place.
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
    points = _Pairs(tracked[rows], true[rows], registers)
    held_out = _HeldOut(points, _shapes(points.tracked))
    everything = np.ones(len(rows), dtype=bool)
    rotation, translation = points.registration(everything)
    errors = points.errors(everything, rotation, translation)
    shape = held_out.shapes[held_out.decide(held_out.everything)]
    before, after = (held_out.nested(decided=decided) for decided in (False, True))
    return ErrorMap(
        PositionMap(points.tracked, errors, shape), rotation, translation, points.tracked,
        errors, held_out.error_of(before), held_out.error_of(after),
        held_out.clearness(before, after), held_out.tried(),
    )  # fmt: skip


class _Pairs:
    """Tracked and true positions (M, 3), and what parts of them tell."""

    def __init__(self, tracked: Array, true: Array, registers: bool) -> None:
        self.tracked, self.true, self._registers = tracked, true, registers
        # Blocks of space that do not depend on what is judged.
        self.folds = fold_of_frames([true if registers else tracked])[0]
        _, spread, axes = np.linalg.svd(true - true.mean(axis=0), full_matrices=False)
        if registers and spread[1] < PLANE * spread[0]:
            raise FitError('an error map needs places that are not all on a line')
        is_plane = registers and spread[2] < PLANE * spread[0]
        self.normal: Array | None = axes[2] if is_plane else None

    def registration(self, train: Booleans) -> tuple[Array, Array]:
        """Rotation and translation (m) from the frame of the true positions to the tracked."""
        if not self._registers:
            return np.eye(3), np.zeros(3)
        middle, aim = self.true[train].mean(axis=0), self.tracked[train].mean(axis=0)
        turn = Rotation.align_vectors(self.tracked[train] - aim, self.true[train] - middle)[0]
        return turn.as_matrix(), np.asarray(aim - turn.apply(middle))

    def errors(self, some: Booleans, rotation: Array, translation: Array) -> Array:
        """Return truth minus tracked positions, m, in their frame; only what is corrected."""
        lacking = self.true[some] @ rotation.T + translation - self.tracked[some]
        if self.normal is None:
            return np.asarray(lacking)
        normal = rotation @ self.normal
        return np.asarray(lacking - np.outer(lacking @ normal, normal))

    def left(self, known: frozenset[int], fold: int, shapes: Sequence[Shape]) -> list[Array]:
        """Errors (P, 3), m, in a fold by maps learnt of known folds; frame of the true ones."""
        train, test = np.isin(self.folds, list(known)), self.folds == fold
        rotation, translation = self.registration(train)
        errors, found = self.errors(train, rotation, translation), []
        for shape in shapes:
            corrected = PositionMap(self.tracked[train], errors, shape)(self.tracked[test])
            place = (self.tracked[test] + corrected - translation) @ rotation
            found.append(np.asarray(place - self.true[test]))
        return found

    def judged(self, errors: Array) -> float:
        """Sum of squares, m^2, that a map is judged by."""
        whole = float(np.sum(errors**2))
        return whole if self.normal is None else whole - float(np.sum((errors @ self.normal) ** 2))


def _shapes(places: Array) -> list[Shape]:
    extent = float(np.ptp(places, axis=0).max())
    smooth = [
        Shape(trend, length * extent, noise)
        for trend, length, noise in itertools.product(TRENDS, LENGTHS, NOISES)
    ]
    return [IDENTITY, *(Shape(trend, 0.0, 0.0) for trend in TRENDS), *smooth]


class _HeldOut:
    """Square errors of every shape in folds that its fit has not seen, worked out when asked for.

    A set of folds is *known*: choices and decisions with it use nothing of the other folds.
    """

    def __init__(self, points: _Pairs, shapes: Sequence[Shape]) -> None:
        self.shapes = shapes
        self.everything = frozenset(int(fold) for fold in np.unique(points.folds))
        self._points = points
        self._squares: dict[tuple[frozenset[int], int], Array] = {}

    def squares(self, known: frozenset[int], fold: int) -> Array:
        """Return the sum of squares (m^2) in a fold, by shape, of maps fitted to known folds."""
        key = known, fold
        if key not in self._squares:
            left = self._points.left(known, fold, self.shapes)
            self._squares[key] = np.array([self._points.judged(errors) for errors in left])
        return self._squares[key]

    def choose(self, known: frozenset[int]) -> int:
        """Return the shape with the smallest held-out error; none of one fold alone."""
        return 0 if len(known) < 2 else int(np.argmin(self._crossed(known)))

    def decide(self, known: frozenset[int]) -> int:
        """Return the chosen shape, or the identity where choosing so has not helped."""
        if len(known) < 2:
            return 0
        rests = {fold: known - {fold} for fold in known}
        plain = sum(self.squares(rest, fold)[0] for fold, rest in rests.items())
        chosen = sum(self.squares(rest, fold)[self.choose(rest)] for fold, rest in rests.items())
        return self.choose(known) if chosen < plain else 0

    def nested(self, *, decided: bool) -> list[Array]:
        """Return the errors in each fold of what the other folds decide, or of no map."""
        parts = []
        for fold in sorted(self.everything):
            rest = self.everything - {fold}
            shape = self.shapes[self.decide(rest) if decided else 0]
            parts += self._points.left(rest, fold, [shape])
        return parts

    def clearness(self, before: Sequence[Array], after: Sequence[Array]) -> float:
        """Return the fall of the mean square in standard errors of the blocks' own falls."""
        falls = np.array(
            [
                (self._points.judged(one) - self._points.judged(other)) / len(one)
                for one, other in zip(before, after, strict=True)
            ]
        )
        spread = float(falls.std(ddof=1)) / np.sqrt(len(falls))
        return float(falls.mean()) / spread if spread > 0 else 0.0

    def error_of(self, parts: Sequence[Array]) -> HeldOutError:
        """Return the root mean squares of errors by fold."""
        errors, normal = np.concatenate(parts), self._points.normal
        whole = float(np.sqrt(np.sum(errors**2) / len(errors)))
        if normal is None:
            return HeldOutError(whole)
        along = float(np.sqrt(self._points.judged(errors) / len(errors)))
        return HeldOutError(whole, along, float(np.sqrt(np.mean((errors @ normal) ** 2))))

    def tried(self) -> tuple[tuple[Shape, float], ...]:
        """Return every shape with its held-out error, m."""
        squares = self._crossed(self.everything)
        return tuple(
            (shape, float(np.sqrt(square / len(self._points.true))))
            for shape, square in zip(self.shapes, squares, strict=True)
        )

    def _crossed(self, known: frozenset[int]) -> Array:
        return np.asarray(np.sum([self.squares(known - {fold}, fold) for fold in known], axis=0))
