"""Fits emitters without a drawing: a few dipoles on one axis for each, place and axis from the
data.

A magnet, an electromagnet or a coil of unknown shape has an axis; around it the field hardly
changes. One dipole is its far field. Equal distances h along the axis make three or five dipoles
the multipoles of the source's size: their moments are linear, and of either sign, so that a long
source and a flat one are both described, whatever h is, as long as it is small compared with
the distance of the sensors. A source's place and axis are found with the moments eliminated
(variable projection).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from anser_ros.calibration.dipole_sites import DipoleSites
from anser_ros.calibration.factors import as_real
from anser_ros.calibration.readings import weighted_readings
from anser_ros.field.measurements import Measurements
from anser_ros.physics.dipole import flux_basis
from anser_ros.physics.tangent import tilted

Array = NDArray[np.float64]

SPREAD = 0.2
"""Distance of neighbouring dipoles, as a fraction s of that from the source to the nearest sensor:
the first multipole that is left out is smaller than what is kept by s squared."""
FIRST_SPACING_M = 1e-3
"""Distance of the dipoles before any data are seen, m. Any value far below the distance of the
sensors gives the same first fit."""
ENDED = 1e-10
"""Relative change of the sum of squares at which the search has ended."""


def coaxial(centres: Array, axes: Array, count: int, spacing_m: Array) -> DipoleSites:
    """Return ``count`` dipoles along the axis of each of K sources.

    ``centres``, ``axes`` (K, 3): middles (m) and unit axes, frame fg. ``count``: dipoles a source,
    odd. ``spacing_m`` (K,): distance of neighbours, m.
    """
    steps = np.arange(count) - (count - 1) / 2.0
    along = steps[None, :, None] * spacing_m[:, None, None] * axes[:, None, :]
    places = (centres[:, None, :] + along).reshape(-1, 3)
    return DipoleSites(places, np.repeat(axes, count, axis=0))


def fit_coaxial(
    corrected: Sequence[Measurements], weights: Sequence[Array], start: DipoleSites, count: int
) -> DipoleSites:
    """Return coaxial dipoles where they explain the measurements best, one source after the other.

    ``corrected`` are at their corrected poses; ``start`` has ``count`` dipoles for each of the K
    emitters, in their order.
    """
    middle = (count - 1) // 2
    centres, axes = start.positions[middle::count], start.directions[middle::count]
    (points, normals, lengths, measured), root = weighted_readings(corrected, weights)
    flux = as_real(measured)
    found = []
    for k, (centre, axis) in enumerate(zip(centres, axes, strict=True)):
        near = float(np.linalg.norm(points - centre, axis=1).min())
        pair = np.ascontiguousarray(flux[:, 2 * k : 2 * k + 2])
        found.append(
            _one_source((points, normals, lengths, root, pair), centre, axis, count, near)
        )
    places, directions, spacing = (np.array(part) for part in zip(*found, strict=True))
    return coaxial(places, directions, count, spacing)


def _one_source(
    rows: tuple[Array, Array, Array, Array, Array], centre: Array, axis: Array, count: int,
    near: float,
) -> tuple[Array, Array, float]:  # fmt: skip
    """Place, axis and spacing of one emitter's source, from rows (P, ...) and fluxes (P, 2)."""
    points, normals, lengths, root, flux = rows
    weighted = flux * root[:, None]
    first = _best_vector(rows, centre)
    if np.linalg.norm(first) > 0.0:
        axis = first / np.linalg.norm(first)
    spacing = SPREAD * near

    def sites(x: Array) -> DipoleSites:
        turned = tilted(axis[None], x[None, 3:])
        return coaxial((centre + near * x[:3])[None], turned, count, np.array([spacing]))

    def left(x: Array) -> Array:
        where = sites(x)
        basis = flux_basis(points, normals, lengths, where.positions, where.directions)
        # Alike on both sides of the middle: else a shift along the axis would look like moments.
        basis = (basis + basis[:, ::-1])[:, : (count + 1) // 2] * root[:, None]
        scale = np.linalg.norm(basis, axis=0)
        moments = np.linalg.lstsq(basis / scale, weighted, rcond=1e-12)[0]
        return np.asarray((weighted - basis / scale @ moments).ravel())

    size = max(float(np.linalg.norm(weighted)), 1e-300)
    solution = least_squares(lambda x: left(x) / size, np.zeros(5), ftol=ENDED, xtol=1e-9)
    x = np.asarray(solution.x)
    return centre + near * x[:3], tilted(axis[None], x[None, 3:])[0], spacing


def _best_vector(rows: tuple[Array, Array, Array, Array, Array], centre: Array) -> Array:
    """Moment vector (real part) of one dipole at a place that explains the fluxes best."""
    points, normals, lengths, root, flux = rows
    where = np.tile(centre, (3, 1))
    basis = flux_basis(points, normals, lengths, where, np.eye(3)) * root[:, None]
    moments = np.linalg.lstsq(basis, flux * root[:, None], rcond=1e-12)[0]
    return np.asarray(moments[:, int(np.argmax((moments**2).sum(axis=0)))])
