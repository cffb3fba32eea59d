"""Estimates the jitter of an optical tracker from poses that the fluxes determine much better."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.field.measurements import Measurements

Array = NDArray[np.float64]

SMALLEST_M = 1e-7
"""Least jitter, m; it keeps the weights of perfect poses finite."""
SMALLEST_RAD = 1e-7
"""The same, rad."""


@dataclass(frozen=True)
class OpticalNoise:
    """Holds the jitter of an optical pose along and about each axis, before interpolation.

    Attributes
    ----------
    position_m, rotation_rad : float
        Standard deviations of a component.
    poses : float
        Number of poses' worth of data behind them.
    interpolated : float
        Share of the variance that is left in a pose at a flux's stamp, on the average.
    """

    position_m: float
    rotation_rad: float
    poses: float = 0.0
    interpolated: float = 1.0

    @property
    def jitter(self) -> Array:
        """Return the jitter of a pose along (m) and about (rad) the three axes, shape (6,)."""
        return np.repeat([self.position_m, self.rotation_rad], 3)

    @property
    def relative_uncertainty(self) -> float:
        """Return the relative standard deviation of both figures: three components per pose."""
        return float(1.0 / np.sqrt(max(6.0 * self.poses, 1.0)))

    def mean_sigma_m(self, frames: int) -> float:
        """Return the jitter of the mean of so many frames' poses along each axis, m."""
        return float(self.position_m * np.sqrt(self.interpolated / max(frames, 1)))


def interpolation_share(measurements: Measurements) -> Array:
    """Return which share of a pose's variance linear interpolation leaves at each frame, (F,).

    Between two poses of independent jitter, at the fraction a of the way, it is
    ``(1 - a)^2 + a^2``.
    """
    track = measurements.track
    if track is None or track.time.size < 2:
        return np.ones(len(measurements.time))
    right = np.clip(np.searchsorted(track.time, measurements.time), 1, track.time.size - 1)
    before, after = track.time[right - 1], track.time[right]
    along = np.clip((measurements.time - before) / np.maximum(after - before, 1e-9), 0.0, 1.0)
    return np.asarray((1.0 - along) ** 2 + along**2)


def estimate_noise(
    steps: Sequence[Array],
    variances: Sequence[Array],
    shares: Sequence[Array],
    kept: Sequence[NDArray[np.bool_]],
    present: OpticalNoise,
) -> OpticalNoise:
    """Estimate the jitter from the poses' most probable steps.

    The squares of the steps are divided by the number of steps that the fluxes determined (MacKay,
    Bayesian interpolation, Neural Computation 1992): a single coil does not see every direction.

    Parameters
    ----------
    steps, variances : sequence of ndarray, shape (F, 6)
        Steps of the poses (m, rad) and what is uncertain in them, one per body and session.
    shares : sequence of ndarray, shape (F,)
        Of `interpolation_share`.
    kept : sequence of ndarray of bool, shape (F,)
        Frames to use.
    present : OpticalNoise
        The jitter that the steps were found with.
    """
    power, information, count, share_sum = np.zeros(2), np.zeros(2), 0, 0.0
    for step, variance, share, keep in zip(steps, variances, shares, kept, strict=True):
        each = (step**2 / share[:, None])[keep]
        seen = (1.0 - variance / (present.jitter**2 * share[:, None]))[keep]
        power += [each[:, :3].sum(), each[:, 3:].sum()]
        information += [seen[:, :3].sum(), seen[:, 3:].sum()]
        count, share_sum = count + int(keep.sum()), share_sum + float(share[keep].sum())
    sigma = np.sqrt(power / np.maximum(information, 1.0))
    return OpticalNoise(
        max(float(sigma[0]), SMALLEST_M),
        max(float(sigma[1]), SMALLEST_RAD),
        float(information.min()) / 3.0,
        share_sum / max(count, 1),
    )
