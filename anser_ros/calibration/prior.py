"""Takes the drawn board as a prior: its field as the moments of any set of dipoles.

The damping pulls a fit towards these moments instead of zero, so that moments which the data do
not determine stay as drawn. The drawing is first scaled by one complex gain per emitter, because
the scale of the drive current, and most of the effect of a large metal sheet, is such a factor.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.dipole_sites import DipoleSites
from anser_ros.calibration.factors import ComplexArray, GramFactor, as_complex, as_real
from anser_ros.calibration.readings import usable_readings
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import FieldModel
from anser_ros.physics.dipole import flux_basis
from anser_ros.physics.sensor import along_each_axis

Array = NDArray[np.float64]

POINTS_ALONG = 11
"""Lattice points along x and y of the volume in which dipoles are to make the nominal field (every
second one along z): some 2000 equations for at most a few hundred dipoles."""
MARGIN = 0.3
"""How far beyond the measured volume the nominal field is followed, as a fraction of its half
size: a scan as wide as the board then covers the default tracked volume (`volume.REACH`)."""
LEAST_HALF_SIZE_M = 0.02
"""Half size of that volume at least, m, for measurements along a line or in a plane: over 2 cm a
field 10 cm from its coils changes by half, which shows how it falls."""
LEAST_HEIGHT = 0.8
"""Lowest point of that volume as a fraction of the lowest reading's height: there the field is at
most twice as strong, and farther down it changes too fast for a layer of dipoles."""
PROJECTION_DAMPING = 1e-6
"""Damping when a known field without noise is expressed by dipoles, as a fraction of the largest
singular value. It only keeps nearly parallel columns from making huge moments."""


class ScaledNominal:
    """Holds the nominal field in and around a measured volume, scaled to the measurements."""

    def __init__(self, nominal: FieldModel, measurements: Sequence[Measurements]) -> None:
        self.nominal = nominal
        self.points, self.axes = volume_lattice(measurements)
        self.gains = emitter_gains(nominal, measurements)
        self.flux = nominal.flux(self.points, self.axes) * self.gains

    def moments(self, dipoles: DipoleSites) -> ComplexArray:
        """Return the moments (N, K), A m^2, with which N dipoles make the drawn field best."""
        basis = flux_basis(self.points, self.axes, None, dipoles.positions, dipoles.directions)
        factor = GramFactor(len(dipoles), 2 * self.flux.shape[1])
        factor.add(basis, as_real(self.flux))
        return as_complex(factor.spectrum().solve(PROJECTION_DAMPING))


def volume_lattice(measurements: Sequence[Measurements]) -> tuple[Array, Array]:
    """Return a lattice of sensors in and around the volume of the usable readings.

    Returns ``points``, ``axes`` (P, 3): positions (m) and unit axes, frame fg; three sensors along
    x, y and z at each point.
    """
    points = np.concatenate([m.placed()[0][m.usable] for m in measurements])
    low, high = points.min(axis=0), points.max(axis=0)
    middle, half = (low + high) / 2.0, (high - low) / 2.0
    half = np.maximum(half * (1.0 + MARGIN), LEAST_HALF_SIZE_M)
    steps = np.linspace(-1.0, 1.0, POINTS_ALONG)
    lattice = np.stack(np.meshgrid(steps, steps, steps[::2], indexing='ij'), axis=3)
    where = middle + lattice.reshape(-1, 3) * half
    where[:, 2] = np.maximum(where[:, 2], LEAST_HEIGHT * low[2])
    return along_each_axis(where)


def emitter_gains(nominal: FieldModel, measurements: Sequence[Measurements]) -> ComplexArray:
    """Return the complex factor of each emitter's drawn field that fits its fluxes best, (K,)."""
    above, below = np.zeros(len(nominal.emitters), complex), np.zeros(len(nominal.emitters))
    for points, axes, lengths, flux in usable_readings(measurements):
        drawn = nominal.flux(points, axes, lengths)
        above += (drawn.conj() * flux).sum(axis=0)
        below += (np.abs(drawn) ** 2).sum(axis=0)
    return np.asarray(above / np.maximum(below, 1e-300))
