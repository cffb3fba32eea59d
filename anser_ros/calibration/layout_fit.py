"""Fits a layout: its dipoles are placed, pulled towards the drawn board, moved if asked."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.coaxial import fit_coaxial
from anser_ros.calibration.coil_places import CoilPlacer
from anser_ros.calibration.dipole_sites import DipoleSites
from anser_ros.calibration.factors import ComplexArray
from anser_ros.calibration.layouts import Generator, Layout, place
from anser_ros.calibration.local import join_regions
from anser_ros.calibration.moments import MomentFit, MomentFitter, Progress
from anser_ros.calibration.positions import PositionFitter
from anser_ros.calibration.prior import ScaledNominal
from anser_ros.field.measurements import Measurements
from anser_ros.settings import Accuracy

Array = NDArray[np.float64]

RICH = Layout('layer', 16, 1.8, 0.0)
"""The layer that corrects poses for sensors that stay well above the coils. It should represent
any field of the board better than the candidates that are compared at these poses."""
RICH_MOST = 22
"""Dipoles along a side of that layer at most, however low the sensors come; the time of a fit
grows with the fourth power of it or faster."""
RICH_SPACING = 0.4
"""Spacing of that layer's dipoles as a fraction of the lowest sensor's height. A layer whose
spacing is larger than the height has the field of single dipoles there."""
RICH_DAMPING = 1e-5
"""Damping of that layer's moments, a fraction of the largest singular value: small, so that the
field is not biased, and large enough for a fit by inner products."""
MOVING_DAMPING = 1e-4
"""Damping of the moments while dipoles are moved, a fraction of the largest singular value. It
keeps two dipoles that come close together from growing huge moments of opposite sign."""
MOST_MOVING_ROWS = 6000
"""Readings by which dipoles are moved at most; the final fit of the moments takes all. Some
hundred positions need no more, and the time grows in proportion."""
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


class LayoutPlacer:
    """Places dipoles over a generator, pulled to what it is drawn like if their layout says so.

    Dipoles and the moments (N, K) that their damping pulls to go together; None for zero.
    """

    def __init__(self, generator: Generator, measurements: Sequence[Measurements]) -> None:
        self.generator, self.measurements = generator, measurements

    @cached_property
    def scaled(self) -> ScaledNominal | None:
        """Return the nominal model at the scale of the measurements, where there is one."""
        nominal = self.generator.nominal
        return None if nominal is None else ScaledNominal(nominal, self.measurements)

    def placed(self, layout: Layout) -> tuple[DipoleSites, ComplexArray | None]:
        """Return a layout's dipoles as its rule places them."""
        if layout.kind == 'drawing' and self.scaled is not None:
            nominal = self.scaled.nominal
            return CoilPlacer(nominal).sites, nominal.moments * self.scaled.gains
        dipoles = place(layout, self.generator)
        return dipoles, self._prior(layout, dipoles)

    def _prior(self, layout: Layout, dipoles: DipoleSites) -> ComplexArray | None:
        if layout.prior != 'nominal' or self.scaled is None:
            return None
        return self.scaled.moments(dipoles)

    def moved(
        self, layout: Layout, corrected: Sequence[Measurements], weights: Sequence[Array]
    ) -> tuple[DipoleSites, ComplexArray | None]:
        """Return a layout's dipoles where they explain measurements at corrected poses best.

        Those on an axis stay on it, those of a drawn coil move together, others by themselves.
        """
        rows = sum(m.flux.shape[0] * m.flux.shape[1] for m in corrected)
        step = max(1, -(-rows // MOST_MOVING_ROWS))
        thin = [m.frames(np.arange(0, len(m.time), step)) for m in corrected]
        shares = [w[::step] for w in weights]
        if layout.kind == 'drawing' and self.scaled is not None:
            return CoilPlacer(self.scaled.nominal).fit(thin, shares)
        dipoles, prior = self.placed(layout)
        if layout.kind == 'coaxial':
            found = fit_coaxial(thin, shares, dipoles, layout.count)
        else:
            found = PositionFitter(thin, shares, dipoles, MOVING_DAMPING, prior).fit()
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
            fitter.start_at(self._rich[0])
        fit = fitter.fit(alternations, progress, exact)
        if not layout.local:
            return LayoutFit(dipoles, fit)
        moments = join_regions(self.measurements, dipoles, fit, damping, self._layer)
        return LayoutFit(self._layer, replace(fit, moments=moments))

    def _sites(self, layout: Layout) -> tuple[DipoleSites, ComplexArray | None]:
        if layout not in self._placed:
            if layout.moved:
                _, fit = self._rich
                found = self.placer.moved(layout, fit.measurements, fit.weights)
            else:
                found = self.placer.placed(layout)
            self._placed[layout] = found
        return self._placed[layout]

    @cached_property
    def _layer(self) -> DipoleSites:
        generator = self.placer.generator
        return place(rich_layout(self.measurements, generator), generator)

    @cached_property
    def _rich(self) -> tuple[MomentFitter, MomentFit]:
        """The fit of a rich layer, at whose poses dipoles are moved."""
        fitter = MomentFitter(self.measurements, self._layer, RICH_DAMPING, self.accuracy)
        return fitter, fitter.fit(3, exact=False)
