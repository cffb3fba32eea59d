"""A layout fitted to measurements: dipoles placed, pulled to the drawn board, moved if asked."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.dipole_sites import DipoleSites
from anser_ros.calibration.factors import ComplexArray
from anser_ros.calibration.layouts import Generator, Layout, place
from anser_ros.calibration.local import join_regions
from anser_ros.calibration.moments import MomentFit, MomentFitter, Progress
from anser_ros.calibration.pose_correction import Uncertainty
from anser_ros.calibration.positions import PositionFitter
from anser_ros.calibration.prior import DrawnBoard
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import FieldModel

Array = NDArray[np.float64]

RICH = Layout('layer', 16, 1.8, 0.0)
"""The layout at which poses are corrected, for sensors that stay well above the coils."""
RICH_MOST = 22
RICH_SPACING = 0.4
"""Spacing of that layer's dipoles that is fine enough, as a part of the lowest sensor's height."""
RICH_DAMPING = 1e-5
MOVING_DAMPING = 1e-4
MOST_MOVING_ROWS = 6000


@dataclass(frozen=True)
class LayoutFit:
    """DipoleSites, the moments that they are pulled to (or None), and the fit."""

    dipoles: DipoleSites
    prior: ComplexArray | None
    fit: MomentFit


def lowest_height(measurements: Sequence[Measurements], generator: Generator) -> float:
    """Height of the lowest reading over the coils, m; at least 1 cm."""
    lowest = min(float(np.nanmin(m.placed()[0][..., 2])) for m in measurements if len(m.time))
    return max(lowest - float(generator.middle[2]), 0.01)


def rich_layout(measurements: Sequence[Measurements], generator: Generator) -> Layout:
    """A layer fine enough for the lowest sensor; a smaller one where that takes too many."""
    width = 2.0 * float(generator.half_extent.max())
    spacing = RICH_SPACING * lowest_height(measurements, generator)
    count = int(np.clip(np.ceil(width * RICH.extension / spacing) + 1, RICH.count, RICH_MOST))
    extension = float(np.clip(spacing * (count - 1) / width, 1.1, RICH.extension))
    return replace(RICH, count=count, extension=extension)


def placed(
    layout: Layout, generator: Generator, drawn: DrawnBoard | None
) -> tuple[DipoleSites, ComplexArray | None]:
    """A layout's dipoles, and the moments that the damping pulls to."""
    dipoles = place(layout, generator)
    return dipoles, prior_of(layout, dipoles, drawn)


def prior_of(
    layout: Layout, dipoles: DipoleSites, drawn: DrawnBoard | None
) -> ComplexArray | None:
    """The drawn board's moments on these dipoles when the layout is pulled to it."""
    return drawn.moments(dipoles) if layout.prior == 'nominal' and drawn is not None else None


def optimise_positions(
    corrected: Sequence[Measurements],
    weights: Sequence[Array],
    dipoles: DipoleSites,
    prior: ComplexArray | None,
) -> DipoleSites:
    """DipoleSites moved to where they explain the measurements best."""
    rows = sum(m.flux.shape[0] * m.flux.shape[1] for m in corrected)
    step = max(1, -(-rows // MOST_MOVING_ROWS))
    thin = [m.frames(np.arange(0, len(m.time), step)) for m in corrected]
    shares = [w[::step] for w in weights]
    return PositionFitter(thin, shares, dipoles, MOVING_DAMPING, prior).fit().dipoles


def fit_layout(
    measurements: Sequence[Measurements],
    layout: Layout,
    damping: float,
    generator: Generator,
    uncertainty: Uncertainty,
    nominal: FieldModel | None = None,
    alternations: int = 6,
    exact: bool = True,
    progress: Progress | None = None,
) -> LayoutFit:
    """Fit a layout from the start: nothing is taken over from any other fit.

    Parameters
    ----------
    measurements : sequence of Measurements
    layout, damping
        As chosen.
    generator : Generator
    uncertainty : Uncertainty
    nominal : FieldModel or None
        The drawn board, for layouts pulled to it.
    alternations, exact, progress
        As for `MomentFitter.fit`.
    """
    drawn = None
    if nominal is not None and layout.prior == 'nominal':
        drawn = DrawnBoard(nominal, measurements)
    dipoles, prior = placed(layout, generator, drawn)
    if layout.moved:
        layer = place(rich_layout(measurements, generator), generator)
        rich = MomentFitter(measurements, layer, RICH_DAMPING, uncertainty)
        reference = rich.fit(3, exact=False)
        dipoles = optimise_positions(reference.measurements, reference.weights, dipoles, prior)
        prior = prior_of(layout, dipoles, drawn)
    fitter = MomentFitter(measurements, dipoles, damping, uncertainty, prior)
    fit = fitter.fit(alternations, progress, exact)
    if not layout.local:
        return LayoutFit(dipoles, prior, fit)
    layer = place(rich_layout(measurements, generator), generator)
    moments = join_regions(measurements, dipoles, fit, damping, layer)
    return LayoutFit(layer, None, replace(fit, moments=moments))
