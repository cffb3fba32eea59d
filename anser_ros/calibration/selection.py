"""Chooses the dipoles' layout and the damping by the predictive error of held-out blocks of space.

All layouts are compared at the same poses (corrected once with a rich layer) and on the same
blocks (`LayoutScorer`). A layout costs one matrix: the rows of each fold are summed to a Gram
matrix, those of the other folds are added up, and the eigenvectors of the sum give the solutions
for all dampings. The score is the predictive chi-square of the held-out frames with their poses
marginalised, so that the jitter of the poses, much larger than the flux noise, does not hide the
differences. The search (`choose_layout`) goes from coarse to fine layers and then varies their
size, their depth and the kind of the dipoles. Its result and dipoles that are moved are the
finalists, among which a complete fit decides (`fit_scan`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from anser_ros.arrays import Array, ComplexArray, Integers, as_real
from anser_ros.calibration.drawn_fit import is_of_coils
from anser_ros.calibration.layout_fit import (
    LayoutPlacer,
    free_bases,
    lowest_height,
    rich_fit,
    rich_layout,
)
from anser_ros.calibration.layouts import FREE_KINDS, Generator, Layout, place
from anser_ros.calibration.least_squares import GramFactor
from anser_ros.calibration.moments import (
    MomentFit,
    MomentFitter,
    PoseWhitener,
    Progress,
    damped_moments,
    pose_precision,
    pose_terms,
)
from anser_ros.calibration.readings import DipoleSites, basis_rows, with_pose
from anser_ros.errors import FitError
from anser_ros.field.measurements import Measurements
from anser_ros.parallel import in_order
from anser_ros.settings import Accuracy

DAMPINGS = (1e-6, 1e-5, 3e-5, 1e-4, 3e-4, 1e-3, 3e-3, 1e-2)
"""Dampings: from far above a Gram matrix's rounding (1e-8) to where only the prior is left."""
REFERENCE_DAMPING = DAMPINGS[1]
"""Damping of the fit by which poses are corrected before layouts are compared."""


@dataclass(frozen=True)
class LayoutCandidate:
    """Holds a layout with its best damping and its score on held-out blocks."""

    layout: Layout
    dipoles: DipoleSites  # its dipoles as placed, before any of them are moved
    damping: float  # the one with the best score
    # square root of the mean predictive chi-square a phasor component, times the noise, T
    score: float
    # damping and score (T) for every damping that was tried
    curve: tuple[tuple[float, float], ...]


class _BodyReadings:
    """One body's readings at corrected poses with what the score of each fold needs.

    ``back`` (F, S, 2K) is the part that the correction of the pose subtracted from each reading,
    T.
    """

    def __init__(
        self, corrected: Measurements, measured: Measurements, folds: Integers,
        weights: Array, dipoles: DipoleSites, fit: MomentFit, precision: Array,
    ) -> None:  # fmt: skip
        self.corrected, self.folds, self.weights = corrected, folds, weights
        terms = pose_terms(corrected, dipoles, fit.moments)
        # The correction is undone to first order, since predictions are judged at measured poses.
        self.back = pose_terms(measured, dipoles, fit.moments).residual - terms.residual
        self.whiteners = {
            int(k): PoseWhitener(terms.slope[own], weights[own], fit.noise_t, precision)
            for k, own in ((k, folds == k) for k in np.unique(folds))
        }


class LayoutScorer:
    """Scores layouts on one set of measurements, whose poses a fit of a rich layer corrects."""

    def __init__(
        self,
        measurements: Sequence[Measurements],
        folds: Sequence[Integers],
        rich: DipoleSites,
        accuracy: Accuracy,
        placer: LayoutPlacer,
    ) -> None:
        self.placer = placer
        kept = [m.usable.any(axis=1) for m in measurements]
        posed = [with_pose(m) for m in measurements]
        fitter = MomentFitter(posed, rich, REFERENCE_DAMPING, accuracy)
        self.reference = fit = fitter.fit(exact=False)
        self.noise_t = fit.noise_t
        self._bodies = [
            _BodyReadings(corrected, m, fold[k], weights, rich, fit, pose_precision(accuracy))
            for corrected, m, fold, k, weights in zip(
                fit.measurements, posed, folds, kept, fit.weights, strict=True
            )
        ]
        self._folds = np.unique(np.concatenate([body.folds for body in self._bodies])).tolist()

    def score(self, layout: Layout) -> LayoutCandidate:
        """Return the held-out score of a layout for every damping, with the best one.

        Movable dipoles are fitted again for each fold, to the data of the other folds.
        """
        placed = self.placer.placed(layout)
        same = None if layout.moved else self._tables(placed[0])

        def scored(fold: int) -> tuple[Array, float]:
            chi, count = np.zeros(len(DAMPINGS)), 0.0
            sites, prior = self._moved_without(fold, layout) if layout.moved else placed
            matrices, factors = same or self._tables(sites)
            rest = GramFactor(len(sites), self._parts)
            rest.gram += sum(one.gram for other, one in factors.items() if other != fold)
            start = None if prior is None else as_real(prior)
            moments, _ = damped_moments(rest, sites, DAMPINGS, start)
            for body, matrix in zip(self._bodies, matrices, strict=True):
                if fold in body.whiteners:
                    part, used = self._chi(body, matrix, fold, moments)
                    chi, count = chi + part, count + used
            return chi, count

        parts = in_order(scored, self._folds)
        chi = np.sum([part for part, _ in parts], axis=0)
        scores = self.noise_t * np.sqrt(chi / sum(count for _, count in parts))
        best = int(np.argmin(scores))
        curve = tuple(zip(DAMPINGS, map(float, scores), strict=True))
        return LayoutCandidate(layout, placed[0], DAMPINGS[best], float(scores[best]), curve)

    def _tables(self, dipoles: DipoleSites) -> tuple[list[Array], dict[int, GramFactor]]:
        matrices = [basis_rows(body.corrected, dipoles) for body in self._bodies]
        factors = in_order(lambda fold: self._factor(fold, matrices), self._folds)
        return matrices, dict(zip(self._folds, factors, strict=True))

    def _moved_without(self, fold: int, layout: Layout) -> tuple[DipoleSites, ComplexArray | None]:
        rest = [(body, body.folds != fold) for body in self._bodies]
        return self.placer.moved(
            layout,
            [body.corrected.frames(kept) for body, kept in rest],
            [body.weights[kept] for body, kept in rest],
        )

    @property
    def _parts(self) -> int:
        return 2 * int(self._bodies[0].corrected.flux.shape[2])

    def _factor(self, fold: int, matrices: Sequence[Array]) -> GramFactor:
        """Return the least-squares problem of a fold's readings."""
        factor = GramFactor(matrices[0].shape[1], self._parts)
        for body, matrix in zip(self._bodies, matrices, strict=True):
            rows = np.repeat(body.folds == fold, len(body.corrected.sensors))
            root = np.sqrt(body.weights.reshape(-1, 1)[rows])
            right = as_real(body.corrected.flux).reshape(-1, self._parts)[rows]
            factor.add(root * matrix[rows], root * right)
        return factor

    def _chi(
        self, body: _BodyReadings, matrix: Array, fold: int, moments: Array
    ) -> tuple[Array, float]:
        mask = body.folds == fold
        rows = np.repeat(mask, len(body.corrected.sensors))
        target = as_real(body.corrected.flux)[mask] + body.back[mask]
        # Those of all dampings beside each other: one product is faster than many narrow ones.
        made = np.split(matrix[rows] @ np.concatenate(moments, axis=1), len(moments), axis=1)
        white = body.whiteners[fold]
        sums = [white.chi_square(target - m.reshape(target.shape)).sum() for m in made]
        return np.array(sums), float(body.weights[mask].sum()) * target.shape[2]


COUNTS = (6, 8, 10, 12, 14, 16, 18)
"""Dipoles along a side of a layer: from less than five for each of eight coils to what bounds the
time of tracking, which grows in proportion to the dipoles."""
EXTENSIONS = (1.0, 1.25, 1.5, 1.8, 2.2)
"""Sizes of a layer as a multiple of the coils' extent; larger ones have the returning field
too."""
DEPTHS = (-0.15, 0.15, 0.3)
"""Depths of a layer below the coils, as a fraction of the lowest sensor's height over them. Deeper
layers are smoother and closer to singular."""
SMALLEST_TRIPLE = 4
"""Points along a side of a layer of three-component dipoles at least."""
MOST_DIPOLES = 1.2 * COUNTS[-1] ** 2
"""Dipoles of layouts of other kinds at most: a fifth more than the largest layer has."""
DIPOLES_PER_READING = 4
"""Most dipoles of a layer for each reading: damping makes more than one harmless."""
ALWAYS_AFFORDABLE = COUNTS[3] ** 2
"""Dipoles that a layer may have however few readings there are: the 12 x 12 of the article."""
MOST_ROWS = 12_000
"""Readings that the choice looks at; fewer make held-out errors less certain than differences."""
COAXIAL = tuple(Layout('coaxial', n, 1.0, 0.0, moved=True) for n in (1, 3, 5))
"""Layouts for emitters of unknown geometry: see `coaxial`."""
FREE = tuple(Layout(kind, 7, 1.0, 0.0, moved=True) for kind in FREE_KINDS)
"""The same, of any shape: see `clusters`."""
LEAST_GAIN = 0.08
"""Fraction by which more dipoles must lower the predictive error to be chosen: below the noise it
changes no pose, while tracking takes time in proportion to the dipoles."""
SHAPE_GAIN = 0.06
"""Fraction by which emitters of any shape must lower it: sensors' errors that are not estimated
made 5 % with coils and magnets that have an axis, an AC tracker's own shape 7 % and more."""
LOSS_FOR_A_THIRD = 1.15
"""Factor by which a finalist's predictive error may be larger if it has a third of the dipoles.
Where a scan has gaps, some percent of the error of blocks, most of it noise, are half of what the
field is wrong by in the gaps."""


class Selection(NamedTuple):
    """Holds the result of a search through layouts."""

    finalists: tuple[LayoutCandidate, ...]  # among which a fit from the start decides
    candidates: tuple[LayoutCandidate, ...]  # all that were scored
    reference: MomentFit  # of the rich layer that corrected the poses


def choose_layout(
    measurements: Sequence[Measurements],
    folds: Sequence[Integers],
    generator: Generator,
    accuracy: Accuracy,
    progress: Progress | None = None,
    asked: Layout | None = None,
) -> Selection:
    """Search the layouts, or one asked for, and the dampings with the least held-out error.

    Raises `FitError` when there are fewer readings than the smallest layout has dipoles.
    """
    rows = sum(int(m.usable.sum()) for m in measurements)
    if rows < COUNTS[0] ** 2:
        raise FitError(
            f'the smallest layout has {COUNTS[0] ** 2} dipoles and needs as many readings, '
            f'got {rows}'
        )
    most = max(DIPOLES_PER_READING * rows, ALWAYS_AFFORDABLE)
    affordable = [n for n in COUNTS if n * n <= most]
    rich = rich_layout(measurements, generator)
    if rows < rich.count**2:
        rich = replace(rich, count=affordable[-1])
    placer = LayoutPlacer(generator, measurements)
    bases = [place(rich, generator), *free_bases(measurements, generator)]
    sites = bases[0] if len(bases) == 1 else rich_fit(measurements, bases, accuracy)[0].dipoles
    scorer = LayoutScorer(measurements, folds, sites, accuracy, placer)
    search = _Search(scorer, generator, progress)
    if asked is not None:
        finalists = [search.score(asked)]
    else:
        best = search.best_layout(affordable, lowest_height(measurements, generator))
        finalists = [search.leanest(best), *search.other_finalists()]
    return Selection(tuple(finalists), tuple(search.tried.values()), scorer.reference)


class _Search:
    """The layouts as they are tried, each of them once."""

    def __init__(
        self, scorer: LayoutScorer, generator: Generator, progress: Progress | None
    ) -> None:
        self.scorer, self.generator, self.progress = scorer, generator, progress
        self.prior = 'none' if generator.nominal is None else 'nominal'
        self.tried: dict[Layout, LayoutCandidate] = {}

    def score(self, layout: Layout) -> LayoutCandidate:
        if layout not in self.tried:
            self.tried[layout] = self.scorer.score(layout)
            if self.progress is not None:
                # How many layouts will be tried is not known: the bar slows down towards its end.
                self.progress('layouts', 1.0 - 0.9 ** len(self.tried))
        return self.tried[layout]

    def best_of(self, best: LayoutCandidate, layouts: Sequence[Layout]) -> LayoutCandidate:
        return min([best, *(self.score(layout) for layout in layouts)], key=lambda c: c.score)

    def best_layout(self, counts: Sequence[int], height: float) -> LayoutCandidate:
        """Vary count, size, depth and kind in turn; ``height`` is the lowest sensor's, m."""
        middle = Layout('layer', counts[len(counts) // 2], EXTENSIONS[1], 0.0, self.prior)
        best = self.climb(middle, counts)
        best = self.best_of(best, [replace(best.layout, extension=e) for e in EXTENSIONS])
        best = self.climb(best.layout, counts)
        best = self.best_of(best, [replace(best.layout, depth_m=d * height) for d in DEPTHS])
        return self.best_of(best, self._other_kinds(best.layout))

    def _other_kinds(self, layer: Layout) -> list[Layout]:
        # A layer of three-component dipoles with about as many columns as the layer has.
        triple = max(SMALLEST_TRIPLE, round(layer.count / np.sqrt(3.0)))
        others = [replace(layer, kind='layer_xyz', count=triple)]
        others += [Layout('coils', n, 1.0, 0.0, self.prior) for n in (2, 3, 4)]
        if self.generator.nominal is not None:
            others.append(replace(layer, prior='none'))
        return [o for o in others if len(place(o, self.generator)) <= MOST_DIPOLES]

    def other_finalists(self) -> list[LayoutCandidate]:
        """Return the drawn coils, or what stands for those without a drawing, moved."""
        if self.generator.nominal is None:
            # A few dipoles more cost a tracker nothing: the best of them, not the leanest.
            axial, free = (min(map(self.score, k), key=lambda c: c.score) for k in (COAXIAL, FREE))
            # What has an axis keeps it unless that is clearly wrong.
            is_clear = free.score * (1.0 + SHAPE_GAIN) < axial.score
            return [free if is_clear else axial]
        count = len(self.generator.nominal.positions)
        if is_of_coils(self.generator.nominal) and count <= MOST_DIPOLES:
            return [self.score(Layout('drawing', count, 1.0, 0.0, self.prior, True))]
        return []

    def climb(self, start: Layout, counts: Sequence[int]) -> LayoutCandidate:
        """Try finer layers as long as that helps; if none helps, coarser ones."""
        best = self.score(start)
        for direction in (1, -1):
            before, index = best, counts.index(best.layout.count)
            while 0 <= index + direction < len(counts):
                index += direction
                other = self.score(replace(start, count=counts[index]))
                if other.score >= best.score:
                    break
                best = other
            if best is not before:
                break
        return best

    def leanest(self, best: LayoutCandidate) -> LayoutCandidate:
        """Return the layout with the fewest dipoles that is as good within `LEAST_GAIN`."""
        limit = best.score * (1.0 + LEAST_GAIN)
        index = EXTENSIONS.index(best.layout.extension)
        for extension in EXTENSIONS[max(index - 1, 0) : index + 1]:
            size = replace(best.layout, extension=extension)
            for count in (n for n in reversed(COUNTS) if n < best.layout.count):
                if self.score(replace(size, count=count)).score > limit:
                    break
        good = [c for c in self.tried.values() if c.score <= limit]
        return min(good, key=lambda c: (len(c.dipoles), c.score))
