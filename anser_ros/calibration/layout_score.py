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
from anser_ros.calibration.layout_fit import optimise_positions, prior_of
from anser_ros.calibration.layouts import Layout
from anser_ros.calibration.moments import MomentFit, MomentFitter
from anser_ros.calibration.pose_correction import pose_precision, pose_terms
from anser_ros.calibration.pose_whitening import PoseWhitener
from anser_ros.calibration.prior import DrawnBoard
from anser_ros.calibration.readings import with_pose
from anser_ros.field.measurements import Measurements
from anser_ros.parallel import in_order
from anser_ros.settings import Accuracy

Array = NDArray[np.float64]

DAMPINGS = (1e-6, 1e-5, 3e-5, 1e-4, 3e-4, 1e-3, 3e-3, 1e-2)
"""Dampings that are tried, as a fraction of the largest singular value of the scaled matrix. The
smallest is far above the rounding of a Gram matrix (1e-8); beyond the largest only the drawn board
would be left."""
REFERENCE_DAMPING = DAMPINGS[1]
"""Damping of the fit by which poses are corrected before layouts are compared: small, so that the
field is not biased, and enough to hold a rich layer."""


@dataclass(frozen=True)
class LayoutCandidate:
    """Holds a layout with its best damping and its score on held-out blocks.

    Attributes
    ----------
    layout : Layout
        The layout that was scored.
    dipoles : DipoleSites
        Its dipoles as placed, before any of them are moved.
    damping : float
        The damping with the best score.
    score : float
        Square root of the mean predictive chi-square a phasor component, times the noise, T.
    curve : tuple of (float, float)
        Damping and score (T) for every damping that was tried.
    """

    layout: Layout
    dipoles: DipoleSites
    damping: float
    score: float
    curve: tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class _BodyReadings:
    """One body's readings at corrected poses with what the score of each fold needs.

    ``back`` (F, S, 2K) is the part that the correction of the pose subtracted from each reading,
    T.
    """

    corrected: Measurements
    folds: NDArray[np.int64]
    weights: Array
    back: Array
    whiteners: dict[int, PoseWhitener]


def _body_readings(
    corrected: Measurements,
    measured: Measurements,
    folds: NDArray[np.int64],
    weights: Array,
    dipoles: DipoleSites,
    fit: MomentFit,
    accuracy: Accuracy,
) -> _BodyReadings:
    terms = pose_terms(corrected, dipoles, fit.moments)
    # The correction is undone to first order, since predictions are judged at measured poses.
    at_measured = pose_terms(measured, dipoles, fit.moments).residual
    whiteners = {
        int(fold): PoseWhitener(
            terms.slope[folds == fold], weights[folds == fold], fit.noise_t,
            pose_precision(accuracy),
        )
        for fold in np.unique(folds)
    }  # fmt: skip
    return _BodyReadings(corrected, folds, weights, at_measured - terms.residual, whiteners)


class LayoutScorer:
    """Scores layouts on one set of measurements.

    Parameters
    ----------
    measurements : sequence of Measurements
        Tool measurements with poses, one per body and session.
    folds : sequence of ndarray, shape (F,)
        Fold of each frame.
    reference : DipoleSites
        A rich set of dipoles for the correction of the poses.
    accuracy : Accuracy
        Flux noise and pose jitter.
    """

    def __init__(
        self,
        measurements: Sequence[Measurements],
        folds: Sequence[NDArray[np.int64]],
        reference: DipoleSites,
        accuracy: Accuracy,
    ) -> None:
        kept = [m.usable.any(axis=1) for m in measurements]
        posed = [with_pose(m) for m in measurements]
        fitter = MomentFitter(posed, reference, REFERENCE_DAMPING, accuracy)
        self.reference = fitter.fit(exact=False)
        self.noise_t = self.reference.noise_t
        self._bodies = [
            _body_readings(c, m, f[k], w, reference, self.reference, accuracy)
            for c, m, f, k, w in zip(
                self.reference.measurements, posed, folds, kept, self.reference.weights,
                strict=True,
            )
        ]  # fmt: skip
        self._folds = np.unique(np.concatenate([body.folds for body in self._bodies]))

    def score(
        self,
        layout: Layout,
        dipoles: DipoleSites,
        drawn: DrawnBoard | None = None,
    ) -> LayoutCandidate:
        """Return the held-out score of a layout for every damping, with the best one.

        Movable dipoles are fitted again for each fold, to the data of the other folds.

        Parameters
        ----------
        layout : Layout
            The layout.
        dipoles : DipoleSites
            Its dipoles as placed.
        drawn : DrawnBoard, optional
            The drawn board, for layouts pulled towards it.
        """
        prior = prior_of(layout, dipoles, drawn)
        same = None if layout.moved else self._tables(dipoles)

        def scored(fold: int) -> tuple[Array, float]:
            chi, count = np.zeros(len(DAMPINGS)), 0.0
            sites, moments_prior = dipoles, prior
            if layout.moved:
                sites, moments_prior = self._moved_without(fold, dipoles, prior, layout, drawn)
            matrices, grams = same or self._tables(sites)
            start = None if moments_prior is None else as_real(moments_prior) / self.noise_t
            total = sum(gram for other, gram in grams.items() if other != fold)
            moments = _ridge(np.asarray(total), len(sites), start)
            for body, matrix in zip(self._bodies, matrices, strict=True):
                if fold not in body.whiteners:
                    continue
                part, used = self._chi(body, matrix, fold, moments)
                chi, count = chi + part, count + used
            return chi, count

        parts = in_order(scored, [int(fold) for fold in self._folds])
        chi = np.sum([part for part, _ in parts], axis=0)
        scores = self.noise_t * np.sqrt(chi / sum(count for _, count in parts))
        best = int(np.argmin(scores))
        curve = tuple(zip(DAMPINGS, map(float, scores), strict=True))
        return LayoutCandidate(layout, dipoles, DAMPINGS[best], float(scores[best]), curve)

    def _tables(self, dipoles: DipoleSites) -> tuple[list[Array], dict[int, Array]]:
        matrices = [basis_rows(body.corrected, dipoles) for body in self._bodies]
        folds = [int(fold) for fold in self._folds]
        grams = in_order(lambda fold: self._gram(fold, matrices), folds)
        return matrices, dict(zip(folds, grams, strict=True))

    def _moved_without(
        self,
        fold: int,
        dipoles: DipoleSites,
        prior: ComplexArray | None,
        layout: Layout,
        drawn: DrawnBoard | None,
    ) -> tuple[DipoleSites, ComplexArray | None]:
        kept = [body.folds != fold for body in self._bodies]
        return optimise_positions(
            [body.corrected.frames(k) for body, k in zip(self._bodies, kept, strict=True)],
            [body.weights[k] for body, k in zip(self._bodies, kept, strict=True)],
            dipoles,
            prior,
            layout,
            drawn,
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
