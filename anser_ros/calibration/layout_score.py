"""Scores layouts by predictive error for held-out blocks of space, for every damping at once.

All layouts are compared at the same poses (corrected once with a rich layer) and on the same
blocks of space. A layout costs one matrix: the rows of each fold are summed to a Gram matrix,
those of the other folds are added up, and the eigenvectors of the sum give the solutions for all
dampings. Squaring the condition does no harm here, where the smallest damping is far above the
rounding of the squares; the final fit uses QR. The score is the predictive chi-square of the
held-out frames with their poses marginalised, so that the jitter of the poses, much larger than
the flux noise, does not hide the differences between layouts.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.dipole_sites import DipoleSites, basis_rows
from anser_ros.calibration.factors import ComplexArray, as_real
from anser_ros.calibration.layout_fit import LayoutPlacer
from anser_ros.calibration.layouts import Layout
from anser_ros.calibration.moments import MomentFit, MomentFitter
from anser_ros.calibration.pose_correction import pose_precision, pose_terms
from anser_ros.calibration.pose_whitening import PoseWhitener
from anser_ros.calibration.readings import with_pose
from anser_ros.field.measurements import Measurements
from anser_ros.parallel import in_order
from anser_ros.settings import Accuracy

Array = NDArray[np.float64]

DAMPINGS = (1e-6, 1e-5, 3e-5, 1e-4, 3e-4, 1e-3, 3e-3, 1e-2)
"""Dampings that are tried: from far above the rounding of a Gram matrix (1e-8) to where only the
prior would be left."""
REFERENCE_DAMPING = DAMPINGS[1]
"""Damping of the fit by which poses are corrected before layouts are compared: small, so that the
field is not biased, and enough to hold a rich layer."""


@dataclass(frozen=True)
class LayoutCandidate:
    """Holds a layout with its best damping and its score on held-out blocks."""

    layout: Layout  # the layout that was scored
    dipoles: DipoleSites  # its dipoles as placed, before any of them are moved
    damping: float  # the damping with the best score
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
        self, corrected: Measurements, measured: Measurements, folds: NDArray[np.int64],
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
        folds: Sequence[NDArray[np.int64]],
        rich: DipoleSites,
        accuracy: Accuracy,
        placer: LayoutPlacer,
    ) -> None:
        self.placer = placer
        kept = [m.usable.any(axis=1) for m in measurements]
        posed = [with_pose(m) for m in measurements]
        self.reference = fit = MomentFitter(posed, rich, REFERENCE_DAMPING, accuracy).fit(
            exact=False
        )
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
            matrices, grams = same or self._tables(sites)
            start = None if prior is None else as_real(prior) / self.noise_t
            total = sum(gram for other, gram in grams.items() if other != fold)
            moments = _ridge(np.asarray(total), len(sites), start)
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

    def _tables(self, dipoles: DipoleSites) -> tuple[list[Array], dict[int, Array]]:
        matrices = [basis_rows(body.corrected, dipoles) for body in self._bodies]
        grams = in_order(lambda fold: self._gram(fold, matrices), self._folds)
        return matrices, dict(zip(self._folds, grams, strict=True))

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

    def _gram(self, fold: int, matrices: Sequence[Array]) -> Array:
        """Return a fold's Gram matrix of the matrix's N and the right-hand sides' 2K columns."""
        size = matrices[0].shape[1] + self._parts
        gram = np.zeros((size, size))
        for body, matrix in zip(self._bodies, matrices, strict=True):
            rows = np.repeat(body.folds == fold, len(body.corrected.sensors))
            root = np.sqrt(body.weights.reshape(-1, 1)[rows])
            right = as_real(body.corrected.flux).reshape(-1, self._parts)[rows]
            block = root * np.concatenate([matrix[rows], right / self.noise_t], axis=1)
            gram += block.T @ block
        return gram

    def _chi(
        self, body: _BodyReadings, matrix: Array, fold: int, moments: Array
    ) -> tuple[Array, float]:
        mask = body.folds == fold
        rows = np.repeat(mask, len(body.corrected.sensors))
        target = as_real(body.corrected.flux)[mask] + body.back[mask]
        held_out = matrix[rows]
        sums = [
            body.whiteners[fold].chi_square(target - (held_out @ m).reshape(target.shape)).sum()
            for m in moments * self.noise_t
        ]
        return np.array(sums), float(body.weights[mask].sum()) * target.shape[2]


def _ridge(gram: Array, unknowns: int, prior: Array | None) -> Array:
    """Return damped solutions (D, N, M) from a Gram matrix of columns and right-hand sides."""
    scale = np.sqrt(np.maximum(np.diag(gram)[:unknowns], 0.0))
    scale[scale == 0.0] = 1.0
    normal = gram[:unknowns, :unknowns] / np.outer(scale, scale)
    right = gram[:unknowns, unknowns:] / scale[:, None]
    if prior is not None:
        right = right - normal @ (prior * scale[:, None])
    values, vectors = np.linalg.eigh(normal)
    projected = vectors.T @ right
    least = (np.asarray(DAMPINGS) ** 2)[:, None] * values[-1]
    steps = vectors @ (projected / (np.maximum(values, 0.0) + least)[:, :, None])
    out = steps / scale[:, None]
    return np.asarray(out if prior is None else out + prior)
