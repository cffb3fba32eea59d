"""Scales residuals by what they may be: noise everywhere, pose jitter along six directions.

A slightly wrong optical pose changes all channels and emitters of its frame together, along the
six columns of the frame's pose Jacobian. Removing these known directions lowers the floor several
times, and reveals what plain residuals hide.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.view import View
from anser_ros.parallel import in_order, slices, slices_of
from anser_ros.settings import Accuracy

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

REFERENCE_CHANGE = 0.01
"""Relative error of the change that a reference sensor with the default survey errors sees."""
CHANGE_LENGTH_M = 0.03
"""Way over which what metal does to a reference changes by its own size, m: a third of the
distance (a dipole's field falls with its cube), for metal some 10 cm away."""
FRAMES_AT_ONCE = 16
"""Frames that are whitened at once: a megabyte or two, which stay in the cache from one
product to the next."""
FRAMES_A_THREAD = 8 * FRAMES_AT_ONCE
"""Frames that one thread whitens, a millisecond's work: a few, and handing over takes longer."""


def _survey_share(accuracy: Accuracy) -> float:
    """Relative error of a change, to first order: gain, axis and place in quadrature."""
    place = accuracy.reference_position_m / CHANGE_LENGTH_M
    return float(np.linalg.norm([accuracy.reference_gain, accuracy.reference_axis_rad, place]))


@dataclass(frozen=True)
class Spread:
    """Holds standard deviations that are expected when all is well."""

    # Noise of a phasor component, the model's own error included, T.
    flux_t: float = Accuracy.flux_noise_t
    # Of the instruments: the noise when all is well, optical jitter, the references' survey.
    accuracy: Accuracy = field(default_factory=Accuracy)

    @property
    def noise_t(self) -> float:
        """Return the part of ``flux_t`` that is noise when all is well, T."""
        return self.accuracy.flux_noise_t

    @property
    def model_share(self) -> float:
        """Return the share of the square of ``flux_t`` that is the model's own error."""
        return max(0.0, 1.0 - (self.noise_t / self.flux_t) ** 2)

    @property
    def reference_change(self) -> float:
        """Return the relative error of the change that a reference sees, by the survey's."""
        return REFERENCE_CHANGE * (_survey_share(self.accuracy) / _survey_share(Accuracy()))


def parts(values: ComplexArray) -> Array:
    """Return real, then imaginary parts of values (F, S, K, ...), flattened to (F, 2 S K, ...)."""
    flat = values.reshape(values.shape[0], values.shape[1] * values.shape[2], *values.shape[3:])
    return np.concatenate([flat.real, flat.imag], axis=1)


def pose_jacobian(view: View) -> Array:
    """Return the derivative of flux parts by the body's pose, (F, 2 S K, 6): m, rad, fg's axes."""
    columns = np.concatenate([view.d_position, view.d_turn], axis=2)
    return parts(np.moveaxis(columns, 2, -1))


@dataclass(frozen=True)
class Whitener:
    """Multiplies each frame by the inverse square root of its covariance."""

    weight: Array  # (F, n), inverse noise; 0 where a value must not count
    # (F, n, m), weighted directions along which a frame may move, a standard deviation long.
    basis: Array | None = None
    inner: Array | None = None  # (F, m, m), what is taken off between the two projections
    # What -2 log likelihood grows by with the directions beyond the pose's (their log det).
    penalty: float = 0.0

    @staticmethod
    def of(weight: Array, directions: Array, known: int = 0) -> 'Whitener':
        """Make it from weights (F, n) and directions (F, n, m), the first ``known`` a pose's."""
        basis = directions * weight[..., None]
        gram = basis.transpose(0, 2, 1) @ basis
        values, vectors = np.linalg.eigh(gram)
        values = np.maximum(values, 0.0)
        # (I + A A^T)^(-1/2) = I - A V diag(g) V^T A^T with g = (1 - 1/sqrt(1 + s^2)) / s^2.
        shrink = np.where(
            values > 1e-9, (1 - 1 / np.sqrt(1 + values)) / np.maximum(values, 1e-12), 0.5
        )
        inner = (vectors * shrink[:, None, :]) @ vectors.transpose(0, 2, 1)
        penalty = 0.0
        if basis.shape[2] > known:
            pose = np.eye(known) + gram[:, :known, :known]
            penalty = float(np.log1p(values).sum() - np.linalg.slogdet(pose)[1].sum())
        return Whitener(weight, basis, inner, penalty)

    def rows(self, frames: NDArray[np.int64]) -> 'Whitener':
        """Return the whitener of some frames, chosen by index."""
        basis = None if self.basis is None else self.basis[frames]
        return Whitener(
            self.weight[frames], basis, None if self.inner is None else self.inner[frames]
        )

    def first(self, count: int) -> 'Whitener':
        """Return the whitener with only the first ``count`` directions."""
        if self.basis is None or count == self.basis.shape[2]:
            return self
        if count == 0:
            return Whitener(self.weight)
        weight = np.where(self.weight > 0, self.weight, 1.0)
        return Whitener.of(self.weight, self.basis[..., :count] / weight[..., None], count)

    def __call__(self, values: Array) -> Array:
        """Return values of shape (F, n) or (F, n, q), whitened."""
        columns = values[..., None] if values.ndim == 2 else values
        out = np.empty(columns.shape)

        def work(mine: slice) -> None:
            for rows in slices_of(mine, FRAMES_AT_ONCE):
                np.multiply(columns[rows], self.weight[rows, :, None], out=out[rows])
                if self.basis is not None and self.inner is not None:
                    basis = self.basis[rows]
                    moved = self.inner[rows] @ (basis.transpose(0, 2, 1) @ out[rows])
                    out[rows] -= basis @ moved

        in_order(work, slices(len(out), FRAMES_A_THREAD))
        return out.reshape(values.shape)
