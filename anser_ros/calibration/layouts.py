"""Lays virtual dipoles out: in layers over the field generator, on its coils, or on axes of their
own.

A magnet, an electromagnet or a coil of unknown shape has an axis; around it the field hardly
changes. One dipole is its far field. Equal distances h along the axis make three or five dipoles
the multipoles of the source's size: their moments are linear, and of either sign, so that a long
source and a flat one are both described, whatever h is, as long as it is small compared with the
distance of the sensors. Such a source's place and axis are found with the moments eliminated
(`fit_coaxial`, variable projection).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from anser_ros.arrays import Array, ComplexArray, as_complex, as_real
from anser_ros.calibration.least_squares import GramFactor
from anser_ros.calibration.readings import DipoleSites, weighted_readings
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import FieldModel
from anser_ros.physics.dipole import flux_basis
from anser_ros.physics.rotations import tilted

Rows = tuple[Array, Array, Array, Array, Array]
"""Points, axes, lengths, roots of weights and real fluxes of readings, (P, ...)."""

SPREAD = 0.2
"""Distance of neighbouring dipoles, as a fraction s of that from the source to the nearest sensor:
the first multipole that is left out is smaller than what is kept by s squared."""
FIRST_SPACING_M = 1e-3
"""Distance of the dipoles before any data are seen, m. Any value far below the distance of the
sensors gives the same first fit."""
ENDED = 1e-10
"""Relative change of the sum of squares at which the search has ended."""
PROJECTION_DAMPING = 1e-6
"""Damping when a known field is expressed by dipoles: it keeps parallel columns from making huge
moments."""


def moments_of_field(
    points: Array, axes: Array, flux: Array, dipoles: DipoleSites
) -> ComplexArray:
    """Moments (N, K), A m^2, that make given real fluxes (P, 2K), T, best."""
    factor = GramFactor(len(dipoles), flux.shape[1])
    factor.add(flux_basis(points, axes, None, dipoles.positions, dipoles.directions), flux)
    return as_complex(factor.spectrum().solve(PROJECTION_DAMPING))


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
    rows: Rows, centre: Array, axis: Array, count: int, near: float
) -> tuple[Array, Array, float]:
    """Place, axis and spacing of one emitter's source, from rows (P, ...) and fluxes (P, 2)."""
    points, normals, lengths, root, flux = rows
    weighted = flux * root[:, None]
    moments, _ = _one_vector(rows, centre)
    first = moments[:, int(np.argmax((moments**2).sum(axis=0)))]  # which explains the fluxes best
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


def _one_vector(rows: Rows, centre: Array) -> tuple[Array, Array]:
    """Moments (3, 2) of one dipole at a place that explain the fluxes best, and what is left."""
    points, normals, lengths, root, flux = rows
    where, weighted = np.tile(centre, (3, 1)), flux * root[:, None]
    basis = flux_basis(points, normals, lengths, where, np.eye(3)) * root[:, None]
    moments = np.linalg.lstsq(basis, weighted, rcond=1e-12)[0]
    return np.asarray(moments), np.asarray(weighted - basis @ moments)


UNIT_Z = np.array([0.0, 0.0, 1.0])
"""Direction of the dipoles of a flat layer, the normal of the board."""
CLUSTER = np.vstack([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
"""Places of a cluster's dipoles, in its spacing: three components in the middle and at six places
around it make every dipole and quadrupole, and all octupoles but one."""
FREE_KINDS = ('cluster', 'shared_cluster')
"""Kinds of layouts of clusters: of each emitter its own, or of all the same ones, as currents in
one coil that another drives ask for."""
SAME_PLACE = 0.5
"""Distance of two emitters' middles, in spacings, below which one cluster does for both."""


def clusters(centres: Array, spacing_m: float) -> DipoleSites:
    """Return dipoles around emitters of any shape, with middles (K, 3), m, frame fg.

    Moments grow with the power of a source's size over the spacing: damping, which holds all of
    them alike, holds each multipole as much as a source of that size lets it be.
    """
    near = np.linalg.norm(centres[:, None] - centres, axis=2) <= SAME_PLACE * spacing_m
    first = near.argmax(axis=1)
    of, where = np.unique(first, return_inverse=True)
    places = centres[of][:, None, :] + spacing_m * CLUSTER
    sites = DipoleSites.of_any_direction(places.reshape(-1, 3))
    own = np.repeat(np.arange(len(of)), 3 * len(CLUSTER))[:, None] == where
    return DipoleSites(sites.positions, sites.directions, own)


def fit_clusters(
    corrected: Sequence[Measurements], weights: Sequence[Array], centres: Array
) -> DipoleSites:
    """Return clusters about the places where one dipole of any direction explains each emitter.

    ``centres`` (K, 3): about where the emitters are, m, frame fg.
    """
    (points, normals, lengths, measured), root = weighted_readings(corrected, weights)
    flux, found, near = as_real(measured), [], []
    for k, centre in enumerate(centres):
        pair = np.ascontiguousarray(flux[:, 2 * k : 2 * k + 2])
        rows = (points, normals, lengths, root, pair)
        reach = float(np.linalg.norm(points - centre, axis=1).min())
        size = max(float(np.linalg.norm(pair * root[:, None])), 1e-300)

        def left(x: Array, rows: Rows = rows, start: Array = centre, by: float = size) -> Array:
            return _one_vector(rows, start + x)[1].ravel() / by

        solution = least_squares(left, np.zeros(3), x_scale=reach, ftol=ENDED, xtol=1e-9)
        found.append(centre + np.asarray(solution.x))
        near.append(float(np.linalg.norm(points - found[-1], axis=1).min()))
    return clusters(np.array(found), SPREAD * min(near))


@dataclass(frozen=True)
class Generator:
    """Holds what is known of a field generator before any readings."""

    centres: Array  # (K, 3): coil centres, m, frame fg
    turns_deg: Array  # (K,): rotation of each coil about z, degrees
    side_m: float  # outer side of a coil, m
    emitters: tuple[str, ...] = ()  # names of the coils
    frequencies_hz: tuple[float, ...] = ()
    nominal: FieldModel | None = None  # of its drawing: a prior of fits, compared with the result

    @property
    def half_extent(self) -> Array:
        """Return half sizes in x and y of the rectangle around all coils, shape (2,), m."""
        low, high = self._bounds()
        return np.asarray(np.maximum(high - low, 1e-3) / 2.0)

    @property
    def middle(self) -> Array:
        """Return the centre of that rectangle at the coils' mean height, shape (3,), m."""
        low, high = self._bounds()
        return np.array([*((low + high) / 2.0), self.centres[:, 2].mean()])

    def _bounds(self) -> tuple[Array, Array]:
        turn = np.deg2rad(self.turns_deg)
        reach = self.side_m / 2.0 * (np.abs(np.cos(turn)) + np.abs(np.sin(turn)))
        flat = self.centres[:, :2]
        return (flat - reach[:, None]).min(axis=0), (flat + reach[:, None]).max(axis=0)


@dataclass(frozen=True)
class Layout:
    """Describes a rule by which dipoles are placed and fitted."""

    # 'layer' of z-dipoles, 'layer_xyz' of dipoles with three free components, z-dipoles on the
    # 'coils', 'coaxial' dipoles along an axis of its own for each coil, a 'cluster' or
    # 'shared_cluster' about each, those of the coils of the 'drawing', or another rule, which has
    # its own words
    kind: str
    count: int  # dipoles along a side of the layer, of each coil, along each axis, or in all
    extension: float  # size of the layer as a multiple of the field generator's
    depth_m: float  # depth of the layer below the coils, m
    prior: str = 'none'  # what the damping pulls the moments to: 'none' (zero) or 'nominal'
    moved: bool = False  # whether the dipoles are then moved to where they explain the data best
    words: str = ''  # for a report, where the rule is none of these

    def describe(self) -> str:
        """Return the layout in words for a report."""
        if self.words:
            return self.words
        if self.kind == 'coaxial':
            return f'{self.count} on an axis of its own for every emitter, place and axis free'
        if self.kind in FREE_KINDS:
            more = '' if self.kind == 'cluster' else ', shared by all emitters'
            return f'{self.count} of any direction about every emitter, place free{more}'
        if self.kind == 'drawing':
            return f'{self.count} of the drawn coils, each coil placed where it fits, pulled to it'
        more = ', pulled to the drawn board' if self.prior == 'nominal' else ''
        if self.kind == 'coils':
            return f'{self.count}x{self.count} z-dipoles on every coil{more}'
        parts = 'z-dipoles' if self.kind == 'layer' else 'three-component dipoles'
        return (
            f"{self.count}x{self.count} {parts}, {self.extension:.2f} x the coils' extent, "
            f'{1e3 * self.depth_m:.1f} mm below{more}'
        )


def grid(count: int, half: Array) -> Array:
    """Return a lattice of count x count points over -half..half in x and y, shape (count^2, 2)."""
    steps = np.linspace(-1.0, 1.0, count) if count > 1 else np.zeros(1)
    x, y = np.meshgrid(steps * half[0], steps * half[1], indexing='ij')
    return np.stack([x.ravel(), y.ravel()], axis=1)


def place(layout: Layout, generator: Generator) -> DipoleSites:
    """Return the dipoles of a layout over a field generator."""
    if layout.kind == 'coils':
        return _on_coils(layout, generator)
    if layout.kind == 'drawing' and generator.nominal is not None:
        return DipoleSites(generator.nominal.positions, generator.nominal.directions)
    if layout.kind == 'coaxial':
        count = len(generator.centres)
        upright, spacing = np.tile(UNIT_Z, (count, 1)), np.full(count, FIRST_SPACING_M)
        return coaxial(generator.centres, upright, layout.count, spacing)
    if layout.kind in FREE_KINDS:
        found = clusters(generator.centres, SPREAD * generator.side_m)
        return found if layout.kind == 'cluster' else found.shared
    flat = grid(layout.count, generator.half_extent * layout.extension)
    middle = generator.middle
    positions = np.empty((flat.shape[0], 3))
    positions[:, :2] = flat + middle[:2]
    positions[:, 2] = middle[2] - layout.depth_m
    if layout.kind == 'layer':
        return DipoleSites(positions, np.tile(UNIT_Z, (positions.shape[0], 1)))
    return DipoleSites.of_any_direction(positions)


def _on_coils(layout: Layout, generator: Generator) -> DipoleSites:
    half = np.full(2, generator.side_m / 2.0 * layout.extension)
    flat = grid(layout.count, half * (1.0 - 1.0 / (2.0 * layout.count)))
    positions = []
    for centre, turn in zip(generator.centres, np.deg2rad(generator.turns_deg), strict=True):
        c, s = np.cos(turn), np.sin(turn)
        turned = flat @ np.array([[c, s], [-s, c]])
        height = np.full((flat.shape[0], 1), centre[2] - layout.depth_m)
        positions.append(np.concatenate([turned + centre[:2], height], axis=1))
    stacked = np.concatenate(positions)
    return DipoleSites(stacked, np.tile(UNIT_Z, (stacked.shape[0], 1)))
