"""Gives the verdict on one pose solve, the same for a coil, a body and a source.

A solve is judged by itself here: whether its residual passes the gate, whether the pose is in the
volume, whether the descent converged, whether the pose is certain enough, and whether another pose
explains the fluxes equally well. Coils and frames are compared with each other afterwards, in
`anser_ros.tracking.judgement`.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from anser_ros import pose_states as states
from anser_ros.arrays import Array
from anser_ros.kernel_cache import inlined
from anser_ros.tracking.estimate import (
    USUAL_GATE,
    NoiseScale,
    PoseEstimate,
    TrackerSettings,
    no_pose,
)
from anser_ros.tracking.solve import chi2_limit
from anser_ros.tracking.solve_context import SolveContext

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


SOUND, MISFIT, OUTSIDE, UNENDED, UNCERTAIN, IN_METAL = range(6)
"""What may be wrong with a solved pose by itself, in the order in which it is looked at."""


@inlined
def fault_of(ratio, gate, is_inside, converged, sigma_m, most_m, in_metal):  # type: ignore[no-untyped-def]
    """Return what is wrong with a solved pose by itself: the first that holds."""
    if not ratio <= gate * gate:
        return MISFIT
    if not is_inside:
        return OUTSIDE
    if not converged:
        return UNENDED
    if sigma_m > most_m:
        return UNCERTAIN
    return IN_METAL if in_metal else SOUND


def usual_and_most(settings: TrackerSettings, freedom: int, seldom: float) -> tuple[float, float]:
    """Return residual powers per freedom: that which noise exceeds with a probability of
    ``seldom``, and that beyond which a misfit is systematic.
    """
    usual = chi2_limit(freedom, seldom) / freedom
    return usual, USUAL_GATE**2 if settings.has_gate else usual


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
    (usual, most), ratio = usual_and_most(settings, freedom, seldom), chi2 / freedom
    scale = noise.of_frame(
        ratio, usual, freedom / unknowns, context.model_share, context.modes is not None
    )
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
    most_m = settings.max_sigma_m * settings.max_sigma_factor(scale)
    fault = fault_of.py_func(
        ratio, settings.gate, settings.box.contains(place), converged, sigma_m, most_m,
        in_metal and settings.has_gate,
    )  # fmt: skip
    if fault == MISFIT:
        times = math.sqrt(ratio)
        return (
            states.RESIDUAL,
            f'residual {residual_t:.3g} T is {times:.3g} times the expected one',
        )
    if fault == OUTSIDE:
        return states.OUTSIDE_VOLUME, f'at {millimetres(place)} mm'
    if fault == UNENDED:
        return states.AMBIGUOUS, 'the solve did not converge'
    if fault == UNCERTAIN:
        return states.AMBIGUOUS, f'{what} uncertain by {1e3 * sigma_m:.3g} mm'
    if fault == IN_METAL:
        return states.AMBIGUOUS, 'where there may be metal'
    margin = settings.margin(ratio)
    for other_chi2, words in rivals:
        if other_chi2 < chi2 + margin:
            return states.AMBIGUOUS, f'{words} would explain the fluxes too'
    return states.OK, ''


def millimetres(place: Array) -> str:
    """Return coordinates of a place given in m as text in mm."""
    return ', '.join(f'{1e3 * v:.1f}' for v in place)


class Solution(Protocol):
    """States where the solve of any tracked thing ended."""

    @property
    def chi2(self) -> float:
        """Return the sum of squared whitened residuals."""

    @property
    def residual(self) -> Array:
        """Return measured minus modelled flux, T."""

    @property
    def converged(self) -> bool:
        """Return whether the last step was negligible."""


class Freedom(NamedTuple):
    """Degrees of freedom of a residual, the pose's unknowns, and the probability of a misfit
    beyond which it counts as more than noise.
    """

    of_residual: int
    unknowns: int
    seldom: float


@dataclass
class SolveFrame:
    """Holds what a thing is tracked with in one frame: its fluxes, T, the model, the settings."""

    name: str
    stamp_ns: int
    flux: Array
    context: SolveContext
    settings: TrackerSettings

    def no_pose(self, state: str, reason: str) -> PoseEstimate:
        """Return the estimate of a thing that has no pose in this frame."""
        return no_pose(self.name, self.stamp_ns, state, self.context.model_id, reason)

    def estimate(
        self,
        noise: NoiseScale,
        solution: Solution,
        freedom: Freedom,
        pose: tuple[Array, Array, Array | None],
        covariance: Callable[[float], Array],
        rivals: Iterable[tuple[float, str]],
        place: Array,
        what: str = 'position',
        in_metal: bool = False,
    ) -> PoseEstimate:
        """Judge a solution by itself: its covariance, its state, and the reason for it.

        ``pose`` are position, axis, and rotation or None, as the estimate has them. ``covariance``
        returns the pose's (6, 6) before the scale, which it is given. The last four are those of
        `verdict`.
        """
        settings, chi2 = self.settings, solution.chi2
        scale = variance_scale(noise, chi2, *freedom, self.context, settings)
        scaled = scale * covariance(scale)
        sigma = math.sqrt(scaled[0, 0] + scaled[1, 1] + scaled[2, 2])
        flat = solution.residual.ravel()
        residual = math.sqrt(float(flat @ flat) / flat.size)
        state, reason = verdict(
            settings, chi2, freedom.of_residual, residual, place, solution.converged, sigma,
            scale, what, in_metal, rivals,
        )  # fmt: skip
        return PoseEstimate(
            self.name, self.stamp_ns, state, *pose, scaled, sigma, residual,
            chi2 / freedom.of_residual, self.context.model_id, reason,
        )  # fmt: skip
