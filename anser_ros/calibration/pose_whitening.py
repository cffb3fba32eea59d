"""Marginalises the pose of each frame: what stays of residuals is the part that no pose explains.

The jitter of a frame's pose shifts and turns all sensors of the body together. To first order it
changes the frame's fluxes along six known directions, the columns of J (the derivatives of the
fluxes by the pose). With flux noise sigma and the covariance S of the jitter, the covariance of
the frame's readings is ``C = sigma^2 I + J S J^T``.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class PoseWhitener:
    """Keeps the inverse of each frame's covariance C, prepared once for many residuals.

    By the matrix inversion lemma it takes a 6 x 6 matrix a frame (Golub and Van Loan, Matrix
    Computations, section 2.1.4).

    ``slope`` (F, S, 2K, 6): derivatives of the fluxes by the pose, as in `PoseTerms`.
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
