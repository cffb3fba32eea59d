"""Gives the verdict on one pose solve, the same for a coil, a body and a source.

A solve is judged by itself here: whether its residual passes the gate, whether the pose is in the
volume, whether the descent converged, whether the pose is certain enough, and whether another pose
explains the fluxes equally well. Coils and frames are compared with each other afterwards, in
`anser_ros.tracking.judgement`.
"""

import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from anser_ros import pose_states as states
from anser_ros.tracking.estimate import USUAL_GATE, NoiseScale, TrackerSettings
from anser_ros.tracking.solve import chi2_limit
from anser_ros.tracking.solve_context import SolveContext

Array = NDArray[np.float64]

RARE = 0.01
"""Probability of the residual of many sensors together beyond which it counts as more than noise.
It is smaller than that of a single coil, for many degrees of freedom make much of a small
excess."""

SYSTEMATIC = 25.0
"""Factor on the variances of a pose whose misfit is more than noise where no gate refuses it, and
of one that only a gate wider than the usual one lets pass. A wrong gain moves a pose further than
noise of the same residual: by up to 8 of its sigmas with a factor of 4 (2 to 20 %, on one coil,
simulated). Smaller, and 3 sigma do not hold there; larger, and poses that are asked for in spite
of their misfit are called more uncertain than they are."""


def variance_scale(
    noise: NoiseScale,
    chi2: float,
    freedom: int,
    unknowns: int,
    seldom: float,
    context: SolveContext,
    settings: TrackerSettings,
) -> float:
    """Return the factor on the variances of a pose; 1 where the noise is not adapted.

    ``chi2`` is the whitened residual power, with ``freedom`` degrees of freedom, of a pose of so
    many ``unknowns``; a residual of a probability below ``seldom`` counts as more than noise.
    """
    if not settings.adaptive:
        return 1.0
    usual, ratio = chi2_limit(freedom, seldom) / freedom, chi2 / freedom
    scale = noise.of_frame(
        ratio, usual, freedom / unknowns, context.model_share, context.modes is not None
    )
    most = USUAL_GATE**2 if settings.has_gate else usual
    return scale if ratio <= most else SYSTEMATIC * scale


def verdict(
    settings: TrackerSettings,
    chi2: float,
    freedom: int,
    residual_t: float,
    place: Array,
    converged: bool,
    sigma_m: float,
    scale: float,
    what: str = 'position',
    in_metal: bool = False,
    rivals: Iterable[tuple[float, str]] = (),
) -> tuple[str, str]:
    """Return the state of a solved pose, and the reason in words where it is not ``ok``.

    ``chi2`` is the whitened residual power with ``freedom`` degrees of freedom, ``residual_t`` the
    root mean square of the residual, T. ``place`` (3,) has to be in the volume: the coil, or the
    middle of the body's coils, m, frame fg. ``sigma_m`` is the root of the position covariance's
    trace, m, ``what`` is uncertain where it is too large, and ``scale`` is from `variance_scale`.
    ``in_metal``: whether the pose lies among the dipoles that stand for metal, where the model's
    field is none. ``rivals`` are other poses, the likeliest first: the chi-square of each, and its
    name in the reason; they are looked at only where the pose is good by itself.
    """
    ratio = chi2 / freedom
    if not ratio <= settings.gate**2:
        times = math.sqrt(ratio)
        return (
            states.RESIDUAL,
            f'residual {residual_t:.3g} T is {times:.3g} times the expected one',
        )
    if not settings.box.contains(place):
        return states.OUTSIDE_VOLUME, f'at {millimetres(place)} mm'
    if not converged:
        return states.AMBIGUOUS, 'the solve did not converge'
    if sigma_m > settings.max_sigma_m * settings.max_sigma_factor(scale):
        return states.AMBIGUOUS, f'{what} uncertain by {1e3 * sigma_m:.3g} mm'
    if in_metal and settings.has_gate:
        return states.AMBIGUOUS, 'where there may be metal'
    margin = settings.margin(ratio)
    for other_chi2, words in rivals:
        if other_chi2 < chi2 + margin:
            return states.AMBIGUOUS, f'{words} would explain the fluxes too'
    return states.OK, ''


def millimetres(place: Array) -> str:
    """Return coordinates of a place given in m as text in mm."""
    return ', '.join(f'{1e3 * v:.1f}' for v in place)
