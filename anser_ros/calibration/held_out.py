"""Says how well a model predicts a block of space it was not fitted to, and where a scan has
gaps. There are two figures for every block: the residual at the measured pose, as in the
article, whose largest part is the jitter of the pose times the gradient of the field, and the
residual with the pose marginalised (`PoseWhitener`). The covariance of damped moments is
largest where no reading was: it tells gaps from places that were scanned (`gaps_of`), but is
too small, for what a layout cannot represent is not random. The held-out blocks say by which
factor.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from anser_ros.arrays import Array, ComplexArray, Integers, as_complex
from anser_ros.calibration import readings
from anser_ros.calibration.layout_fit import LayoutFit
from anser_ros.calibration.moments import (
    MomentFit,
    PoseTerms,
    PoseWhitener,
    pose_precision,
    pose_terms,
)
from anser_ros.field.measurements import Measurements, frame_power
from anser_ros.field.model import ScanGaps
from anser_ros.parallel import in_order
from anser_ros.physics.dipole import flux_basis
from anser_ros.physics.sensor import along_each_axis
from anser_ros.settings import Accuracy

GRID = (7, 7, 4)
"""Places along x, y and z of the scanned box at which the field's uncertainty is looked at."""
MARGIN_M = 0.01
"""Way beyond that box, m: a session goes about as far as its scan, not exactly."""
MOST_MODES = 24
"""Combinations of moments at most; each costs the model's file a number a dipole."""
LEAST_MODE_FLUX = 0.1
"""Largest flux of a mode at any place, relative to the flux noise, below which it is left out."""
DIGITS = 5
"""Digits after the first of the largest moment: an uncertainty needs no more."""
FEWEST_HELD_OUT_FRAMES = 20
"""Held-out frames at least from which a factor is taken."""


def open_moments(fitted: LayoutFit, damping: float) -> Array:
    """Return a factor (N, N) of the moments' covariance, A m^2: a column for each mode."""
    fit, gram = fitted.fit, np.zeros((len(fitted.dipoles),) * 2)
    for part, weights in zip(fit.measurements, fit.weights, strict=True):
        for block in readings.frame_blocks(*weights.shape):
            root = np.sqrt(weights[block].reshape(-1, 1))
            rows = root * readings.basis_rows(part.frames(block), fitted.dipoles)
            gram += rows.T @ rows
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    values, vectors = np.linalg.eigh(gram / np.outer(scale, scale))
    size = np.sqrt(np.maximum(values, 0.0) + damping**2 * values[-1])
    return np.asarray(fit.noise_t * vectors / size / scale[:, None])


def expected_power(moments: Array, sites: readings.DipoleSites, frames: Measurements) -> Array:
    """Return by how much frames may be off by what `open_moments` is of dipoles, (F,), T^2."""
    flux = readings.basis_rows(frames, sites) @ moments
    return np.asarray((flux**2).sum(axis=1).reshape(len(frames.time), -1).mean(axis=1))


def factor_of(expected: Array, found: Array) -> float:
    """Return by which factor errors of held-out frames are larger than expected, at least one.

    ``expected``, ``found`` (F,): variances of a phasor component, T^2. The half of the frames with
    the larger expected ones counts: elsewhere what is found is noise.
    """
    if expected.size < FEWEST_HELD_OUT_FRAMES:
        return 1.0
    large = expected >= np.median(expected)
    return float(np.sqrt(max(np.median(found[large] / expected[large]), 1.0)))


def gaps_of(
    fitted: LayoutFit, damping: float, measurements: Sequence[Measurements], factor: float
) -> ScanGaps | None:
    """Return what a fit leaves open of the field in and about the volume that was scanned.

    ``fitted``: of the whole scan. ``factor``: by which errors are larger than the moments'
    covariance says (`factor_of`).
    Returns none where no place is uncertain by more than a share of the noise.
    """
    points = np.concatenate([m.placed()[0][m.usable] for m in measurements])
    low, high = points.min(axis=0) - MARGIN_M, points.max(axis=0) + MARGIN_M
    lines = [np.linspace(a, b, n) for a, b, n in zip(low, high, GRID, strict=True)]
    places = np.stack(np.meshgrid(*lines, indexing='ij'), axis=-1).reshape(-1, 3)
    at, axes = along_each_axis(places)
    sites = fitted.dipoles
    basis = flux_basis(at, axes, np.zeros(len(axes)), sites.positions, sites.directions)
    root = factor * open_moments(fitted, damping)
    turned = root @ np.linalg.svd(basis @ root, full_matrices=False)[2][:MOST_MODES].T
    made = basis @ turned
    keep = np.abs(made).max(axis=0) > LEAST_MODE_FLUX * fitted.fit.noise_t
    if not keep.any():
        return None
    moments = turned.T[keep]
    decimals = DIGITS - int(np.floor(np.log10(np.abs(moments).max())))
    return ScanGaps(sites.positions, sites.directions, np.round(moments, decimals))


@dataclass(frozen=True)
class HeldOut:
    """Holds residuals of blocks that took no part in the fit that predicts them."""

    # (P, K): measured minus predicted flux of every usable reading at the measured pose, T
    error: ComplexArray
    left_over: ComplexArray  # (P, K): the part that no pose explains, T
    chi_square: float  # mean predictive chi-square of a phasor component
    noise_t: float  # noise of a phasor component in the covariance C, T
    flux_noise_t: float  # flux noise alone, T a component; at most what the imaginary parts leave
    # standard deviation of the field model's own error in the median held-out frame, T a phasor
    # component, with the noise subtracted
    flux_error_t: float
    n_dipoles: int  # number of dipoles of the model that was tested
    place: Array  # (F, 3): where each frame's body was, m, frame fg
    frame_rmse_t: Array  # (F,): root mean square magnitude of each frame's ``error``, T
    # by which errors are larger than the covariance of the fitted moments makes them; one where
    # they were not compared
    gap_factor: float = 1.0
    error_share: float = 0.0  # of a strong flux, by which the field errs more than elsewhere

    @property
    def score_t(self) -> float:
        """Return the root mean chi-square times the noise, T, to compare fits of other noise."""
        return float(self.noise_t * np.sqrt(self.chi_square))


def predict_held_out(
    measurements: Sequence[Measurements],
    folds: Sequence[Integers],
    fit: Callable[[int], LayoutFit],
    accuracy: Accuracy,
    reference: MomentFit,
    damping: float | None = None,
) -> HeldOut:
    """Predict each fold by a fit to the other folds.

    ``fit``: fits a model to the other folds than one. ``reference``: whose noise the jitter is
    weighed with and is subtracted. ``damping``: of the moments, if they are damped alike
    everywhere: then it is said by which factor errors are larger than their covariance makes them.
    """
    blocks = np.unique(np.concatenate(list(folds))).tolist()
    fits = in_order(fit, blocks)
    noise_t, flux_noise_t = reference.noise_t, reference.quadrature_noise_t
    tally = HeldOutTally(noise_t, min(noise_t, flux_noise_t), accuracy, len(fits[0].dipoles))
    for fold, part_fit in zip(blocks, fits, strict=True):
        left = None if damping is None else open_moments(part_fit, damping)
        for m, f in zip(measurements, folds, strict=True):
            test = readings.with_pose(m.frames(f == fold))
            for block in readings.frame_blocks(len(test.time), len(test.sensors)):
                part = test.frames(block)
                terms = pose_terms(part, part_fit.dipoles, part_fit.fit.moments)
                expected = None if left is None else expected_power(left, part_fit.dipoles, part)
                tally.add(terms, readings.usable_weights(part), part.position, expected, part.flux)
    return tally.result()


class HeldOutTally:
    """Gathers held-out residuals of all folds and sums them up, into a `HeldOut`."""

    def __init__(
        self, noise_t: float, flux_noise_t: float, accuracy: Accuracy, n_dipoles: int
    ) -> None:
        self.noise_t, self.flux_noise_t, self.n_dipoles = noise_t, flux_noise_t, n_dipoles
        self.precision = pose_precision(accuracy)
        self._parts: list[tuple[Array, ...]] = []

    def add(
        self,
        terms: PoseTerms,
        weights: Array,
        place: Array,
        expected: Array | None = None,
        flux: ComplexArray | None = None,
    ) -> None:
        """Take in frames at places (F, 3), m, whose errors should have the power (F,), T^2.

        ``flux`` (F, S, K), T: what was read there.
        """
        residual = terms.residual
        if residual.shape[0] == 0:
            return
        white = PoseWhitener(terms.slope, weights, self.noise_t, self.precision)
        used = weights > 0.0
        power = (residual**2).sum(axis=2) * used / (residual.shape[2] / 2.0)
        self._parts.append(
            (
                residual[used],
                white.left_over(residual)[used],
                white.chi_square(residual),
                white.excess_power(residual, self.flux_noise_t),
                place,
                power.sum(axis=1) / np.maximum(used.sum(axis=1), 1),
                np.zeros(0) if expected is None else expected,
                np.zeros(0) if flux is None else frame_power(flux),
            )
        )

    def result(self) -> HeldOut:
        """Return the figures of all frames that were taken in."""
        error, left, chi, excess, place, power, expected, read = map(
            np.concatenate, zip(*self._parts, strict=True)
        )
        typical = max(float(np.median(excess)), 0.0)
        strong, share = read > np.median(read) if read.size else np.zeros(0, dtype=bool), 0.0
        if strong.sum() >= FEWEST_HELD_OUT_FRAMES:
            share = float(np.median((excess[strong] - typical) / read[strong]))
        return HeldOut(
            error=as_complex(error),
            left_over=as_complex(left),
            chi_square=float(chi.sum()) / error.size,
            noise_t=self.noise_t,
            flux_noise_t=self.flux_noise_t,
            # The median leaves out outliers and the frames beyond the edge of what was fitted.
            flux_error_t=float(np.sqrt(typical)),
            n_dipoles=self.n_dipoles,
            place=place,
            frame_rmse_t=np.sqrt(power),
            gap_factor=factor_of(expected, excess) if expected.size else 1.0,
            error_share=float(np.sqrt(max(share, 0.0))),
        )


def rms(error: ComplexArray) -> float:
    """Return the root of the mean squared magnitude of complex errors."""
    return float(np.sqrt(np.mean(np.abs(error) ** 2)))
