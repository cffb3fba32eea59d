"""Computes held-out errors: how well a model predicts a block of space it was not fitted to.

There are two figures for every block. The first is the residual at the measured pose, as in the
article; its largest part is the jitter of the pose times the gradient of the field. The second is
the residual with the pose marginalised: with the covariance C of a frame's readings
(`pose_whitening`), ``r^T C^-1 r`` is the frame's predictive chi-square, and ``sigma^2 C^-1 r`` is
the part of the residual that no pose explains.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.factors import ComplexArray
from anser_ros.calibration.layout_fit import LayoutFit
from anser_ros.calibration.pose_correction import PoseTerms, pose_precision, pose_terms
from anser_ros.calibration.pose_whitening import PoseWhitener
from anser_ros.calibration.readings import frame_blocks, usable_weights, with_pose
from anser_ros.calibration.scan_gaps import expected_power, factor_of, open_moments
from anser_ros.field.measurements import Measurements
from anser_ros.parallel import in_order
from anser_ros.settings import Accuracy

Array = NDArray[np.float64]


@dataclass(frozen=True)
class HeldOut:
    """Holds residuals of blocks that took no part in the fit that predicts them.

    Attributes
    ----------
    error : ndarray, shape (P, K), complex
        Measured minus predicted flux of every usable reading at the measured pose, T.
    left_over : ndarray, shape (P, K), complex
        The part that no pose explains, T.
    chi_square : float
        Mean predictive chi-square of a phasor component.
    noise_t : float
        Noise of a phasor component in the covariance C, T.
    flux_noise_t : float
        Flux noise alone, T a component; at most what the imaginary parts leave.
    flux_error_t : float
        Standard deviation of the field model's own error in the median held-out frame, T a
        phasor component, with the noise subtracted.
    n_dipoles : int
        Number of dipoles of the model that was tested.
    place : ndarray, shape (F, 3)
        Where each frame's body was, m, frame fg.
    frame_rmse_t : ndarray, shape (F,)
        Root mean square magnitude of each frame's ``error``, T.
    gap_factor : float
        By which errors are larger than the covariance of the fitted moments makes them; one where
        they were not compared.
    """

    error: ComplexArray
    left_over: ComplexArray
    chi_square: float
    noise_t: float
    flux_noise_t: float
    flux_error_t: float
    n_dipoles: int
    place: Array
    frame_rmse_t: Array
    gap_factor: float = 1.0

    @property
    def score_t(self) -> float:
        """Return the root mean chi-square times the noise, T, to compare fits of other noise."""
        return float(self.noise_t * np.sqrt(self.chi_square))


def _complex_rows(values: Array, used: NDArray[np.bool_]) -> ComplexArray:
    return np.ascontiguousarray(values[used]).view(np.complex128)


def predict_held_out(
    measurements: Sequence[Measurements],
    folds: Sequence[NDArray[np.int64]],
    fit: Callable[[int], LayoutFit],
    accuracy: Accuracy,
    noise_t: float | None = None,
    flux_noise_t: float | None = None,
    damping: float | None = None,
) -> HeldOut:
    """Predict each fold by a fit to the other folds.

    Parameters
    ----------
    measurements : sequence of Measurements
        Tool measurements, one per body and session.
    folds : sequence of ndarray, shape (F,)
        Fold of each frame, an array for each of the measurements.
    fit : callable
        Fits a model to the other folds than one.
    accuracy : Accuracy
        Flux noise and pose jitter.
    noise_t : float, optional
        Noise of a phasor component, T, that noise and jitter are weighed with and that is
        subtracted; the smallest residual of any fold's fit by default.
    flux_noise_t : float, optional
        Flux noise alone, T a component, that is subtracted; estimated from the imaginary parts by
        default.
    damping : float, optional
        Of the moments, if they are damped alike everywhere: then it is said by which factor errors
        are larger than the moments' covariance makes them.
    """

    blocks = np.unique(np.concatenate(list(folds))).tolist()
    fits = in_order(fit, blocks)
    noise = min(part.fit.noise_t for part in fits) if noise_t is None else noise_t
    quadrature = min(part.fit.quadrature_noise_t for part in fits)
    flux_noise = min(noise, quadrature if flux_noise_t is None else flux_noise_t)
    tally = HeldOutTally(noise, flux_noise, accuracy, len(fits[0].dipoles))
    for fold, part_fit in zip(blocks, fits, strict=True):
        left = None if damping is None else open_moments(part_fit, damping)
        for m, f in zip(measurements, folds, strict=True):
            test = with_pose(m.frames(f == fold))
            for block in frame_blocks(len(test.time), len(test.sensors)):
                part = test.frames(block)
                terms = pose_terms(part, part_fit.dipoles, part_fit.fit.moments)
                expected = None if left is None else expected_power(left, part_fit.dipoles, part)
                tally.add(terms, usable_weights(part), part.position, expected)
    return tally.result()


class HeldOutTally:
    """Gathers held-out residuals of all folds and sums them up.

    Parameters
    ----------
    noise_t, flux_noise_t, accuracy, n_dipoles
        As in `HeldOut` and for `predict_held_out`.
    """

    def __init__(
        self, noise_t: float, flux_noise_t: float, accuracy: Accuracy, n_dipoles: int
    ) -> None:
        self.flux_noise_t, self.n_dipoles = flux_noise_t, n_dipoles
        self.noise_t, self.precision = noise_t, pose_precision(accuracy)
        self.error: list[ComplexArray] = []
        self.left: list[ComplexArray] = []
        self.chi: list[Array] = []
        self.excess: list[Array] = []
        self.place: list[Array] = []
        self.frame_power: list[Array] = []
        self.expected: list[Array] = []

    def add(
        self, terms: PoseTerms, weights: Array, place: Array, expected: Array | None = None
    ) -> None:
        """Take in frames with weights (F, S) of their readings, places (F, 3), m, and the power
        (F,), T^2, that their errors should have.
        """
        if terms.residual.shape[0] == 0:
            return
        white = PoseWhitener(terms.slope, weights, self.noise_t, self.precision)
        used = weights > 0.0
        self.error.append(_complex_rows(terms.residual, used))
        self.left.append(_complex_rows(white.left_over(terms.residual), used))
        self.chi.append(white.chi_square(terms.residual))
        emitters = terms.residual.shape[2] / 2.0
        power = (terms.residual**2).sum(axis=2) * used / emitters
        self.place.append(place)
        self.frame_power.append(power.sum(axis=1) / np.maximum(used.sum(axis=1), 1))
        self.excess.append(white.excess_power(terms.residual, self.flux_noise_t))
        if expected is not None:
            self.expected.append(expected)

    def result(self) -> HeldOut:
        """Return the figures of all frames that were taken in."""
        error, left = np.concatenate(self.error), np.concatenate(self.left)
        components = 2 * error.size
        # The median leaves out outliers and the frames beyond the edge of what was fitted.
        found = np.concatenate(self.excess)
        excess = float(np.median(found))
        return HeldOut(
            error=error,
            left_over=left,
            chi_square=float(np.concatenate(self.chi).sum()) / components,
            noise_t=self.noise_t,
            flux_noise_t=self.flux_noise_t,
            flux_error_t=float(np.sqrt(max(excess, 0.0))),
            n_dipoles=self.n_dipoles,
            place=np.concatenate(self.place),
            frame_rmse_t=np.sqrt(np.concatenate(self.frame_power)),
            gap_factor=factor_of(np.concatenate(self.expected), found) if self.expected else 1.0,
        )


def rms(error: ComplexArray) -> float:
    """Return the root of the mean squared magnitude of complex errors."""
    return float(np.sqrt(np.mean(np.abs(error) ** 2)))
