"""Lays virtual dipoles out: in layers over the field generator's extent, or on its coils."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.coaxial import FIRST_SPACING_M, coaxial
from anser_ros.calibration.dipole_sites import DipoleSites
from anser_ros.field.model import FieldModel

Array = NDArray[np.float64]

UNIT_Z = np.array([0.0, 0.0, 1.0])
"""Direction of the dipoles of a flat layer, the normal of the board."""


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
    # 'coils', 'coaxial' dipoles along an axis of its own for each coil, those of the coils of the
    # 'drawing', or another rule, which has its own words
    kind: str
    count: int  # dipoles along a side of the layer, of each coil, along each axis, or in all
    extension: float  # size of the layer as a multiple of the field generator's
    depth_m: float  # depth of the layer below the coils, m
    prior: str = 'none'  # what the damping pulls the moments to: 'none' (zero) or 'nominal'
    moved: bool = False  # whether the dipoles are then moved to where they explain the data best
    local: bool = False  # whether overlapping regions get separate moments
    words: str = ''  # for a report, where the rule is none of these

    def describe(self) -> str:
        """Return the layout in words for a report."""
        if self.words:
            return self.words
        if self.kind == 'coaxial':
            return f'{self.count} on an axis of its own for every emitter, place and axis free'
        if self.kind == 'drawing':
            return f'{self.count} of the drawn coils, each coil placed where it fits, pulled to it'
        more = ', pulled to the drawn board' if self.prior == 'nominal' else ''
        more += ', positions optimised' if self.moved else ''
        more += ', in overlapping regions' if self.local else ''
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
    if layout.kind == 'coaxial':
        count = len(generator.centres)
        upright, spacing = np.tile(UNIT_Z, (count, 1)), np.full(count, FIRST_SPACING_M)
        return coaxial(generator.centres, upright, layout.count, spacing)
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
