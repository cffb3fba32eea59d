"""Local models: overlapping regions with moments of their own, joined smoothly into one layer.

The article solves smaller problems for sub-regions where one does not do. Here the measured volume
is split in two along each of its longer sides; every region's moments are fitted to its own
readings, pulled to the common fit, and a smooth partition of unity blends the regions' fields.
What is served must be one set of dipoles, so the blended field is expressed by a finer layer at
last (which also makes it free of sources again, as a blend is not).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.dipole_sites import DipoleSites, basis_rows
from anser_ros.calibration.factors import GramFactor, as_complex, as_real
from anser_ros.calibration.moments import MomentFit
from anser_ros.calibration.pose_correction import frame_blocks
from anser_ros.calibration.prior import volume_lattice
from anser_ros.field.measurements import Measurements
from anser_ros.physics.dipole import flux_basis

Array = NDArray[np.float64]

OVERLAP = 0.5
"""Width of the blend between two regions, as a part of the volume's extent."""
LONG_SIDE = 0.5
"""A side shorter than this part of the longest one is not divided."""
PROJECTION_DAMPING = 1e-6


class Regions:
    """A smooth partition of unity over the volume of some points.

    Parameters
    ----------
    points : ndarray, shape (P, 3)
        m, frame fg.
    """

    def __init__(self, points: Array) -> None:
        low, high = points.min(axis=0), points.max(axis=0)
        self.middle, self.extent = (low + high) / 2.0, np.maximum(high - low, 1e-9)
        self.divided = np.flatnonzero(self.extent >= LONG_SIDE * self.extent.max())

    def __len__(self) -> int:
        return int(2**self.divided.size)

    def shares(self, points: Array) -> Array:
        """Share of each region at each point, shape (P, R); they add up to one."""
        out = np.ones((len(points), 1))
        for axis in self.divided:
            along = (points[:, axis] - self.middle[axis]) / (OVERLAP * self.extent[axis])
            right = 0.5 + 0.5 * np.sin(np.pi * np.clip(along, -0.5, 0.5))
            out = np.concatenate([out * (1.0 - right)[:, None], out * right[:, None]], axis=1)
        return out


def join_regions(
    measurements: Sequence[Measurements],
    dipoles: DipoleSites,
    fit: MomentFit,
    damping: float,
    layer: DipoleSites,
) -> NDArray[np.complex128]:
    """Moments (N', K) of a finer layer that make the regions' blended field.

    Parameters
    ----------
    measurements : sequence of Measurements
        At the measured poses; they give the volume.
    dipoles, fit, damping
        The common fit, whose poses and weights are kept and to whose moments regions are pulled.
    layer : DipoleSites
        The layer to express the field by.
    """
    regions = Regions(
        np.concatenate(
            [m.placed()[0][w > 0.0] for m, w in zip(fit.measurements, fit.weights, strict=True)]
        )
    )
    common = as_real(fit.moments)
    factors = [GramFactor(len(dipoles), common.shape[1]) for _ in range(len(regions))]
    for m, weights in zip(fit.measurements, fit.weights, strict=True):
        for block in frame_blocks(*weights.shape):
            part = m.frames(block)  # type: ignore[arg-type]
            matrix = basis_rows(part, dipoles)
            right = as_real(part.flux).reshape(len(matrix), -1)
            shares = regions.shares(part.placed()[0].reshape(-1, 3))
            for factor, share in zip(factors, shares.T, strict=True):
                root = np.sqrt(share * weights[block].ravel())[:, None]
                factor.add(root * matrix, root * right)
    moments = [factor.spectrum().solve(damping, common) for factor in factors]
    points, axes = volume_lattice(measurements)
    basis = flux_basis(points, axes, None, dipoles.positions, dipoles.directions)
    shares = regions.shares(points)
    blended = sum(share[:, None] * (basis @ m) for share, m in zip(shares.T, moments, strict=True))
    whole = GramFactor(len(layer), common.shape[1])
    whole.add(
        flux_basis(points, axes, None, layer.positions, layer.directions), np.asarray(blended)
    )
    return as_complex(whole.spectrum().solve(PROJECTION_DAMPING))
