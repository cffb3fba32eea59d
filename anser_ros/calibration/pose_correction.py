"""Poses that jitter: the most probable correction of each frame, and what it leaves."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from anser_ros.calibration.dipole_sites import DipoleSites
from anser_ros.calibration.factors import as_real
from anser_ros.field.measurements import Measurements
from anser_ros.physics.dipole import flux_jacobian

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

BLOCK_ROWS = 8192
"""Readings that are in memory at a time as rows of the matrix."""
OUTLIER_SCALE = 3.0
"""A reading this many times the typical residual begins to lose weight."""
SMALLEST_NOISE_T = 1e-13


@dataclass(frozen=True)
class Uncertainty:
    """What the measurements are uncertain by, one standard deviation.

    Attributes
    ----------
    flux_t : float
        Noise of a phasor component, T; the start value where the fit estimates it.
    position_m, rotation_rad : float
        Jitter of the pose, per axis.
    """

    flux_t: float = 60e-12
    position_m: float = 0.07e-3
    rotation_rad: float = 0.4e-3

    @property
    def pose_precision(self) -> Array:
        """Inverse variances of the six pose parameters (1/m^2, 1/rad^2); without jitter, huge."""
        sigma = np.array([self.position_m] * 3 + [self.rotation_rad] * 3)
        return np.asarray(1.0 / np.maximum(sigma, 1e-12) ** 2)


def frame_blocks(count: int, sensors: int, rows: int = BLOCK_ROWS) -> list[slice]:
    """Slices of whole frames of at most ``rows`` readings each."""
    step = max(1, rows // max(1, sensors))
    return [slice(start, min(start + step, count)) for start in range(0, count, step)]


def usable_weights(measurements: Measurements) -> Array:
    """Weights (F, S): 1 where a reading has a pose and is valid, else 0."""
    return np.asarray(measurements.usable, dtype=np.float64)


def with_pose(measurements: Measurements) -> Measurements:
    """The frames that have a pose and at least one valid reading, unusable fluxes set to zero."""
    kept = measurements.frames(np.asarray(measurements.usable.any(axis=1)))
    flux = np.where(kept.usable[:, :, None], kept.flux, 0.0)
    return replace(kept, flux=flux)


@dataclass(frozen=True)
class PoseTerms:
    """Residuals and what a wrong pose does to them.

    Attributes
    ----------
    residual : ndarray, shape (F, S, 2K)
        Measured minus modelled, T.
    slope : ndarray, shape (F, S, 2K, 6)
        Derivative of the modelled flux by a shift (m) and a turn (rad) of the body, both in fg,
        the turn about the body's origin.
    """

    residual: Array
    slope: Array


def pose_terms(
    measurements: Measurements, dipoles: DipoleSites, moments: ComplexArray
) -> PoseTerms:
    """Evaluate the model at the measurements' poses."""
    points, axes = measurements.placed()
    frames, sensors = points.shape[:2]
    lengths = np.tile(measurements.sensors.length, frames)
    flux, by_place, by_axis = flux_jacobian(
        points.reshape(-1, 3), axes.reshape(-1, 3), lengths,
        dipoles.positions, dipoles.directions, moments,
    )  # fmt: skip
    shape = (frames, sensors, 2 * moments.shape[1])
    place = as_real(by_place).reshape(frames, sensors, 3, -1).transpose(0, 1, 3, 2)
    axis = as_real(by_axis).reshape(frames, sensors, 3, -1).transpose(0, 1, 3, 2)
    arms = (points - measurements.position[:, None, :])[:, :, None, :]
    turn = np.cross(np.broadcast_to(arms, place.shape), place)
    turn += np.cross(np.broadcast_to(axes[:, :, None, :], axis.shape), axis)
    residual = (as_real(measurements.flux) - as_real(flux).reshape(shape)).astype(np.float64)
    return PoseTerms(residual, np.concatenate([place, turn], axis=3))


class PoseWhitener:
    """The frames' covariance C, factored once for many residuals.

    Parameters
    ----------
    slope : ndarray, shape (F, S, 2K, 6)
        Derivatives of the fluxes by the pose.
    weights : ndarray, shape (F, S)
    noise_t : float
    precision : ndarray, shape (6,)
        Inverse variances of the pose.
    """

    def __init__(self, slope: Array, weights: Array, noise_t: float, precision: Array) -> None:
        frames, _, parts, _ = slope.shape
        self.noise_t = noise_t
        self.root = np.repeat(np.sqrt(weights), parts, axis=1)
        flat = slope.reshape(frames, -1, 6) * (self.root / noise_t)[:, :, None]
        normal = np.einsum('fri,frj->fij', flat, flat, optimize=True)
        self.inverse = np.linalg.inv(normal + np.diag(precision))
        self.slope = flat
        self.share = np.asarray(self.inverse @ normal)
        self.readings = self.root.astype(bool).sum(axis=1)

    def chi_square(self, residual: Array) -> Array:
        """Predictive chi-square of every frame, shape (F,), of residuals (F, S, 2K)."""
        white = residual.reshape(self.root.shape) * self.root / self.noise_t
        along = np.einsum('fri,fr->fi', self.slope, white)
        explained = np.einsum('fi,fij,fj->f', along, self.inverse, along)
        return np.asarray((white**2).sum(axis=1) - explained)

    def left_over(self, residual: Array) -> Array:
        """What no pose explains, T, shape (F, S, 2K), of residuals at the measured pose."""
        white = residual.reshape(self.root.shape) * self.root / self.noise_t
        along = np.einsum('fri,fr->fi', self.slope, white)
        step = np.einsum('fij,fj->fi', self.inverse, along)
        left = white - np.einsum('fri,fi->fr', self.slope, step)
        return np.asarray((left * self.noise_t).reshape(residual.shape))

    def excess_power(self, residual: Array, flux_noise_t: float | None = None) -> Array:
        """Estimate of each frame's variance beyond noise and jitter, T^2 a component, shape (F,).

        White errors of variance v leave the power v tr(W^2), W = sigma^2 C^-1, in what no pose
        explains; flux noise leaves its variance times tr(W^2) too, and jitter as assumed
        ``sigma^2 (tr(W) - tr(W^2))``. The eigenvalues of W are one minus those of the share of
        each pose parameter that the readings determine. The flux noise is sigma when not given.
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


def most_probable_step(
    terms: PoseTerms, weights: Array, noise_t: float, precision: Array, offset: Array
) -> tuple[Array, Array]:
    """Step of each frame's pose to its most probable value.

    Parameters
    ----------
    terms : PoseTerms
    weights : ndarray, shape (F, S)
    noise_t : float
    precision : ndarray, shape (6,)
        Inverse variances of the pose.
    offset : ndarray, shape (F, 6)
        How far the pose has been moved from the measured one already.

    Returns
    -------
    step : ndarray, shape (F, 6)
    residual : ndarray, shape (F, S, 2K)
        What is left after the step, T.
    """
    frames = terms.residual.shape[0]
    slope = terms.slope.reshape(frames, -1, 6) / noise_t
    weight = np.repeat(weights, terms.residual.shape[2], axis=1)
    weighted = slope * weight[:, :, None]
    normal = np.einsum('fri,frj->fij', weighted, slope, optimize=True) + np.diag(precision)
    residual = terms.residual.reshape(frames, -1)
    gradient = np.einsum('fri,fr->fi', weighted, residual / noise_t) - precision * offset
    step = np.linalg.solve(normal, gradient[:, :, None])[:, :, 0]
    left = residual - noise_t * np.einsum('fri,fi->fr', slope, step)
    return step, left.reshape(terms.residual.shape)


def moved(measurements: Measurements, step: Array) -> Measurements:
    """The measurements with every pose shifted and turned by ``step``, shape (F, 6)."""
    if len(step) == 0:
        return measurements
    turn = Rotation.from_rotvec(step[:, 3:]).as_matrix()
    return replace(
        measurements,
        position=measurements.position + step[:, :3],
        rotation=turn @ measurements.rotation,
    )


def outlier_weights(residual: Array, weights: Array) -> Array:
    """Weights (F, S) in [0, 1] by the size of each reading's residual, shape (F, S, 2K).

    The scale is the median size; beyond `OUTLIER_SCALE` of it the weight falls with the square, so
    that a gross outlier's pull vanishes.
    """
    size = np.sqrt((residual**2).mean(axis=2))
    used = weights > 0.0
    if not used.any():
        return weights
    limit = OUTLIER_SCALE * max(float(np.median(size[used])), SMALLEST_NOISE_T)
    return np.where(used, np.minimum(1.0, (limit / np.maximum(size, limit)) ** 2), 0.0)


def pose_freedom(terms: PoseTerms, weights: Array, noise_t: float, precision: Array) -> float:
    """Effective number of pose parameters that the readings of all frames determine."""
    frames = terms.residual.shape[0]
    slope = terms.slope.reshape(frames, -1, 6) / noise_t
    weight = np.repeat(weights, terms.residual.shape[2], axis=1)
    normal = np.einsum('fri,frj->fij', slope * weight[:, :, None], slope, optimize=True)
    share = np.linalg.solve(normal + np.diag(precision), normal)
    return float(np.trace(share, axis1=1, axis2=2).sum())
