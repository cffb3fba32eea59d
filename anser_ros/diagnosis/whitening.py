"""Residuals in units of what they may be: noise everywhere, pose jitter along six directions.

An optical pose that is a little off moves all channels and emitters of its frame together, along
the six columns of the frame's pose Jacobian. Taking that known freedom out lowers the floor
several times, and shows what plain residuals hide.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.effect import View

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class Spread:
    """Expected standard deviations.

    Attributes
    ----------
    flux_t : float
        Noise of a phasor component, the model's own error included, T.
    noise_t : float
        The part of it that is noise when all is well.
    position_m, rotation_rad : float
        Optical jitter of each axis, as it stands after interpolation.
    """

    flux_t: float = 60e-12
    noise_t: float = 60e-12
    position_m: float = 0.07e-3
    rotation_rad: float = 0.4e-3


def parts(values: ComplexArray) -> Array:
    """Real, then imaginary parts of values (F, S, K, ...), flattened to (F, 2 S K, ...)."""
    flat = values.reshape(values.shape[0], values.shape[1] * values.shape[2], *values.shape[3:])
    return np.concatenate([flat.real, flat.imag], axis=1)


def pose_jacobian(view: View) -> Array:
    """Derivative of the flux parts by the body's pose, (F, 2 S K, 6): m, rad about fg's axes."""
    lever = view.centres - view.position[:, None, :]
    turn = np.cross(lever[..., :, None], view.d_position, axis=2)
    turn = turn + np.cross(view.axes[..., :, None], view.d_axis, axis=2)
    columns = np.concatenate([view.d_position, turn], axis=2)
    return parts(np.moveaxis(columns, 2, -1))


@dataclass(frozen=True)
class Whitener:
    """Multiplies each frame by the inverse square root of its covariance.

    Attributes
    ----------
    weight : ndarray, shape (F, n)
        Inverse noise; 0 where a value must not count.
    basis : ndarray, shape (F, n, 6), or None
        Weighted pose directions, scaled by the jitter.
    inner : ndarray, shape (F, 6, 6), or None
        What is taken off between the two projections.
    """

    weight: Array
    basis: Array | None = None
    inner: Array | None = None

    @staticmethod
    def of(weight: Array, jacobian: Array, spread: Spread) -> 'Whitener':
        """From weights (F, n) and the pose Jacobian (F, n, 6)."""
        jitter = np.repeat([spread.position_m, spread.rotation_rad], 3)
        basis = jacobian * jitter * weight[..., None]
        values, vectors = np.linalg.eigh(basis.transpose(0, 2, 1) @ basis)
        values = np.maximum(values, 0.0)
        # (I + A A^T)^(-1/2) = I - A V diag(g) V^T A^T with g = (1 - 1/sqrt(1 + s^2)) / s^2.
        shrink = np.where(
            values > 1e-9, (1 - 1 / np.sqrt(1 + values)) / np.maximum(values, 1e-12), 0.5
        )
        inner = (vectors * shrink[:, None, :]) @ vectors.transpose(0, 2, 1)
        return Whitener(weight, basis, inner)

    def rows(self, frames: NDArray[np.int64]) -> 'Whitener':
        """The whitener of some frames, by index."""
        basis = None if self.basis is None else self.basis[frames]
        return Whitener(
            self.weight[frames], basis, None if self.inner is None else self.inner[frames]
        )

    def __call__(self, values: Array) -> Array:
        """Whiten (F, n) or (F, n, q)."""
        single = values.ndim == 2
        out = (values[..., None] if single else values) * self.weight[..., None]
        if self.basis is not None and self.inner is not None:
            out = out - self.basis @ (self.inner @ (self.basis.transpose(0, 2, 1) @ out))
        return out[..., 0] if single else out

    def jitter(self, values: Array) -> Array:
        """Most probable pose error of each frame in units of its prior, from (F, n): (F, 6)."""
        if self.basis is None:
            return np.zeros((values.shape[0], 6))
        y = values * self.weight
        normal = self.basis.transpose(0, 2, 1) @ self.basis + np.eye(6)
        right = self.basis.transpose(0, 2, 1) @ y[..., None]
        return np.asarray(np.linalg.solve(normal, right)[..., 0])
