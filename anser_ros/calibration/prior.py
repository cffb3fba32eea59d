"""What is known before any measurement: the drawn board's field, as moments of any set of dipoles.

A damped fit is pulled towards these moments instead of zero, so that what the data don't determine
stays as drawn. The drawing is scaled by one complex gain an emitter first: the drive current's
scale, and most of what a large sheet of metal does, is a factor.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.dipole_sites import DipoleSites
from anser_ros.calibration.factors import ComplexArray, GramFactor, as_complex, as_real
from anser_ros.calibration.pose_correction import frame_blocks
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import FieldModel
from anser_ros.physics.dipole import flux_basis

Array = NDArray[np.float64]

POINTS_ALONG = 11
MARGIN = 0.3
"""How far beyond the measured volume the drawing is followed, as a part of its half size."""
PROJECTION_DAMPING = 1e-6


class DrawnBoard:
    """The nominal field in and around a measured volume, ready to be expressed by any dipoles.

    Parameters
    ----------
    nominal : FieldModel
    measurements : sequence of Measurements
        They give the volume and the emitters' gains.
    """

    def __init__(self, nominal: FieldModel, measurements: Sequence[Measurements]) -> None:
        self.points, self.axes = volume_lattice(measurements)
        self.gains = emitter_gains(nominal, measurements)
        self.flux = nominal.flux(self.points, self.axes) * self.gains

    def moments(self, dipoles: DipoleSites) -> ComplexArray:
        """Moments (N, K) with which the dipoles make the drawn field."""
        basis = flux_basis(self.points, self.axes, None, dipoles.positions, dipoles.directions)
        factor = GramFactor(len(dipoles), 2 * self.flux.shape[1])
        factor.add(basis, as_real(self.flux))
        return as_complex(factor.spectrum().solve(PROJECTION_DAMPING))


def volume_lattice(measurements: Sequence[Measurements]) -> tuple[Array, Array]:
    """Points and axes (P, 3): three axes at each point of a lattice about the measured volume."""
    points = np.concatenate([m.placed()[0][m.usable] for m in measurements])
    low, high = points.min(axis=0), points.max(axis=0)
    middle, half = (low + high) / 2.0, (high - low) / 2.0
    half = np.maximum(half * (1.0 + MARGIN), 0.02)
    steps = np.linspace(-1.0, 1.0, POINTS_ALONG)
    lattice = np.stack(np.meshgrid(steps, steps, steps[::2], indexing='ij'), axis=3)
    where = middle + lattice.reshape(-1, 3) * half
    # Downwards the volume ends at the board: never closer than the lowest reading by a fifth.
    where[:, 2] = np.maximum(where[:, 2], 0.8 * low[2])
    return np.repeat(where, 3, axis=0), np.tile(np.eye(3), (len(where), 1))


def emitter_gains(nominal: FieldModel, measurements: Sequence[Measurements]) -> ComplexArray:
    """Complex factor of each emitter's drawn field that fits its fluxes best."""
    above, below = np.zeros(len(nominal.emitters), complex), np.zeros(len(nominal.emitters))
    for whole in measurements:
        for block in frame_blocks(len(whole.time), len(whole.sensors)):
            m = whole.frames(block)  # type: ignore[arg-type]
            points, axes = m.placed()
            used = m.usable
            lengths = np.broadcast_to(m.sensors.length, used.shape)[used]
            drawn = nominal.flux(points[used], axes[used], lengths)
            above += (drawn.conj() * m.flux[used]).sum(axis=0)
            below += (np.abs(drawn) ** 2).sum(axis=0)
    return np.asarray(above / np.maximum(below, 1e-300))
