"""Which dipoles, and how much damping: chosen by the predictive error of held-out blocks.

All candidates are compared at the same poses (corrected once with a rich layer) and on the same
blocks of space. A candidate costs one matrix: each fold's rows are summed to a Gram matrix, those
of the other folds are added up, and the eigenvectors of the sum give every damping at once.
Squaring the condition is harmless here, where the smallest damping is far above its rounding; what
is kept is fitted by QR. The score is the predictive chi-square of the held-out frames with their
pose marginalised, so that the pose's jitter, much larger than the flux noise, does not drown the
differences.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.dipole_sites import DipoleSites, basis_rows
from anser_ros.calibration.factors import ComplexArray, as_real
from anser_ros.calibration.layout_fit import (
    lowest_height,
    optimise_positions,
    prior_of,
    rich_layout,
)
from anser_ros.calibration.layouts import Generator, Layout, place
from anser_ros.calibration.moments import MomentFit, MomentFitter
from anser_ros.calibration.pose_correction import PoseWhitener, Uncertainty, pose_terms, with_pose
from anser_ros.calibration.prior import DrawnBoard
from anser_ros.errors import FitError
from anser_ros.field.measurements import Measurements

Array = NDArray[np.float64]

DAMPINGS = (1e-6, 1e-5, 3e-5, 1e-4, 3e-4, 1e-3, 1e-2)
EXTENSIONS = (1.0, 1.25, 1.5, 1.8, 2.2)
COUNTS = (6, 8, 10, 12, 14, 16, 18)
DEPTHS = (-0.15, 0.15, 0.3)
"""As a part of the lowest sensor's height over the coils."""
MOST_ROWS = 12_000
"""Readings that the choice looks at; the final fit takes all."""
MOVING = (
    Layout('coils', 2, 1.0, 0.0),
    Layout('coils', 3, 1.0, 0.0),
    Layout('layer', 8, 1.25, 0.01),
)
"""Where dipoles start from that are moved."""
LOCAL_COUNT = 10
LOCAL_READINGS = 24
"""Readings a dipole that local models need: four regions that overlap by half."""
MOVING_READINGS = 12
"""Readings that a moved dipole must have at least: three coordinates and a moment, thrice."""
WORTH = 0.08
"""A richer layout must lower the predictive error by this part to be worth its dipoles."""
WORTH_MANY = 0.15
"""The same for a layer that stays over one that moves, which has a third of the dipoles."""


@dataclass(frozen=True)
class LayoutCandidate:
    """A layout and a damping with their held-out score.

    Attributes
    ----------
    layout : Layout
    dipoles : DipoleSites
        As placed (before they are moved, if they may).
    damping : float
    score : float
        Square root of the mean predictive chi-square a phasor component, times the noise: T.
    curve : tuple of (float, float)
        Damping and score, for every damping tried.
    """

    layout: Layout
    dipoles: DipoleSites
    damping: float
    score: float
    curve: tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Selection:
    """The finalists (a fit from the start tells the better), and all that were compared."""

    finalists: tuple[LayoutCandidate, ...]
    candidates: tuple[LayoutCandidate, ...]
    reference: MomentFit


@dataclass(frozen=True)
class _Bench:
    """One body's readings at corrected poses, with all that a score needs, fold by fold."""

    corrected: Measurements
    folds: NDArray[np.int64]
    weights: Array
    back: Array
    whiteners: dict[int, PoseWhitener]


def thin_frames(
    measurements: Sequence[Measurements], most_rows: int = MOST_ROWS
) -> list[Measurements]:
    """Every n-th frame, so that at most ``most_rows`` readings are left; deterministic."""
    rows = sum(m.flux.shape[0] * m.flux.shape[1] for m in measurements)
    step = max(1, -(-rows // most_rows))
    return [m.frames(np.arange(0, len(m.time), step)) for m in measurements]


def _bench(
    corrected: Measurements,
    measured: Measurements,
    folds: NDArray[np.int64],
    weights: Array,
    dipoles: DipoleSites,
    fit: MomentFit,
    uncertainty: Uncertainty,
) -> _Bench:
    terms = pose_terms(corrected, dipoles, fit.moments)
    # Back to the measured pose: what the correction took off each reading, to first order.
    at_measured = pose_terms(measured, dipoles, fit.moments).residual
    whiteners = {
        int(fold): PoseWhitener(
            terms.slope[folds == fold], weights[folds == fold], fit.noise_t,
            uncertainty.pose_precision,
        )
        for fold in np.unique(folds)
    }  # fmt: skip
    return _Bench(corrected, folds, weights, at_measured - terms.residual, whiteners)


class Selector:
    """Scores layouts on one set of measurements.

    Parameters
    ----------
    measurements : sequence of Measurements
    folds : sequence of ndarray, shape (F,)
        Fold of each frame.
    reference : DipoleSites
        A rich set of dipoles for the correction of the poses.
    uncertainty : Uncertainty
    """

    def __init__(
        self,
        measurements: Sequence[Measurements],
        folds: Sequence[NDArray[np.int64]],
        reference: DipoleSites,
        uncertainty: Uncertainty,
    ) -> None:
        kept = [m.usable.any(axis=1) for m in measurements]
        posed = [with_pose(m) for m in measurements]
        fitter = MomentFitter(posed, reference, DAMPINGS[1], uncertainty)
        self.reference = fitter.fit(exact=False)
        self.noise_t = self.reference.noise_t
        self._benches = [
            _bench(c, m, f[k], w, reference, self.reference, uncertainty)
            for c, m, f, k, w in zip(
                self.reference.measurements, posed, folds, kept, self.reference.weights,
                strict=True,
            )
        ]  # fmt: skip
        self._folds = np.unique(np.concatenate([bench.folds for bench in self._benches]))

    def score(
        self,
        layout: Layout,
        dipoles: DipoleSites,
        drawn: DrawnBoard | None = None,
        dampings: Sequence[float] = DAMPINGS,
    ) -> LayoutCandidate:
        """Held-out score of a layout for every damping; the best damping is kept.

        DipoleSites that may move are moved anew for each fold, by the other folds' data.
        """
        prior = prior_of(layout, dipoles, drawn)
        chi, count = np.zeros(len(dampings)), 0.0
        same = None if layout.moved else self._tables(dipoles)
        for fold in (int(fold) for fold in self._folds):
            own, own_prior = dipoles, prior
            if layout.moved:
                own = self._moved_without(fold, dipoles, prior)
                own_prior = prior_of(layout, own, drawn)
            matrices, grams = same or self._tables(own)
            start = None if own_prior is None else as_real(own_prior) / self.noise_t
            total = sum(gram for other, gram in grams.items() if other != fold)
            moments = _ridge(np.asarray(total), len(own), dampings, start)
            for bench, matrix in zip(self._benches, matrices, strict=True):
                if fold not in bench.whiteners:
                    continue
                part, used = self._chi(bench, matrix, fold, moments)
                chi, count = chi + part, count + used
        scores = self.noise_t * np.sqrt(chi / count)
        best = int(np.argmin(scores))
        curve = tuple(zip(map(float, dampings), map(float, scores), strict=True))
        return LayoutCandidate(layout, dipoles, float(dampings[best]), float(scores[best]), curve)

    def _tables(self, dipoles: DipoleSites) -> tuple[list[Array], dict[int, Array]]:
        matrices = [basis_rows(bench.corrected, dipoles) for bench in self._benches]
        return matrices, {int(fold): self._gram(int(fold), matrices) for fold in self._folds}

    def _moved_without(
        self, fold: int, dipoles: DipoleSites, prior: ComplexArray | None
    ) -> DipoleSites:
        kept = [bench.folds != fold for bench in self._benches]
        return optimise_positions(
            [bench.corrected.frames(k) for bench, k in zip(self._benches, kept, strict=True)],
            [bench.weights[k] for bench, k in zip(self._benches, kept, strict=True)],
            dipoles,
            prior,
        )

    @property
    def _parts(self) -> int:
        return 2 * int(self._benches[0].corrected.flux.shape[2])

    def _gram(self, fold: int, matrices: Sequence[Array]) -> Array:
        """Inner products of a fold's columns, the matrix's (N) and the right-hand sides' (2K)."""
        size = matrices[0].shape[1] + self._parts
        gram = np.zeros((size, size))
        for bench, matrix in zip(self._benches, matrices, strict=True):
            rows = np.repeat(bench.folds == fold, len(bench.corrected.sensors))
            root = np.sqrt(bench.weights.reshape(-1, 1)[rows])
            right = as_real(bench.corrected.flux).reshape(-1, self._parts)[rows]
            block = root * np.concatenate([matrix[rows], right / self.noise_t], axis=1)
            gram += block.T @ block
        return gram

    def _chi(self, bench: _Bench, matrix: Array, fold: int, moments: Array) -> tuple[Array, float]:
        mask = bench.folds == fold
        rows = np.repeat(mask, len(bench.corrected.sensors))
        target = as_real(bench.corrected.flux)[mask] + bench.back[mask]
        held_out = matrix[rows]
        sums = [
            bench.whiteners[fold].chi_square(target - (held_out @ m).reshape(target.shape)).sum()
            for m in moments * self.noise_t
        ]
        return np.array(sums), float(bench.weights[mask].sum()) * target.shape[2]


def _ridge(gram: Array, unknowns: int, dampings: Sequence[float], prior: Array | None) -> Array:
    """Damped solutions, shape (D, N, M), from a Gram matrix of columns and right-hand sides."""
    scale = np.sqrt(np.maximum(np.diag(gram)[:unknowns], 0.0))
    scale[scale == 0.0] = 1.0
    normal = gram[:unknowns, :unknowns] / np.outer(scale, scale)
    right = gram[:unknowns, unknowns:] / scale[:, None]
    if prior is not None:
        right = right - normal @ (prior * scale[:, None])
    values, vectors = np.linalg.eigh(normal)
    projected = vectors.T @ right
    least = (np.asarray(dampings) ** 2)[:, None] * values[-1]
    steps = vectors @ (projected / (np.maximum(values, 0.0) + least)[:, :, None])
    out = steps / scale[:, None]
    return np.asarray(out if prior is None else out + prior)


Progress = Callable[[str, float], None]


def choose_layout(
    measurements: Sequence[Measurements],
    folds: Sequence[NDArray[np.int64]],
    generator: Generator,
    uncertainty: Uncertainty,
    progress: Progress | None = None,
    asked: Layout | None = None,
    drawn: DrawnBoard | None = None,
) -> Selection:
    """Walk through layouts from coarse to fine, then size, depth and kind, by held-out error.

    With a layout ``asked`` for, only its damping is chosen.

    Raises
    ------
    FitError
        When there are fewer readings than the smallest layout has dipoles.
    """
    rows = sum(int(m.usable.sum()) for m in measurements)
    if rows < COUNTS[0] ** 2:
        raise FitError(
            f'the smallest layout has {COUNTS[0] ** 2} dipoles and needs as many readings, '
            f'got {rows}'
        )
    # Damping makes more dipoles than readings harmless, and with a prior even useful.
    affordable = [n for n in COUNTS if n * n <= max(4 * rows, 144)]
    height = lowest_height(measurements, generator)
    prior = 'none' if drawn is None else 'nominal'
    rich = rich_layout(measurements, generator)
    if rows < rich.count**2:
        rich = replace(rich, count=affordable[-1])
    selector = Selector(measurements, folds, place(rich, generator), uncertainty)
    search = _Search(selector, generator, progress, drawn)
    if asked is not None:
        return Selection((search.score(asked),), tuple(search.tried.values()), selector.reference)
    start = Layout('layer', affordable[len(affordable) // 2], EXTENSIONS[1], 0.0, prior)
    best = search.climb(start, affordable)
    best = search.best_of(best, [replace(best.layout, extension=e) for e in EXTENSIONS])
    best = search.climb(best.layout, affordable)
    best = search.best_of(best, [replace(best.layout, depth_m=d * height) for d in DEPTHS])
    triple = max(4, round(best.layout.count / np.sqrt(3.0)))
    others = [replace(best.layout, kind='layer_xyz', count=triple)]
    others += [Layout('coils', n, 1.0, 0.0, prior) for n in (2, 3, 4)]
    if drawn is not None:
        others.append(replace(best.layout, prior='none'))
    others = [other for other in others if len(place(other, generator)) <= 1.2 * COUNTS[-1] ** 2]
    best = search.best_of(best, others)
    finalists = [search.leanest(best)]
    moving = [replace(layout, prior=prior, moved=True) for layout in MOVING]
    moving = [m for m in moving if MOVING_READINGS * len(place(m, generator)) <= rows]
    if moving:
        finalists.append(min(map(search.score, moving), key=lambda c: c.score))
    if rows >= LOCAL_READINGS * LOCAL_COUNT**2:
        own = Layout('layer', LOCAL_COUNT, EXTENSIONS[1], max(best.layout.depth_m, 0.0), prior)
        common = search.score(own)
        finalists.append(replace(common, layout=replace(common.layout, local=True)))
    return Selection(tuple(finalists), tuple(search.tried.values()), selector.reference)


class _Search:
    """Candidates as they are tried, each once."""

    def __init__(
        self,
        selector: Selector,
        generator: Generator,
        progress: Progress | None,
        drawn: DrawnBoard | None,
    ) -> None:
        self.selector, self.generator, self.progress = selector, generator, progress
        self.drawn = drawn
        self.tried: dict[Layout, LayoutCandidate] = {}

    def score(self, layout: Layout) -> LayoutCandidate:
        if layout not in self.tried:
            dipoles = place(layout, self.generator)
            self.tried[layout] = self.selector.score(layout, dipoles, self.drawn)
            if self.progress is not None:
                self.progress('layouts', 1.0 - 0.9 ** len(self.tried))
        return self.tried[layout]

    def best_of(self, best: LayoutCandidate, layouts: Sequence[Layout]) -> LayoutCandidate:
        return min([best, *(self.score(layout) for layout in layouts)], key=lambda c: c.score)

    def climb(self, start: Layout, counts: Sequence[int]) -> LayoutCandidate:
        """Finer while that helps, else coarser while that helps."""
        best = self.score(start)
        for way in (1, -1):
            moved = False
            place_now = counts.index(best.layout.count)
            while 0 <= place_now + way < len(counts):
                place_now += way
                other = self.score(replace(start, count=counts[place_now]))
                if other.score >= best.score:
                    break
                best, moved = other, True
            if moved:
                break
        return best

    def leanest(self, best: LayoutCandidate) -> LayoutCandidate:
        """The candidate with the fewest dipoles that is as good as the best to within `WORTH`.

        Tracking takes time in proportion to the dipoles, and far below the noise nothing is won.
        """
        limit = best.score * (1.0 + WORTH)
        place_now = EXTENSIONS.index(best.layout.extension)
        for extension in EXTENSIONS[max(place_now - 1, 0) : place_now + 1]:
            size = replace(best.layout, extension=extension)
            for count in (n for n in reversed(COUNTS) if n < best.layout.count):
                if self.score(replace(size, count=count)).score > limit:
                    break
        good = [c for c in self.tried.values() if c.score <= limit]
        return min(good, key=lambda c: (len(c.dipoles), c.score))
