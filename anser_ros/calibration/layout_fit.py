"""Fits a layout: its dipoles are placed, pulled towards the drawn board, moved if asked."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

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
from anser_ros.calibration.prior import DrawnBoard
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import FieldModel
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


@dataclass(frozen=True)
class LayoutFit:
    """Holds the dipoles of a fitted layout, the moments that they are pulled to, and the fit.

    Attributes
    ----------
    dipoles : DipoleSites
        N dipoles as placed or moved.
    prior : ndarray, shape (N, K), complex, or None
        Moments towards which the damping pulls, A m^2; None for zero.
    fit : MomentFit
        The fit of their moments.
    """

    dipoles: DipoleSites
    prior: ComplexArray | None
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


def placed(
    layout: Layout, generator: Generator, drawn: DrawnBoard | None
) -> tuple[DipoleSites, ComplexArray | None]:
    """Return a layout's dipoles, and the moments towards which the damping pulls."""
    if layout.kind == 'drawing' and drawn is not None:
        return CoilPlacer(drawn.nominal).sites, drawn.nominal.moments * drawn.gains
    dipoles = place(layout, generator)
    return dipoles, prior_of(layout, dipoles, drawn)


def prior_of(
    layout: Layout, dipoles: DipoleSites, drawn: DrawnBoard | None
) -> ComplexArray | None:
    """Return the drawn board's moments on dipoles, or None if the layout is not pulled to it."""
    return drawn.moments(dipoles) if layout.prior == 'nominal' and drawn is not None else None


def optimise_positions(
    corrected: Sequence[Measurements],
    weights: Sequence[Array],
    dipoles: DipoleSites,
    prior: ComplexArray | None,
    layout: Layout,
    drawn: DrawnBoard | None,
) -> tuple[DipoleSites, ComplexArray | None]:
    """Return dipoles moved to where they explain the measurements best, and their prior there.

    Parameters
    ----------
    corrected : sequence of Measurements
        Measurements at their corrected poses, one per body and session.
    weights : sequence of ndarray, shape (F, S)
        Weights of the readings.
    dipoles : DipoleSites
        The dipoles to start from.
    prior : ndarray, shape (N, K), complex, or None
        Moments towards which the damping pulls, A m^2.
    layout : Layout
        Of the dipoles: those on an axis stay on it, those of a drawn coil move together, and all
        others each by itself.
    drawn : DrawnBoard or None
        The drawn board.
    """
    rows = sum(m.flux.shape[0] * m.flux.shape[1] for m in corrected)
    step = max(1, -(-rows // MOST_MOVING_ROWS))
    thin = [m.frames(np.arange(0, len(m.time), step)) for m in corrected]
    shares = [w[::step] for w in weights]
    if layout.kind == 'drawing' and drawn is not None:
        return CoilPlacer(drawn.nominal).fit(thin, shares)
    if layout.kind == 'coaxial':
        moved = fit_coaxial(thin, shares, dipoles, layout.count)
    else:
        moved = PositionFitter(thin, shares, dipoles, MOVING_DAMPING, prior).fit().dipoles
    return moved, prior_of(layout, moved, drawn)


class LayoutFitter:
    """Fits layouts to the same measurements; what several fits have in common is done once.

    Parameters
    ----------
    measurements : sequence of Measurements
        Tool measurements with poses, one per body and session.
    generator : Generator
        Places of the coils.
    accuracy : Accuracy
        Flux noise and pose jitter.
    nominal : FieldModel, optional
        The drawn board, for layouts that are pulled towards it.
    """

    def __init__(
        self,
        measurements: Sequence[Measurements],
        generator: Generator,
        accuracy: Accuracy,
        nominal: FieldModel | None = None,
    ) -> None:
        self.measurements, self.generator = measurements, generator
        self.accuracy, self.nominal = accuracy, nominal
        self._placed: dict[Layout, tuple[DipoleSites, ComplexArray | None]] = {}

    def fit(
        self,
        layout: Layout,
        damping: float,
        alternations: int = 6,
        exact: bool = True,
        progress: Progress | None = None,
    ) -> LayoutFit:
        """Fit a layout from the start, without using any other data.

        Parameters
        ----------
        layout : Layout
            The layout.
        damping : float
            Damping of the moments.
        alternations, exact, progress
            As for `MomentFitter.fit`.
        """
        dipoles, prior = self._sites(layout)
        fitter = MomentFitter(self.measurements, dipoles, damping, self.accuracy, prior)
        if layout.moved:
            fitter.start_at(self._rich[0])
        fit = fitter.fit(alternations, progress, exact)
        if not layout.local:
            return LayoutFit(dipoles, prior, fit)
        layer = self._layer
        moments = join_regions(self.measurements, dipoles, fit, damping, layer)
        return LayoutFit(layer, None, replace(fit, moments=moments))

    def _sites(self, layout: Layout) -> tuple[DipoleSites, ComplexArray | None]:
        """A layout's dipoles where the measurements put them, and what they are pulled to."""
        if layout not in self._placed:
            drawn = self._drawn if layout.prior == 'nominal' else None
            dipoles, prior = placed(layout, self.generator, drawn)
            if layout.moved:
                _, fit = self._rich
                dipoles, prior = optimise_positions(
                    fit.measurements, fit.weights, dipoles, prior, layout, drawn
                )
            self._placed[layout] = dipoles, prior
        return self._placed[layout]

    @cached_property
    def _drawn(self) -> DrawnBoard | None:
        return None if self.nominal is None else DrawnBoard(self.nominal, self.measurements)

    @cached_property
    def _layer(self) -> DipoleSites:
        return place(rich_layout(self.measurements, self.generator), self.generator)

    @cached_property
    def _rich(self) -> tuple[MomentFitter, MomentFit]:
        """The fit of a rich layer, at whose poses dipoles are moved."""
        fitter = MomentFitter(self.measurements, self._layer, RICH_DAMPING, self.accuracy)
        return fitter, fitter.fit(3, exact=False)
