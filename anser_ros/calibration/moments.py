"""Fits moments of virtual dipoles to fluxes at poses that jitter (errors in variables).

Each optical pose is wrong by a few hundredths of a millimetre, and all sensors of the body and all
emitters share that error along six known directions. The fit therefore alternates between (a) the
most probable pose of every frame, from all its readings and the prior of the pose, and (b) damped
least squares of the moments at those poses, which is the article's equation (6) with one matrix
and a right-hand side for every phasor component. Both steps reduce the same sum of squares (block
coordinate descent on the joint posterior). Readings that no pose explains lose weight (Huber,
Robust Statistics). Only the triangular factor of the rows so far is kept (Golub and Van Loan,
section 5.3), so that millions of rows take no more memory than one block.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.least_squares import (
    GramFactor,
    Spectrum,
    TriangularFactor,
    as_complex,
    as_real,
)
from anser_ros.calibration.pose_correction import (
    SMALLEST_NOISE_T,
    PoseWhitener,
    most_probable_step,
    moved,
    outlier_weights,
    pose_precision,
    pose_terms,
)
from anser_ros.calibration.readings import (
    DipoleSites,
    basis_rows,
    frame_blocks,
    usable_weights,
    with_pose,
)
from anser_ros.errors import FitError
from anser_ros.field.measurements import Measurements
from anser_ros.settings import Accuracy

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Progress = Callable[[str, float], None]

CONVERGED = 2e-3
"""Relative change of the noise estimate below which the alternation ends. A smaller value costs
rounds that change moments by far less than their uncertainty."""
LEAST_FREEDOM = 0.05
"""Degrees of freedom of the residual at least, as a fraction of the phasor components: a bound for
fits with nearly as many parameters as readings, whose noise would be divided by zero."""


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

    `fit` runs the alternation to its end. Raises `FitError` when no reading has a pose.
    """

    def __init__(
        self,
        measurements: Sequence[Measurements],
        dipoles: DipoleSites,
        damping: float,
        accuracy: Accuracy,
        prior: ComplexArray | None = None,
    ) -> None:
        self.dipoles, self.damping, self.accuracy = dipoles, damping, accuracy
        self.prior = None if prior is None else as_real(prior)
        self.noise_t = self.quadrature_noise_t = accuracy.flux_noise_t
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

    def start_at(self, other: 'MomentFitter') -> None:
        """Begin with the poses, weights and noise to which another fit of these readings came."""
        self.noise_t, self.quadrature_noise_t = other.noise_t, other.quadrature_noise_t
        self.states = [
            replace(state, offset=state.offset.copy(), weights=state.weights.copy())
            for state in other.states
        ]

    def solve(self, exact: bool = True) -> tuple[ComplexArray, Spectrum]:
        """Return the moments (N, K) at the present poses and weights, with their spectrum.

        With ``exact`` they are solved by QR, otherwise by inner products, which is faster.
        """
        kind = TriangularFactor if exact else GramFactor
        factor = kind(len(self.dipoles), 2 * self.emitters)
        for state in self.states:
            count, sensors = state.weights.shape
            for block in frame_blocks(count, sensors):
                part = state.corrected.frames(block)
                root = np.sqrt(state.weights[block].reshape(-1, 1))
                right = as_real(part.flux).reshape(-1, 2 * self.emitters)
                factor.add(root * basis_rows(part, self.dipoles), root * right)
        spectrum = factor.spectrum()
        return as_complex(spectrum.solve(self.damping, self.prior)), spectrum

    def correct(self, moments: ComplexArray, freedom: float) -> float:
        """Move all poses to their most probable values and return the new noise estimate, T.

        ``freedom`` is the effective number of parameters of each right-hand side.
        """
        power, turned, count, used = 0.0, 0.0, 0.0, 0.0
        precision = pose_precision(self.accuracy)
        for state in self.states:
            for block in frame_blocks(*state.weights.shape):
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
            quadrature_noise_t=self.quadrature_noise_t,
            rank=spectrum.rank,
            freedom=spectrum.freedom(self.damping),
            condition=float(values[0] / max(values[-1], np.finfo(float).tiny)),
            alternations=done,
        )
