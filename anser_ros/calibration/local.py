"""Fits local models: overlapping regions with separate moments, joined smoothly into one layer.

The article solves smaller problems for sub-regions where a single one is not accurate enough. Here
the measured volume is split in two along each of its longer sides. The moments of every region are
fitted to the region's readings and pulled towards the common fit, and a smooth partition of unity
blends the fields of the regions. A field model has one set of dipoles, so the blended field is
finally expressed by a finer layer. This also makes it free of sources again, which a blend is not.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.dipole_sites import DipoleSites, basis_rows
from anser_ros.calibration.factors import GramFactor, as_complex, as_real
from anser_ros.calibration.moments import MomentFit
from anser_ros.calibration.prior import PROJECTION_DAMPING, volume_lattice
from anser_ros.calibration.readings import frame_blocks
from anser_ros.field.measurements import Measurements
from anser_ros.physics.dipole import flux_basis

Array = NDArray[np.float64]

OVERLAP = 0.5
"""Width of the blend between two regions, as a fraction of the volume's extent. With less overlap
the field changes more abruptly between regions; with more the regions differ less."""
LONG_SIDE = 0.5
"""A side shorter than this fraction of the longest one is not divided: its regions would be flat
and would not determine the field's change across them."""


class Regions:
    """Divides the volume of points (P, 3), m, smoothly: all regions' weights add up to one."""

    def __init__(self, points: Array) -> None:
        low, high = points.min(axis=0), points.max(axis=0)
        self.middle, self.extent = (low + high) / 2.0, np.maximum(high - low, 1e-9)
        self.divided = np.flatnonzero(self.extent >= LONG_SIDE * self.extent.max())

    def __len__(self) -> int:
        return int(2**self.divided.size)

    def shares(self, points: Array) -> Array:
        """Return the weight of each region at each point, shape (P, R); a row adds up to one."""
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
    """Return the moments of a finer layer that make the blended field of the regions.

    ``fit``: the common fit: its poses and weights are kept, and the damping pulls the regions'
    moments towards its moments. ``layer``: the N' dipoles to express the blended field by.
    Returns (N', K): moments, A m^2.
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
            part = m.frames(block)
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
