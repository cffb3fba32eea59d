"""Fits moments of virtual dipoles to fluxes at poses that jitter (errors in variables). The
jitter of a frame's pose shifts and turns all sensors of the body together: to first order it
changes the frame's fluxes along six known directions, the columns of J (derivatives by the
pose). With flux noise sigma and the covariance S of the jitter, the readings have the
covariance ``C = sigma^2 I + J S J^T`` (`PoseWhitener`). The fit alternates between (a) the most
probable pose of every frame, from all its readings and the prior of the pose
(`most_probable_step`), and (b) damped least squares of the moments at those poses, which is the
article's equation (6) with one matrix and a right-hand side for every phasor component
(`MomentFitter`). Both steps reduce the same sum of squares (block coordinate descent on the
joint posterior). Readings that no pose explains lose weight (Huber, Robust Statistics). Only
the triangular factor of the rows so far is kept (Golub and Van Loan, section 5.3), so that
millions of rows take no more memory than a block.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.arrays import Array, ComplexArray, as_complex, as_real
from anser_ros.calibration import least_squares, readings
from anser_ros.errors import FitError
from anser_ros.field.measurements import Measurements
from anser_ros.settings import Accuracy

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
    # body, both in fg, the rotation about the body's origin; in memory (F, 6, S, 2K)
    slope: Array


def pose_terms(
    measurements: Measurements, dipoles: readings.DipoleSites, moments: ComplexArray
) -> PoseTerms:
    """Evaluate a model at the poses of measurements."""
    points, axes = measurements.placed()
    flux, by_place, by_axis = readings.flux_slopes(measurements, dipoles, moments)
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
    out = np.empty((len(place), 6, place.shape[1], place.shape[3]))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[:, i] = place[:, :, i]
        # The cross products, in a small part of the time of `numpy.cross`.
        moved_by = arms[..., j, None] * place[:, :, k] - arms[..., k, None] * place[:, :, j]
        turned_by = axes[..., j, None] * turn[:, :, k] - axes[..., k, None] * turn[:, :, j]
        np.add(moved_by, turned_by, out=out[:, 3 + i])
    return out.transpose(0, 2, 3, 1)


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
        self.noise_t, self.stated = noise_t, precision
        self.root = np.repeat(np.sqrt(weights), slope.shape[2], axis=1)
        by_pose = slope.transpose(0, 3, 1, 2).reshape(len(slope), 6, -1)
        self.slope = by_pose * (self.root / noise_t)[:, None]  # (F, 6, 2KS)
        normal = self.slope @ self.slope.transpose(0, 2, 1)
        self.precision = normal + precision[..., None] * np.eye(6)
        self.inverse = np.linalg.inv(self.precision)
        self.share = np.asarray(self.inverse @ normal)

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
        return white, (self.slope @ white[:, :, None])[:, :, 0]

    def chi_square(self, residual: Array) -> Array:
        """Return each frame's ``r^T C^-1 r``, shape (F,), of residuals (F, S, 2K) in T."""
        white, along = self._projected(residual)
        explained = np.einsum('fi,fij,fj->f', along, self.inverse, along)
        return np.asarray((white**2).sum(axis=1) - explained)

    def left_over(self, residual: Array) -> Array:
        """Return the part (F, S, 2K) of residuals that no pose explains, ``sigma^2 C^-1 r``."""
        white, along = self._projected(residual)
        step = np.einsum('fij,fj->fi', self.inverse, along)
        left = white - (step[:, None] @ self.slope)[:, 0]
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
        readings = np.count_nonzero(self.root, axis=1)
        first = readings - taken
        second = np.maximum(readings - 2.0 * taken + square, 1.0)
        noise = self.noise_t if flux_noise_t is None else flux_noise_t
        jitter = self.noise_t**2 * (first - second)
        return np.asarray((power - noise**2 * second - jitter) / second)


def damped_moments(
    factor: least_squares.TriangularFactor | least_squares.GramFactor,
    dipoles: readings.DipoleSites,
    dampings: Sequence[float],
    prior: Array | None,
) -> tuple[Array, list[least_squares.Spectrum]]:
    """Return the moments (D, N, 2K) for D dampings, and the spectrum of each group of emitters.

    ``factor``: of the dipoles' readings. ``prior`` (N, 2K): what damping pulls to; None for zero.
    """
    out, spectra = np.zeros((len(dampings), len(dipoles), factor.right_sides)), []
    for emitters, rows in dipoles.groups(factor.right_sides // 2):
        parts = np.repeat(2 * np.array(emitters), 2) + np.tile([0, 1], len(emitters))
        spectra.append(factor.spectrum(rows))
        start = None if prior is None else prior[rows]
        for moments, damping in zip(out, dampings, strict=True):
            moments[np.ix_(rows, parts)] = spectra[-1].solve(damping, start)[:, parts]
    return out, spectra


Progress = Callable[[str, float], None]

CONVERGED = 2e-3
"""Relative change of the noise estimate below which the alternation ends."""
LEAST_FREEDOM = 0.05
"""Least degrees of freedom of the residual, as a fraction of the phasor components: a bound for
fits with nearly as many parameters as readings."""


@dataclass(frozen=True, kw_only=True)
class FitFigures:
    """Says how well a fit of moments went."""

    weights: tuple[Array, ...]
    # root mean square residual of a phasor component, corrected for the degrees of freedom, T. It
    # holds the flux noise and all that the model cannot explain.
    noise_t: float
    rank: int  # of the matrix, numerically
    freedom: float  # effective number of parameters of each right-hand side
    condition: float  # of the column-scaled matrix
    alternations: int  # number of rounds


@dataclass(frozen=True, kw_only=True)
class MomentFit(FitFigures):
    """Holds fitted moments with their residual noise and condition."""

    moments: ComplexArray
    measurements: tuple[Measurements, ...]  # at their corrected poses
    # the noise of the imaginary parts alone. Where no metal turns the phase, the field is in
    # phase, and this is the flux noise whatever the errors of poses and model.
    quadrature_noise_t: float


@dataclass
class _State:
    """One body's measurements with the pose offsets and weights of the present round."""

    measured: Measurements
    corrected: Measurements
    offset: Array
    weights: Array
    usable: Array


class MomentFitter:
    """Alternates between the poses of the frames and the moments of the dipoles.

    Raises `FitError` when no reading has a pose.
    """

    def __init__(
        self,
        measurements: Sequence[Measurements],
        dipoles: readings.DipoleSites,
        damping: float,
        accuracy: Accuracy,
        prior: ComplexArray | None = None,
    ) -> None:
        self.dipoles, self.damping, self.accuracy = dipoles, damping, accuracy
        self.prior = None if prior is None else as_real(prior)
        self.noise_t = self.quadrature_noise_t = accuracy.flux_noise_t
        self.states = [self._state(readings.with_pose(m)) for m in measurements]
        count = sum(int(state.usable.sum()) for state in self.states)
        if count == 0:
            raise FitError('no reading has a pose: a fit needs fluxes and poses of the same time')
        self.emitters = int(self.states[0].measured.flux.shape[2])

    @staticmethod
    def _state(measured: Measurements) -> _State:
        usable = readings.usable_weights(measured)
        offset = np.zeros((len(measured.time), 6))
        return _State(measured, measured, offset, usable.copy(), usable)

    def start_at(self, other: 'MomentFitter') -> None:
        """Begin with the poses, weights and noise to which another fit of these readings came."""
        self.noise_t, self.quadrature_noise_t = other.noise_t, other.quadrature_noise_t
        self.states = [
            replace(state, offset=state.offset.copy(), weights=state.weights.copy())
            for state in other.states
        ]

    def solve(self, exact: bool = True) -> tuple[ComplexArray, list[least_squares.Spectrum]]:
        """Return the moments (N, K) at the present poses and weights, with each group's spectrum.

        With ``exact`` they are solved by QR, otherwise by inner products, which is faster.
        """
        kind = least_squares.TriangularFactor if exact else least_squares.GramFactor
        factor = kind(len(self.dipoles), 2 * self.emitters)
        for state in self.states:
            count, sensors = state.weights.shape
            for block in readings.frame_blocks(count, sensors):
                part = state.corrected.frames(block)
                root = np.sqrt(state.weights[block].reshape(-1, 1))
                right = as_real(part.flux).reshape(-1, 2 * self.emitters)
                factor.add(root * readings.basis_rows(part, self.dipoles), root * right)
        moments, spectra = damped_moments(factor, self.dipoles, (self.damping,), self.prior)
        return as_complex(moments[0]), spectra

    def freedom(self, spectra: Sequence[least_squares.Spectrum]) -> float:
        """Return the effective number of parameters of an emitter."""
        return float(np.mean([spectrum.freedom(self.damping) for spectrum in spectra]))

    def correct(self, moments: ComplexArray, freedom: float) -> float:
        """Move all poses to their most probable values and return the new noise estimate, T.

        ``freedom`` is the effective number of parameters of each right-hand side.
        """
        power, turned, count, used = 0.0, 0.0, 0.0, 0.0
        precision = pose_precision(self.accuracy)
        for state in self.states:
            for block in readings.frame_blocks(*state.weights.shape):
                part = state.corrected.frames(block)
                terms = pose_terms(part, self.dipoles, moments)
                step, left = most_probable_step(
                    terms, state.weights[block], self.noise_t, precision, state.offset[block]
                )
                state.offset[block] += step
                state.weights[block] = outlier_weights(left, state.usable[block])
                weight = state.weights[block]
                power += float((weight[:, :, None] * left**2).sum())
                turned += float((weight[:, :, None] * left[:, :, 1::2] ** 2).sum())
                count += float(weight.sum()) * left.shape[2]
                used += PoseWhitener(terms.slope, weight, self.noise_t, precision).freedom
            state.corrected = moved(state.measured, state.offset)
        left_over = max(count - used - freedom * 2 * self.emitters, LEAST_FREEDOM * count)
        halved = max(count / 2.0 - freedom * self.emitters, LEAST_FREEDOM / 2.0 * count)
        self.quadrature_noise_t = max(float(np.sqrt(turned / halved)), SMALLEST_NOISE_T)
        return max(float(np.sqrt(power / left_over)), SMALLEST_NOISE_T)

    def fit(
        self, alternations: int = 5, progress: Progress | None = None, exact: bool = True
    ) -> MomentFit:
        """Alternate until the noise estimate no longer changes; the last solution may be exact."""
        done = 0
        moments, spectra = self.solve(exact=False)
        for done in range(1, alternations + 1):
            before = self.noise_t
            self.noise_t = self.correct(moments, self.freedom(spectra))
            last = done == alternations or (
                done > 1 and abs(before - self.noise_t) < CONVERGED * self.noise_t
            )
            moments, spectra = self.solve(exact=exact and last)
            if progress is not None:
                progress('moments', done / alternations)
            if last:
                break
        values = [spectrum.values for spectrum in spectra]
        return MomentFit(
            moments=moments,
            measurements=tuple(state.corrected for state in self.states),
            weights=tuple(state.weights for state in self.states),
            noise_t=self.noise_t,
            quadrature_noise_t=self.quadrature_noise_t,
            rank=sum(spectrum.rank for spectrum in spectra),
            freedom=self.freedom(spectra),
            condition=max(float(v[0] / max(v[-1], np.finfo(float).tiny)) for v in values),
            alternations=done,
        )
