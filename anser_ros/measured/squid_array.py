"""Models an array of SQUID channels, three on a chip, each a weighted sum of points; its errors.

The chips were surveyed, not the field at them. A chip that sits a little elsewhere, is tilted or
has a gain of its own moves its three channels together; that is a covariance here, not a
parameter, so that a coil's place is weighted by what the array can know.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.physics.dipole import flux_basis

Array = NDArray[np.float64]
Index = NDArray[np.int64]

STEP_M = 2e-4
"""Step of the numerical derivative of the signals by a chip's place, m."""
STEP_RAD = 1e-3
"""Step of the numerical derivative of the signals by a chip's tilt, rad."""
LEFT_OUT = 1e8
"""Factor on the noise of a channel that takes no part."""


@dataclass(frozen=True)
class ChipErrors:
    """Holds standard deviations of a chip's place (m), tilt (rad) and its channels' gains."""

    place_m: float
    tilt_rad: float
    gain: float


@dataclass(frozen=True)
class SquidArray:
    """Holds the geometry of S channels on C chips.

    Attributes
    ----------
    names : tuple of str, length S
    is_magnetometer : ndarray of bool, shape (S,)
    points_m, normals : ndarray, shape (S, Q, 3)
        Integration points and normals, device frame.
    weights : ndarray, shape (S, Q)
        A channel's signal is the weighted sum of the normal field at its points.
    chips : ndarray of int, shape (C, 3)
        Channels of each chip.
    """

    names: tuple[str, ...]
    is_magnetometer: NDArray[np.bool_]
    points_m: Array
    normals: Array
    weights: Array
    chips: Index

    @property
    def centres_m(self) -> Array:
        """Return the middle of each channel, shape (S, 3), m."""
        used = (self.weights != 0.0)[:, :, None]
        return np.asarray(np.sum(self.points_m * used, axis=1) / used.sum(axis=1))

    def signals(self, place_m: Array) -> Array:
        """Return each channel's signal per unit moment on x, y and z at a place (3,): (S, 3)."""
        count = self.points_m.shape[1]
        basis = flux_basis(
            self.points_m.reshape(-1, 3),
            self.normals.reshape(-1, 3),
            None,
            np.tile(place_m, (3, 1)),
            np.eye(3),
        ).reshape(-1, count, 3)
        return np.asarray(np.einsum('sqk,sq->sk', basis, self.weights))

    def chip_columns(self, place_m: Array, moment: Array) -> Array:
        """Return each channel's change as its chip moves (m) and turns (rad): (S, 6)."""
        out = np.empty((len(self.names), 6))
        for axis, unit in enumerate(np.eye(3)):
            ends = [self.signals(place_m - s * STEP_M * unit) @ moment for s in (1.0, -1.0)]
            out[:, axis] = (ends[0] - ends[1]) / (2.0 * STEP_M)
            ends = [self._turned(s * STEP_RAD * unit).signals(place_m) @ moment for s in (1, -1)]
            out[:, 3 + axis] = (ends[0] - ends[1]) / (2.0 * STEP_RAD)
        return out

    def _turned(self, vector: Array) -> 'SquidArray':
        centre = self.centres_m[:, None]
        arm = self.points_m - centre
        return replace(
            self,
            points_m=centre + arm + np.cross(vector, arm),
            normals=self.normals + np.cross(vector, self.normals),
        )

    def changed(self, by: Mapping[str, float]) -> 'SquidArray':
        """Return the array with one of the errors that all chips may share.

        `array_offset` (m): every coil further out along its normal; `array_scale`: all distances
        from the origin larger; `magnetometer_size`, `gradiometer_size`: coils larger about their
        own middle; `gradiometer_gain`.
        """
        centre = self.centres_m[:, None]
        arm = self.points_m - centre
        size = np.where(
            self.is_magnetometer,
            1.0 + by.get('magnetometer_size', 0.0),
            1.0 + by.get('gradiometer_size', 0.0),
        )[:, None, None]
        gain = np.where(self.is_magnetometer, 1.0, 1.0 + by.get('gradiometer_gain', 0.0))
        points = centre * (1.0 + by.get('array_scale', 0.0)) + arm * size
        return replace(
            self,
            points_m=points + by.get('array_offset', 0.0) * self.normals,
            weights=self.weights * gain[:, None],
        )


@dataclass(frozen=True)
class SquidWhitener:
    """Holds inverse Cholesky factors of the chips' covariances, and what their channels share.

    Attributes
    ----------
    chips : ndarray of int, shape (C, 3)
    factors : ndarray, shape (C, 3, 3)
    shared : ndarray, shape (C, 3, 3)
        Covariance of a chip's channels by its place and tilt.
    half_log_det : float
        Of the used channels.
    """

    chips: Index
    factors: Array
    shared: Array
    half_log_det: float

    def explained(self, left: Array) -> Array:
        """Return the expected part of residuals (S,) that the chips' places and tilts make.

        A channel that took no part is determined by the other channels of its chip.
        """
        white = np.einsum('cij,cj->ci', self.factors, left[self.chips])
        inverse = np.einsum('cji,cj->ci', self.factors, white)
        out = np.zeros(len(left))
        out[self.chips] = np.einsum('cij,cj->ci', self.shared, inverse)
        return out

    def weighted(self, weight: Array) -> 'SquidWhitener':
        """Return the same with each chip's covariance divided by its weight (C,)."""
        root = np.sqrt(weight)[:, None, None]
        return replace(self, factors=self.factors * root, shared=self.shared / root**2)

    def apply(self, values: Array) -> Array:
        """Return whitened values of channels, (S,) or (S, n), chip by chip."""
        own = values.reshape(len(values), -1)[self.chips]
        white = np.einsum('cij,cjn->cin', self.factors, own)
        return np.asarray(white.reshape(-1, *values.shape[1:]))


def whitener(
    array: SquidArray,
    noise: Array,
    columns: Array,
    predicted: Array,
    errors: ChipErrors,
    used: NDArray[np.bool_],
) -> SquidWhitener:
    """Return the covariance of each chip's channels: noise, gain, place and tilt."""
    chips = array.chips
    variance = noise**2 + (errors.gain * predicted) ** 2
    own = columns[chips]
    shared = errors.place_m**2 * own[:, :, :3] @ own[:, :, :3].swapaxes(1, 2)
    shared = shared + errors.tilt_rad**2 * own[:, :, 3:] @ own[:, :, 3:].swapaxes(1, 2)
    covariance = shared + np.eye(3) * variance[chips][:, :, None]
    blind = np.where(used, 0.0, LEFT_OUT * (noise**2 + predicted**2))
    covariance = covariance + np.eye(3) * blind[chips][:, :, None]
    scale = 1.0 / np.sqrt(np.einsum('cii->ci', covariance))
    factor = np.linalg.cholesky(covariance * scale[:, :, None] * scale[:, None, :])
    inverse = np.linalg.inv(factor) * scale[:, None, :]
    log_det = np.log(np.einsum('cii->ci', inverse))
    keep = used[chips]
    return SquidWhitener(chips, inverse, shared, -float(np.sum(log_det[keep])))
