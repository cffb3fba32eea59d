"""Corrects the jitter of optical poses by the fluxes of all sensors, or marginalises it. The
jitter of a frame's pose shifts and turns all sensors of the body together. To first order it
changes the frame's fluxes along six known directions, the columns of J (the derivatives of the
fluxes by the pose). Given a field, a frame has a most probable pose (`most_probable_step`).
With flux noise sigma and the covariance S of the jitter, the covariance of the frame's readings
is ``C = sigma^2 I + J S J^T``, and what stays of residuals is the part that no pose explains
(`PoseWhitener`).
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from anser_ros.calibration.least_squares import as_real
from anser_ros.calibration.readings import DipoleSites, flux_slopes
from anser_ros.field.measurements import Measurements
from anser_ros.settings import Accuracy

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

OUTLIER_SCALE = 3.0
"""Residuals larger than this many times the median residual lose weight. A smaller value takes
weight from good readings, a larger one lets bad readings pull at the fit."""
SMALLEST_NOISE_T = 1e-13
"""Lower bound of an estimated noise, T a phasor component. It keeps divisions finite for data
without noise and is far below the tens of picotesla of real electronics."""


def pose_precision(accuracy: Accuracy) -> Array:
    """Return the inverse variances of the six pose parameters, shape (6,), 1/m^2 and 1/rad^2.

    A jitter of zero counts as 1e-12, so that the pose stays fixed.
    """
    return np.asarray(1.0 / np.maximum(accuracy.pose_jitter, 1e-12) ** 2)


@dataclass(frozen=True)
class PoseTerms:
    """Holds residuals of the fluxes with their derivatives by the pose."""

    # (F, S, 2K): measured minus modelled flux, T; real and imaginary parts by turns
    residual: Array
    # (F, S, 2K, 6): derivative of the modelled flux by a shift (T/m) and a rotation (T/rad) of the
    # body, both in fg, the rotation about the body's origin
    slope: Array


def pose_terms(
    measurements: Measurements, dipoles: DipoleSites, moments: ComplexArray
) -> PoseTerms:
    """Evaluate a model at the poses of measurements."""
    points, axes = measurements.placed()
    flux, by_place, by_axis = flux_slopes(measurements, dipoles, moments)
    residual = (as_real(measurements.flux) - as_real(flux)).astype(np.float64)
    return PoseTerms(residual, pose_slopes(points, axes, measurements.position, by_place, by_axis))


def pose_slopes(
    points: Array, axes: Array, position: Array, by_place: ComplexArray, by_axis: ComplexArray
) -> Array:
    """Return the derivatives of fluxes by the body's pose, shape (F, S, 2K, 6).

    ``points``, ``axes`` (F, S, 3): sensor centres (m) and unit axes, frame fg; ``position``
    (F, 3): the body's origin, m. ``by_place``, ``by_axis`` (F, S, 3, K): derivatives by the
    sensors' centres (T/m) and axes (T).
    """
    place, turn = as_real(by_place), as_real(by_axis)
    arms = points - position[:, None, :]
    out = np.empty((*place.shape[:2], place.shape[3], 6))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[..., i] = place[:, :, i]
        # The cross products, in a small part of the time of `numpy.cross`.
        moved_by = arms[..., j, None] * place[:, :, k] - arms[..., k, None] * place[:, :, j]
        turned_by = axes[..., j, None] * turn[:, :, k] - axes[..., k, None] * turn[:, :, j]
        out[..., 3 + i] = moved_by + turned_by
    return out


def most_probable_step(
    terms: PoseTerms, weights: Array, noise_t: float, precision: Array, offset: Array | float = 0.0
) -> tuple[Array, Array]:
    """Return the step of each frame's pose to its most probable value.

    ``offset`` (F, 6): difference between the present pose and the measured one, m and rad.
    Returns the steps (F, 6), and the residuals (F, S, 2K) after them to first order, T.
    """
    step = PoseWhitener(terms.slope, weights, noise_t, precision).step(terms.residual, offset)
    return step, terms.residual - np.einsum('fsci,fi->fsc', terms.slope, step)


def moved(measurements: Measurements, step: Array) -> Measurements:
    """Return the measurements with their poses moved by ``step``, shape (F, 6), m and rad."""
    if len(step) == 0:
        return measurements
    turn = Rotation.from_rotvec(step[:, 3:]).as_matrix()
    return replace(
        measurements,
        position=measurements.position + step[:, :3],
        rotation=turn @ measurements.rotation,
    )


def outlier_weights(residual: Array, weights: Array) -> Array:
    """Return weights of the readings by the size of their residuals.

    Beyond `OUTLIER_SCALE` times the median size the weight falls with the square of the size, so
    that the influence of a gross outlier vanishes.
    """
    size = np.sqrt((residual**2).mean(axis=2))
    used = weights > 0.0
    if not used.any():
        return weights
    limit = OUTLIER_SCALE * max(float(np.median(size[used])), SMALLEST_NOISE_T)
    return np.where(used, np.minimum(1.0, (limit / np.maximum(size, limit)) ** 2), 0.0)


class PoseWhitener:
    """Keeps what weighted readings say of each frame's pose, and the inverse of its covariance C.

    By the matrix inversion lemma that takes a 6 x 6 matrix a frame (Golub and Van Loan, Matrix
    Computations, section 2.1.4).

    ``slope`` (F, S, 2K, 6): derivatives of the fluxes by the pose, as in `PoseTerms`.
    ``precision`` (6,) or (F, 6): inverse variances of the stated poses.
    """

    def __init__(self, slope: Array, weights: Array, noise_t: float, precision: Array) -> None:
        frames, _, parts, _ = slope.shape
        self.noise_t, self.stated = noise_t, precision
        self.root = np.repeat(np.sqrt(weights), parts, axis=1)
        self.slope = slope.reshape(frames, -1, 6) * (self.root / noise_t)[:, :, None]
        normal = self.slope.transpose(0, 2, 1) @ self.slope
        self.precision = normal + precision[..., None] * np.eye(6)
        self.inverse = np.linalg.inv(self.precision)
        self.share = np.asarray(self.inverse @ normal)
        self.readings = self.root.astype(bool).sum(axis=1)

    @property
    def freedom(self) -> float:
        """Return the effective number of pose parameters that all readings determine."""
        return float(np.trace(self.share, axis1=1, axis2=2).sum())

    def step(self, residual: Array, offset: Array | float = 0.0) -> Array:
        """Return the steps (F, 6) to the most probable poses; the rest as `most_probable_step`."""
        along = self._projected(residual)[1] - self.stated * offset
        return np.asarray(np.einsum('fij,fj->fi', self.inverse, along))

    def _projected(self, residual: Array) -> tuple[Array, Array]:
        """Return residuals in units of the noise (F, 2KS) and their products with J (F, 6)."""
        white = residual.reshape(self.root.shape) * self.root / self.noise_t
        return white, np.einsum('fri,fr->fi', self.slope, white)

    def chi_square(self, residual: Array) -> Array:
        """Return each frame's ``r^T C^-1 r``, shape (F,), of residuals (F, S, 2K) in T."""
        white, along = self._projected(residual)
        explained = np.einsum('fi,fij,fj->f', along, self.inverse, along)
        return np.asarray((white**2).sum(axis=1) - explained)

    def left_over(self, residual: Array) -> Array:
        """Return the part (F, S, 2K) of residuals that no pose explains, ``sigma^2 C^-1 r``."""
        white, along = self._projected(residual)
        step = np.einsum('fij,fj->fi', self.inverse, along)
        left = white - np.einsum('fri,fi->fr', self.slope, step)
        return np.asarray((left * self.noise_t).reshape(residual.shape))

    def excess_power(self, residual: Array, flux_noise_t: float | None = None) -> Array:
        """Estimate each frame's variance beyond noise and jitter.

        With ``W = sigma^2 C^-1``, white errors of variance v leave the power ``v tr(W^2)`` in the
        part that no pose explains. Flux noise leaves its variance times ``tr(W^2)`` as well, and
        the assumed jitter leaves ``sigma^2 (tr(W) - tr(W^2))``. The eigenvalues of W are one
        minus those of the matrix that tells how far the readings determine the pose parameters.

        ``residual`` is that at the measured poses; ``flux_noise_t`` without the jitter's part.
        Returns (F,): variance, T^2 a component; negative where the frame has less power than
        expected.
        """
        left = self.left_over(residual).reshape(self.root.shape)
        power = (left**2).sum(axis=1)
        taken = np.trace(self.share, axis1=1, axis2=2)
        square = np.einsum('fij,fji->f', self.share, self.share)
        first = self.readings - taken
        second = np.maximum(self.readings - 2.0 * taken + square, 1.0)
        noise = self.noise_t if flux_noise_t is None else flux_noise_t
        jitter = self.noise_t**2 * (first - second)
        return np.asarray((power - noise**2 * second - jitter) / second)
