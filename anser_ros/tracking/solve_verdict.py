"""Gives the verdict on one pose solve, the same for a coil, a body and a source.

A solve is judged by itself here: whether its residual passes the gate, whether the pose is in the
volume, whether the descent converged, whether the pose is certain enough, and whether another pose
explains the fluxes equally well. Coils and frames are compared with each other afterwards, in
`anser_ros.tracking.judgement`.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

from anser_ros import pose_states as states
from anser_ros.arrays import Array
from anser_ros.kernel_cache import inlined
from anser_ros.tracking.estimate import (
    USUAL_GATE,
    PoseEstimate,
    TrackerSettings,
    no_pose,
    scale_of_frame,
    sigma_factor,
)
from anser_ros.tracking.rigid import BodySolution
from anser_ros.tracking.solve import CoilSolution, chi2_limit
from anser_ros.tracking.solve_context import SolveContext

RARE = 0.01
"""Probability of the residual of many sensors together beyond which it counts as more than noise.
It is smaller than that of a single coil, for many degrees of freedom make much of a small
excess."""


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


def usual_and_most(settings: TrackerSettings, freedom: 'Freedom') -> tuple[float, float]:
    """Return residual powers per freedom: that which noise exceeds seldom, and that beyond which a
    misfit is systematic; any may be where no reading is left to show one.
    """
    usual = chi2_limit(freedom.of_residual, freedom.seldom) / freedom.of_residual
    most = USUAL_GATE**2 if settings.has_gate else usual
    return usual, most if freedom.checks > 0 else -1.0


def millimetres(place: Array) -> str:
    """Return coordinates of a place given in m as text in mm."""
    return ', '.join(f'{1e3 * v:.1f}' for v in place)


class Freedom(NamedTuple):
    """Degrees of freedom of a residual, the pose's unknowns, the probability of a misfit beyond
    which it counts as more than noise, and the checks: what the field makes of readings beyond
    the unknowns, which alone can contradict the pose.
    """

    of_residual: int
    unknowns: int
    seldom: float
    checks: int


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
        noise: Array,
        solution: CoilSolution | BodySolution,
        freedom: Freedom,
        pose: tuple[Array, Array, Array | None],
        covariance: Callable[[float], Array],
        rivals: Iterable[tuple[float, str]],
        place: Array,
        what: str = 'position',
        in_metal: bool = False,
        continues: bool = False,
    ) -> PoseEstimate:
        """Judge a solution by itself: its covariance, its state, and the reason for it.

        ``noise`` (4,) is the state of its scale. ``pose`` are position, axis, and rotation or
        None, as the estimate has them. ``covariance`` returns the pose's (6, 6) before the scale,
        which it is given; ``what`` is uncertain where that is too large. ``place`` (3,) has to be
        in the volume: the coil, or the middle of the body's coils, m, frame fg. ``rivals`` are
        other poses, the likeliest first: the chi-square of each, and its name in the reason; they
        are looked at only where the pose is good by itself. ``in_metal``: whether the pose lies
        among the dipoles that stand for metal, where the model's field is none; ``continues``:
        whether it goes on from a good one, which is the only check of a pose without readings to
        spare.
        """
        settings, ratio = self.settings, solution.chi2 / freedom.of_residual
        scale, limits = 1.0, usual_and_most(settings, freedom)
        if settings.adaptive:
            share, follows = self.context.model_share, self.context.modes is not None
            of_unknown = freedom.of_residual / freedom.unknowns
            scale = scale_of_frame.py_func(
                noise.tolist(), ratio, limits, of_unknown, share, follows
            )
        scaled = scale * covariance(scale)
        sigma_m = math.sqrt(scaled[0, 0] + scaled[1, 1] + scaled[2, 2])
        flat = solution.residual.ravel()
        residual_t = math.sqrt(float(flat @ flat) / flat.size)
        fault = fault_of.py_func(
            ratio, settings.gate, settings.box.contains(place), solution.converged, sigma_m,
            settings.max_sigma_m * sigma_factor.py_func(settings.has_gate, scale),
            in_metal and settings.has_gate,
        )  # fmt: skip
        state, reason = states.AMBIGUOUS, ''
        if fault == MISFIT:
            times = math.sqrt(ratio)
            state = states.RESIDUAL
            reason = f'residual {residual_t:.3g} T is {times:.3g} times the expected one'
        elif fault == OUTSIDE:
            state, reason = states.OUTSIDE_VOLUME, f'at {millimetres(place)} mm'
        elif fault == UNENDED:
            reason = 'the solve did not converge'
        elif fault == UNCERTAIN:
            reason = f'{what} uncertain by {1e3 * sigma_m:.3g} mm'
        elif fault == IN_METAL:
            reason = 'where there may be metal'
        else:
            most = solution.chi2 + settings.margin(ratio)
            is_open = freedom.checks <= 0 and not continues and settings.has_gate
            unknown = 'another pose, which no reading is left to exclude,' if is_open else ''
            words = next((name for chi2, name in rivals if chi2 < most), unknown)
            reason = f'{words} would explain the fluxes too' if words else ''
            state = states.AMBIGUOUS if words else states.OK
        return PoseEstimate(
            self.name, self.stamp_ns, state, *pose, scaled, residual_t, ratio,
            self.context.model_id, reason, freedom.checks,
        )  # fmt: skip
