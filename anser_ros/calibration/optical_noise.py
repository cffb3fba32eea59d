"""Estimates the jitter of an optical tracker from poses that the fluxes determine much better."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.population import width_by_evidence
from anser_ros.field.measurements import Measurements

Array = NDArray[np.float64]

SMALLEST_M = 1e-7
"""Least jitter, m; it keeps the weights of perfect poses finite."""
SMALLEST_RAD = 1e-7
"""The same, rad."""


@dataclass(frozen=True)
class OpticalNoise:
    """Holds the jitter of an optical pose along and about each axis, before interpolation."""

    # position_m, rotation_rad: standard deviations of a component
    position_m: float
    rotation_rad: float
    poses: float = 0.0  # number of poses' worth of data behind them
    # share of the variance that is left in a pose at a flux's stamp, on the average
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

    For each of the measurements: the ``steps`` (F, 6), m and rad, found with the ``present``
    jitter, their ``variances``, the ``shares`` of `interpolation_share`, and which frames to use.
    """
    parts = [
        (step[keep] ** 2 / share[keep, None], variance[keep] / share[keep, None])
        for step, variance, share, keep in zip(steps, variances, shares, kept, strict=True)
    ]
    square, uncertain = (np.concatenate(part) for part in zip(*parts, strict=True))
    ratio = uncertain / present.jitter**2
    (along, seen), (about, turned) = (
        width_by_evidence(square[:, own], ratio[:, own], 1.0) for own in (slice(0, 3), slice(3, 6))
    )
    left = np.concatenate([share[keep] for share, keep in zip(shares, kept, strict=True)])
    return OpticalNoise(
        max(along, SMALLEST_M),
        max(about, SMALLEST_RAD),
        min(seen, turned) / 3.0,
        float(left.sum()) / max(left.size, 1),
    )
