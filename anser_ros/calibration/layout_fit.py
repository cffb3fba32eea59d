"""Fits a layout: its dipoles are placed, pulled towards the nominal field, moved if asked.

The nominal model is first scaled by one complex gain per emitter and expressed by the layout's
dipoles (`ScaledNominal`); the damping pulls towards these moments, so that moments which the data
do not determine stay as drawn. Dipoles may then be moved (`LayoutPlacer`). `LayoutFitter` does
what several fits have in common once.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np

from anser_ros.arrays import Array, ComplexArray, as_real
from anser_ros.calibration.drawn_fit import drawn_where_read
from anser_ros.calibration.layouts import (
    FREE_KINDS,
    Generator,
    Layout,
    fit_clusters,
    fit_coaxial,
    moments_of_field,
    place,
)
from anser_ros.calibration.moments import MomentFit, MomentFitter, Progress
from anser_ros.calibration.readings import DipoleSites, usable_readings, usable_weights, with_pose
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import FieldModel
from anser_ros.physics.sensor import along_each_axis
from anser_ros.settings import Accuracy

POINTS_ALONG = 11
"""Points along x and y (half along z) where dipoles are to make the nominal field: 2000 equations
for at most a few hundred dipoles."""
MARGIN = 0.3
"""How far beyond the measured volume the nominal field is followed, relative to its half size: a
scan as wide as the board then covers the default tracked volume (`volume.REACH`)."""
LEAST_HALF_SIZE_M = 0.02
"""Half size of that volume at least, m, for measurements in a plane: over 2 cm a field 10 cm from
its coils changes by half."""
LEAST_HEIGHT = 0.8
"""Lowest point of that volume as a fraction of the lowest reading's height: there the field is at
most twice as strong, and farther down it changes too fast for a layer of dipoles."""


class ScaledNominal:
    """Holds the nominal field in and around a measured volume, scaled to the measurements."""

    def __init__(self, nominal: FieldModel, measurements: Sequence[Measurements]) -> None:
        self.points, self.axes = volume_lattice(measurements)
        gains = emitter_gains(nominal, measurements)
        self.nominal = replace(nominal, moments=nominal.moments * gains)
        self.flux = self.nominal.flux(self.points, self.axes)

    def moments(self, dipoles: DipoleSites) -> ComplexArray:
        """Return the moments (N, K), A m^2, with which N dipoles make the drawn field best."""
        return moments_of_field(self.points, self.axes, as_real(self.flux), dipoles)


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


RICH = Layout('layer', 16, 1.8, 0.0)
"""The layer that corrects poses, well above the coils: better than any layout that is compared."""
RICH_MOST = 22
"""Dipoles along its side at most; the time of a fit grows with the fourth power or faster."""
RICH_SPACING = 0.4
"""Spacing of its dipoles as a fraction of the lowest sensor's height: at a larger one than the
height the field is that of single dipoles."""
RICH_DAMPING = 1e-5
"""Damping of its moments: small, so as not to bias the field, and enough for a Gram matrix."""
MOST_MOVING_ROWS = 6000
"""Readings by which dipoles are moved at most: some hundred positions need no more."""
AS_GOOD = 1.5
"""Factor by which the noise of fewer dipoles may be larger than that of more, as of a layer:
these take up errors of the sensors, and of the poses of one region for another."""
LEAST_HEIGHT_M = 0.01
"""Height of the lowest reading at least, m, for recordings in which a sensor touches the board."""
LEAST_EXTENSION = 1.1
"""Size of the rich layer at least, as a multiple of the coils' extent."""


class LayoutFit(NamedTuple):
    """Holds the dipoles of a fitted layout, as placed or moved, and the fit of their moments."""

    dipoles: DipoleSites
    fit: MomentFit


def lowest_height(measurements: Sequence[Measurements], generator: Generator) -> float:
    """Return the height of the lowest reading over the coils, m, at least `LEAST_HEIGHT_M`."""
    lowest = min(float(np.nanmin(m.placed()[0][..., 2])) for m in measurements if len(m.time))
    return max(lowest - float(generator.middle[2]), LEAST_HEIGHT_M)


def rich_layout(measurements: Sequence[Measurements], generator: Generator) -> Layout:
    """Return a layer that is fine enough for the lowest sensor.

    If that needs more than `RICH_MOST` dipoles along a side, the layer is smaller.
    """
    width = 2.0 * float(generator.half_extent.max())
    spacing = RICH_SPACING * lowest_height(measurements, generator)
    count = int(np.clip(np.ceil(width * RICH.extension / spacing) + 1, RICH.count, RICH_MOST))
    extension = float(np.clip(spacing * (count - 1) / width, LEAST_EXTENSION, RICH.extension))
    return replace(RICH, count=count, extension=extension)


def free_bases(measurements: Sequence[Measurements], generator: Generator) -> list[DipoleSites]:
    """Return dipoles about the emitters, wherever they are and whatever their shape.

    First those that all emitters share, then each emitter's own; none where there is a drawing.
    """
    if generator.nominal is not None:
        return []
    posed = [with_pose(m) for m in measurements]
    own = fit_clusters(posed, [usable_weights(m) for m in posed], generator.centres)
    return [own.shared, own]


Tried = TypeVar('Tried')


def richest(tried: Sequence[Tried], noise_t: Sequence[float]) -> Tried:
    """Return the fit of the last basis that leaves about as little noise as any, T."""
    limit = AS_GOOD * min(noise_t)
    return [one for one, noise in zip(tried, noise_t, strict=True) if noise <= limit][-1]


def rich_fit(
    measurements: Sequence[Measurements], bases: Sequence[DipoleSites], accuracy: Accuracy
) -> tuple[MomentFitter, MomentFit]:
    """Return the fit of those of several dipoles that leave least for each degree of freedom."""
    fitters = [MomentFitter(measurements, sites, RICH_DAMPING, accuracy) for sites in bases]
    fits = [(fitter, fitter.fit(3, exact=False)) for fitter in fitters]
    return richest(fits, [fit.noise_t for _, fit in fits])


class LayoutPlacer:
    """Places dipoles over a generator, with moments (N, K) that damping pulls to, None for 0."""

    def __init__(self, generator: Generator, measurements: Sequence[Measurements]) -> None:
        self.generator, self.measurements = generator, measurements

    @cached_property
    def scaled(self) -> ScaledNominal | None:
        """Return the nominal model at the scale of the measurements, where there is one."""
        nominal = self.generator.nominal
        return None if nominal is None else ScaledNominal(nominal, self.measurements)

    def placed(self, layout: Layout) -> tuple[DipoleSites, ComplexArray | None]:
        """Return a layout's dipoles as its rule places them."""
        dipoles = place(layout, self.generator)
        if layout.kind == 'drawing' and self.scaled is not None:
            return dipoles, self.scaled.nominal.moments
        return dipoles, self._prior(layout, dipoles)

    def _prior(self, layout: Layout, dipoles: DipoleSites) -> ComplexArray | None:
        if layout.prior != 'nominal' or self.scaled is None:
            return None
        return self.scaled.moments(dipoles)

    def moved(
        self, layout: Layout, corrected: Sequence[Measurements], weights: Sequence[Array]
    ) -> tuple[DipoleSites, ComplexArray | None]:
        """Return a layout's dipoles where they explain measurements at corrected poses best.

        Those on an axis stay on it, those of a drawn coil or of a cluster move together.
        """
        if layout.kind == 'drawing' and self.scaled is not None:
            coils = drawn_where_read(
                corrected, replace(self.generator, nominal=self.scaled.nominal)
            )
            return DipoleSites(coils.positions, coils.directions), coils.moments
        rows = sum(m.flux.shape[0] * m.flux.shape[1] for m in corrected)
        step = max(1, -(-rows // MOST_MOVING_ROWS))
        thin = [m.frames(np.arange(0, len(m.time), step)) for m in corrected]
        shares = [w[::step] for w in weights]
        if layout.kind in FREE_KINDS:
            found = fit_clusters(thin, shares, self.generator.centres)
            return found if layout.kind == 'cluster' else found.shared, None
        start, _ = self.placed(layout)
        found = fit_coaxial(thin, shares, start, layout.count)
        return found, self._prior(layout, found)


class LayoutFitter:
    """Fits layouts to the same measurements; what several fits have in common is done once."""

    def __init__(
        self, measurements: Sequence[Measurements], generator: Generator, accuracy: Accuracy
    ) -> None:
        self.measurements, self.accuracy = measurements, accuracy
        self.placer = LayoutPlacer(generator, measurements)
        self._placed: dict[Layout, tuple[DipoleSites, ComplexArray | None]] = {}

    def fit(
        self,
        layout: Layout,
        damping: float,
        alternations: int = 6,
        exact: bool = True,
        progress: Progress | None = None,
    ) -> LayoutFit:
        """Fit a layout from the start, without any other data; the rest as `MomentFitter.fit`."""
        dipoles, prior = self._sites(layout)
        fitter = MomentFitter(self.measurements, dipoles, damping, self.accuracy, prior)
        if layout.moved:
            fitter.start_at(self.rich[0])
        return LayoutFit(dipoles, fitter.fit(alternations, progress, exact))

    def _sites(self, layout: Layout) -> tuple[DipoleSites, ComplexArray | None]:
        if layout not in self._placed:
            if layout.moved:
                _, fit = self.rich
                found = self.placer.moved(layout, fit.measurements, fit.weights)
            else:
                found = self.placer.placed(layout)
            self._placed[layout] = found
        return self._placed[layout]

    @cached_property
    def rich(self) -> tuple[MomentFitter, MomentFit]:
        """Return the fit at whose poses dipoles are moved."""
        generator = self.placer.generator
        layer = place(rich_layout(self.measurements, generator), generator)
        bases = [layer, *free_bases(self.measurements, generator)]
        return rich_fit(self.measurements, bases, self.accuracy)
