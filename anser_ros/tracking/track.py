"""Remembers one coil or body from frame to frame, and states the pose that a solve ended at.

What coils and bodies have in common: where a thing is expected by its last two good poses, and
the way from a solution to an estimate (variances, state, reason).
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from anser_ros.stamps import NANO
from anser_ros.tracking.estimate import NoiseScale, PoseEstimate, TrackerSettings, no_pose
from anser_ros.tracking.solve_context import SolveContext
from anser_ros.tracking.solve_verdict import variance_scale, verdict

Array = NDArray[np.float64]
Start = tuple[Array, Array]
"""A position, and a unit axis or a rotation matrix."""

SUSPICIOUS_JUMP_M = 0.02
"""A pose that moved further from one frame to the next, m, is confirmed by a scan, for it may be
another solution of the same fluxes. Smaller, and fast tools are scanned for in every frame;
larger, and a wrong solution near by is followed."""
MOST_STEPS = 2.5
"""Motion is carried on for so many of the last step's durations."""


class Solution(Protocol):
    """States where the solve of any tracked thing ended."""

    @property
    def position(self) -> Array:
        """Return the position, m, frame fg."""

    @property
    def chi2(self) -> float:
        """Return the sum of squared whitened residuals."""

    @property
    def residual(self) -> Array:
        """Return measured minus modelled flux, T."""

    @property
    def converged(self) -> bool:
        """Return whether the last step was negligible."""


SolutionT = TypeVar('SolutionT', bound=Solution)


def distance(one: Array, other: Array) -> float:
    """Return the distance of two points, m: of lists in a fifth of the time of arrays."""
    return math.dist(one.tolist(), other.tolist())


@dataclass
class Track(Generic[SolutionT]):
    """Remembers the last two good solutions of one thing, and its noise scale."""

    good: SolutionT | None = None
    good_ns: int = 0
    before: tuple[int, SolutionT] | None = None
    noise: NoiseScale = field(default_factory=NoiseScale)

    def forget(self) -> None:
        """Drop the last poses, so that the next solve starts cold."""
        self.good = self.before = None

    def fresh(self, stamp_ns: int, settings: TrackerSettings) -> SolutionT | None:
        """Return the last good solution; None where there is none, or it is too old."""
        return self.good if (stamp_ns - self.good_ns) * NANO <= settings.warm_age_s else None

    def steps(self, stamp_ns: int) -> float:
        """Return how many of the last good step's durations have passed since; 0 for too many."""
        if self.before is None:
            return 0.0
        steps = (stamp_ns - self.good_ns) / max(self.good_ns - self.before[0], 1)
        return steps if 0.0 < steps <= MOST_STEPS else 0.0

    def remember(self, solution: SolutionT, stamp_ns: int) -> None:
        """Take in a good solution."""
        last, self.before = self.good, None
        if last is not None and distance(last.position, solution.position) < SUSPICIOUS_JUMP_M:
            self.before = (self.good_ns, last)
        self.good, self.good_ns = solution, stamp_ns


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
