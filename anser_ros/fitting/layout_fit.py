"""A layout fitted to measurements: dipoles placed, pulled to the drawn board, moved if asked."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.fitting.dipoles import Dipoles
from anser_ros.fitting.factors import ComplexArray
from anser_ros.fitting.layouts import Generator, Layout, place
from anser_ros.fitting.local import join_regions
from anser_ros.fitting.measurements import Measurements
from anser_ros.fitting.model import FieldModel
from anser_ros.fitting.moments import MomentFit, MomentFitter, Progress
from anser_ros.fitting.pose_correction import Uncertainty
from anser_ros.fitting.positions import PositionFitter
from anser_ros.fitting.prior import DrawnBoard

Array = NDArray[np.float64]

RICH = Layout('layer', 16, 1.8, 0.0)
"""The layout at which poses are corrected before positions are optimised."""
RICH_DAMPING = 1e-5
MOVING_DAMPING = 1e-4
MOST_MOVING_ROWS = 6000


@dataclass(frozen=True)
class LayoutFit:
    """Dipoles, the moments that they are pulled to (or None), and the fit."""

    dipoles: Dipoles
    prior: ComplexArray | None
    fit: MomentFit


def placed(
    layout: Layout, generator: Generator, drawn: DrawnBoard | None
) -> tuple[Dipoles, ComplexArray | None]:
    """A layout's dipoles, and the moments that the damping pulls to."""
    dipoles = place(layout, generator)
    return dipoles, prior_of(layout, dipoles, drawn)


def prior_of(layout: Layout, dipoles: Dipoles, drawn: DrawnBoard | None) -> ComplexArray | None:
    """The drawn board's moments on these dipoles when the layout is pulled to it."""
    return drawn.moments(dipoles) if layout.prior == 'nominal' and drawn is not None else None


def optimise_positions(
    corrected: Sequence[Measurements],
    weights: Sequence[Array],
    dipoles: Dipoles,
    prior: ComplexArray | None,
) -> Dipoles:
    """Dipoles moved to where they explain the measurements best."""
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
        rich = MomentFitter(measurements, place(RICH, generator), RICH_DAMPING, uncertainty)
        reference = rich.fit(3, exact=False)
        dipoles = optimise_positions(reference.measurements, reference.weights, dipoles, prior)
        prior = prior_of(layout, dipoles, drawn)
    fitter = MomentFitter(measurements, dipoles, damping, uncertainty, prior)
    fit = fitter.fit(alternations, progress, exact)
    if not layout.local:
        return LayoutFit(dipoles, prior, fit)
    layer = place(replace(RICH, extension=layout.extension, depth_m=layout.depth_m), generator)
    moments = join_regions(measurements, dipoles, fit, damping, layer)
    return LayoutFit(layer, None, replace(fit, moments=moments))
