"""Moments of virtual dipoles from fluxes at poses that jitter: errors in variables, by blocks.

Each optical pose is wrong by a few hundredths of a millimetre, and all sensors of the body and all
emitters see that error together, along six known directions. So the fit alternates between (a) the
most probable pose of every frame, from all its readings and the pose's prior, and (b) damped least
squares of the moments at those poses: the article's equation (6) with one matrix and a right-hand
side for every phasor component. Both steps lower the same sum of squares (block coordinate descent
on the joint posterior); readings that no pose explains lose weight (Huber, Robust Statistics).
The matrix is only kept as the triangular factor of its rows so far (Golub and Van Loan, section
5.3), so millions of rows take no more memory than one block.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from anser_ros.errors import FitError
from anser_ros.fitting.measurements import Measurements
from anser_ros.physics.dipole import flux_basis, flux_jacobian

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

BLOCK_ROWS = 8192
"""Readings that are in memory at a time as rows of the matrix."""
OUTLIER_SCALE = 3.0
"""A reading this many times the typical residual begins to lose weight."""
SMALLEST_NOISE_T = 1e-13
RIGHT_SCALE = 1e9
"""Fluxes in nT beside columns near 1e-7 / (0.1 m)^3: numbers of like size in one matrix."""
CONVERGED = 2e-3
"""Relative fall of the residual below which another alternation is not worth its time."""


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


@dataclass(frozen=True)
class Dipoles:
    """Where virtual dipoles are: positions (m, frame fg) and unit directions, shape (N, 3)."""

    positions: Array
    directions: Array

    def __len__(self) -> int:
        return int(self.positions.shape[0])


@dataclass(frozen=True)
class MomentFit:
    """Moments with what their fit left.

    Attributes
    ----------
    moments : ndarray, shape (N, K), complex
        A m^2.
    measurements : tuple of Measurements
        At their corrected poses.
    weights : tuple of ndarray, shape (F, S)
        Weight of each reading in [0, 1]; 0 where it is unusable.
    noise_t : float
        Estimated noise of a phasor component with the degrees of freedom taken off, T; it holds
        whatever the model can't explain.
    rank : int
    freedom : float
        Effective number of parameters an emitter's component.
    condition : float
        Of the column-scaled matrix.
    alternations : int
    """

    moments: ComplexArray
    measurements: tuple[Measurements, ...]
    weights: tuple[Array, ...]
    noise_t: float
    rank: int
    freedom: float
    condition: float
    alternations: int


class TriangularFactor:
    """Rows of a least-squares problem, reduced to a triangle as they come."""

    def __init__(self, unknowns: int, right_sides: int) -> None:
        self.unknowns = unknowns
        self.rows = 0
        self.triangle = np.zeros((0, unknowns + right_sides))

    def add(self, matrix: Array, right: Array) -> None:
        """Take in rows (P, N) with their right-hand sides (P, M)."""
        self.rows += matrix.shape[0]
        block = np.concatenate([matrix, right], axis=1)
        stack = np.concatenate([self.triangle, block])
        self.triangle = np.asarray(np.linalg.qr(stack, mode='r'))

    def spectrum(self) -> 'Spectrum':
        """Column-scaled singular value decomposition."""
        n = self.unknowns
        matrix, right = self.triangle[:n, :n], self.triangle[:n, n:]
        scale = np.linalg.norm(matrix, axis=0)
        scale[scale == 0.0] = 1.0
        u, s, vt = np.linalg.svd(matrix / scale, full_matrices=False)
        return Spectrum(scale, s, vt, u.T @ right)


class GramFactor:
    """The same problem as inner products: several times faster, half the digits.

    Enough for the passes that only prepare the next one, and for damped fits whose damping is far
    above rounding; the moments that are kept come from `TriangularFactor`.
    """

    def __init__(self, unknowns: int, right_sides: int) -> None:
        self.unknowns = unknowns
        self.rows = 0
        self.gram = np.zeros((unknowns + right_sides, unknowns + right_sides))

    def add(self, matrix: Array, right: Array) -> None:
        """Take in rows (P, N) with their right-hand sides (P, M)."""
        self.rows += matrix.shape[0]
        block = np.concatenate([matrix, right * RIGHT_SCALE], axis=1)
        self.gram += block.T @ block

    def spectrum(self) -> 'Spectrum':
        """Column-scaled eigenvectors, as the singular value decomposition would give them."""
        n = self.unknowns
        scale = np.sqrt(np.diag(self.gram)[:n])
        scale[scale == 0.0] = 1.0
        values, vectors = np.linalg.eigh(self.gram[:n, :n] / np.outer(scale, scale))
        floor = values[-1] * np.finfo(float).eps * n
        s = np.sqrt(np.maximum(values, floor))[::-1]
        v = vectors[:, ::-1].T
        right = self.gram[:n, n:] / (scale[:, None] * RIGHT_SCALE)
        return Spectrum(scale, s, v, (v @ right) / s[:, None])


@dataclass(frozen=True)
class Spectrum:
    """A least-squares problem in its singular vectors, from which every damping is cheap.

    Attributes
    ----------
    scale : ndarray, shape (N,)
        Column norms.
    values : ndarray, shape (R,)
        Singular values of the scaled matrix, descending.
    vectors : ndarray, shape (R, N)
        Right singular vectors.
    projected : ndarray, shape (R, M)
        Right-hand sides in the left singular vectors.
    """

    scale: Array
    values: Array
    vectors: Array
    projected: Array

    @property
    def rank(self) -> int:
        """Singular values above rounding."""
        limit = self.values[0] * np.finfo(float).eps * max(self.vectors.shape)
        return int((self.values > limit).sum())

    def filter(self, damping: float) -> Array:
        """Tikhonov's factors ``s / (s^2 + (damping s_0)^2)``; zero below the rank."""
        s = self.values
        out = np.zeros_like(s)
        keep = np.arange(s.size) < self.rank
        out[keep] = s[keep] / (s[keep] ** 2 + (damping * s[0]) ** 2)
        return out

    def solve(self, damping: float, prior: Array | None = None) -> Array:
        """Unknowns (N, M), pulled towards ``prior`` (N, M) or towards zero."""
        projected = self.projected
        if prior is not None:
            start = self.vectors @ (prior * self.scale[:, None])
            projected = projected - self.values[:, None] * start
        step = self.vectors.T @ (self.filter(damping)[:, None] * projected)
        step /= self.scale[:, None]
        return np.asarray(step if prior is None else prior + step)

    def freedom(self, damping: float) -> float:
        """Effective number of parameters, the trace of the influence matrix."""
        return float((self.values * self.filter(damping)).sum())


def as_real(values: ComplexArray) -> Array:
    """Complex (..., K) as real (..., 2K), real and imaginary part by turns."""
    return np.ascontiguousarray(values, dtype=np.complex128).view(np.float64)


def as_complex(values: Array) -> ComplexArray:
    """The inverse of `as_real`."""
    return np.ascontiguousarray(values).view(np.complex128)


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


def basis_rows(measurements: Measurements, dipoles: Dipoles) -> Array:
    """The article's matrix M at the measurements' poses, shape (F S, N), T / (A m^2)."""
    points, axes = measurements.placed()
    lengths = np.tile(measurements.sensors.length, len(measurements.time))
    return flux_basis(
        points.reshape(-1, 3), axes.reshape(-1, 3), lengths, dipoles.positions, dipoles.directions
    )


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


def pose_terms(measurements: Measurements, dipoles: Dipoles, moments: ComplexArray) -> PoseTerms:
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


Progress = Callable[[str, float], None]


@dataclass
class _State:
    """One body's measurements as the alternation moves them."""

    measured: Measurements
    corrected: Measurements
    offset: Array
    weights: Array
    usable: Array


class MomentFitter:
    """Alternates poses and moments; `fit` runs it to its end.

    Parameters
    ----------
    measurements : sequence of Measurements
        One a body and session; reference sensors may be among them (their pose doesn't jitter).
    dipoles : Dipoles
    damping : float
        Tikhonov's parameter as a part of the largest singular value of the scaled matrix.
    uncertainty : Uncertainty
    prior : ndarray, shape (N, K), complex, or None
        Moments towards which the damping pulls; zero when not given.
    """

    def __init__(
        self,
        measurements: Sequence[Measurements],
        dipoles: Dipoles,
        damping: float,
        uncertainty: Uncertainty,
        prior: ComplexArray | None = None,
    ) -> None:
        self.dipoles, self.damping, self.uncertainty = dipoles, damping, uncertainty
        self.prior = None if prior is None else as_real(prior)
        self.noise_t = uncertainty.flux_t
        self.states = [self._state(with_pose(m)) for m in measurements]
        count = sum(int(state.usable.sum()) for state in self.states)
        if count == 0:
            raise FitError('no reading has a pose: a fit needs fluxes and poses of the same time')
        self.emitters = int(self.states[0].measured.flux.shape[2])

    @staticmethod
    def _state(measured: Measurements) -> _State:
        usable = usable_weights(measured)
        offset = np.zeros((len(measured.time), 6))
        return _State(measured, measured, offset, usable.copy(), usable)

    def start_from(self, corrected: Sequence[tuple[Array, Array]]) -> None:
        """Begin with known pose offsets (F, 6) and weights (F, S), one pair a body."""
        for state, (offset, weights) in zip(self.states, corrected, strict=True):
            state.offset = offset.copy()
            state.corrected = moved(state.measured, offset)
            state.weights = weights * state.usable

    def solve(self, exact: bool = True) -> tuple[ComplexArray, Spectrum]:
        """Moments at the current poses and weights; by QR when ``exact``."""
        kind = TriangularFactor if exact else GramFactor
        factor = kind(len(self.dipoles), 2 * self.emitters)
        for state in self.states:
            count, sensors = state.weights.shape
            for block in frame_blocks(count, sensors):
                part = state.corrected.frames(block)  # type: ignore[arg-type]
                root = np.sqrt(state.weights[block].reshape(-1, 1))
                right = as_real(part.flux).reshape(-1, 2 * self.emitters)
                factor.add(root * basis_rows(part, self.dipoles), root * right)
        spectrum = factor.spectrum()
        return as_complex(spectrum.solve(self.damping, self.prior)), spectrum

    def correct(self, moments: ComplexArray, freedom: float) -> float:
        """Move all poses to their most probable values; returns the new noise estimate, T."""
        power, count, used = 0.0, 0.0, 0.0
        for state in self.states:
            precision = self._precision(state)
            for block in frame_blocks(*state.weights.shape):
                part = state.corrected.frames(block)  # type: ignore[arg-type]
                terms = pose_terms(part, self.dipoles, moments)
                step, left = most_probable_step(
                    terms, state.weights[block], self.noise_t, precision, state.offset[block]
                )
                state.offset[block] += step
                state.weights[block] = outlier_weights(left, state.usable[block])
                weight = state.weights[block]
                power += float((weight[:, :, None] * left**2).sum())
                count += float(weight.sum()) * left.shape[2]
                used += pose_freedom(terms, weight, self.noise_t, precision)
            state.corrected = moved(state.measured, state.offset)
        left_over = max(count - used - freedom * 2 * self.emitters, 0.05 * count)
        return max(float(np.sqrt(power / left_over)), SMALLEST_NOISE_T)

    def _precision(self, state: _State) -> Array:
        if state.measured.body == 'fg':
            return Uncertainty(position_m=0.0, rotation_rad=0.0).pose_precision
        return self.uncertainty.pose_precision

    def fit(
        self, alternations: int = 5, progress: Progress | None = None, exact: bool = True
    ) -> MomentFit:
        """Alternate until the residual no longer falls; ``exact`` has the last solve by QR."""
        done = 0
        moments, spectrum = self.solve(exact=False)
        for done in range(1, alternations + 1):
            before = self.noise_t
            self.noise_t = self.correct(moments, spectrum.freedom(self.damping))
            last = done == alternations or (
                done > 1 and abs(before - self.noise_t) < CONVERGED * self.noise_t
            )
            moments, spectrum = self.solve(exact=exact and last)
            if progress is not None:
                progress('moments', done / alternations)
            if last:
                break
        values = spectrum.values
        return MomentFit(
            moments=moments,
            measurements=tuple(state.corrected for state in self.states),
            weights=tuple(state.weights for state in self.states),
            noise_t=self.noise_t,
            rank=spectrum.rank,
            freedom=spectrum.freedom(self.damping),
            condition=float(values[0] / max(values[-1], np.finfo(float).tiny)),
            alternations=done,
        )


def pose_freedom(terms: PoseTerms, weights: Array, noise_t: float, precision: Array) -> float:
    """Effective number of pose parameters that the readings of all frames determine."""
    frames = terms.residual.shape[0]
    slope = terms.slope.reshape(frames, -1, 6) / noise_t
    weight = np.repeat(weights, terms.residual.shape[2], axis=1)
    normal = np.einsum('fri,frj->fij', slope * weight[:, :, None], slope, optimize=True)
    share = np.linalg.solve(normal + np.diag(precision), normal)
    return float(np.trace(share, axis1=1, axis2=2).sum())
