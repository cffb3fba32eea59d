"""Follows tool sensors through time: warm or cold solve, gate, state, uncertainty. What coils
and bodies share comes first: where a thing is expected by its last two good poses (`Track`),
and the way from a solution to an estimate (`SolveFrame`). The steps of a frame: all coils are
solved near where they are expected, in one call of compiled code (`solve_warm`); each is
confirmed, looked at again, or scanned for (`track_coil`); its solution is judged by itself and
remembered as good or suspect.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from itertools import repeat
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from anser_ros import pose_states as states
from anser_ros.stamps import NANO
from anser_ros.tracking.estimate import NoiseScale, PoseEstimate, TrackerSettings, no_pose
from anser_ros.tracking.seed import solve_cold
from anser_ros.tracking.solve import (
    CoilSolution,
    coil_covariance,
    solve_coil,
    solve_coils,
    whitening_of,
)
from anser_ros.tracking.solve_context import SolveContext
from anser_ros.tracking.solve_verdict import millimetres, variance_scale, verdict

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


UNKNOWNS = 5
"""Numbers that a coil's pose has."""
SELDOM = 0.1
"""Probability of a residual beyond which it counts as more than noise and widens the sigma of its
frame. Smaller, and slight distortion is not seen; larger, and plain noise widens many poses."""
FIRST_RETRY_S, LAST_RETRY_S = 0.05, 0.25
"""Pauses after a scan without a good pose, s: the first one, which doubles from scan to scan, and
the longest. Scans cost far more than warm solves, and a long distortion would ask for one in every
frame; the longest pause bounds how late the end of a distortion is noticed."""
THOROUGH_EVERY = 4
"""Every so many scans of a long distortion one tries all starts."""
CHANGED = 3.0
"""A suspect's chi-square that changes by this factor calls for a scan before its time."""
ERROR_REACH = 0.05
"""Move, as a part of the distance from the nearest uncertain dipole, and turn (chord of the axes)
up to which the model's error at a pose is reused."""


class PoseErrors(NamedTuple):
    """Says what the model's uncertainty does to a sensor at a pose."""

    context: SolveContext
    # position, axis: (3,)
    position: Array
    axis: Array
    errors: Array  # (R, 2K), flux errors of one standard deviation each, T
    whitening: Array  # (1, 2K), 1/T; see `whitening_of`
    reach_m: float  # Move up to which this is still good
    # Above 1, the sensor is among dipoles that stand for metal and are no description of the field
    # so near to them
    among: float

    @property
    def among_metal(self) -> bool:
        """Return whether the sensor is where dipoles that stand for metal describe it no more."""
        return self.among > 1.0

    def holds(self, context: SolveContext, position: Array, axis: Array) -> bool:
        """Return whether this is still good for a context and a pose."""
        own = self.context
        if own.modes is not context.modes:
            return False
        if own.sigma is not context.sigma and not np.array_equal(own.sigma, context.sigma):
            return False
        return context.modes is None or (
            distance(position, self.position) < self.reach_m
            and distance(axis, self.axis) < ERROR_REACH
        )


@dataclass
class CoilTrack(Track[CoilSolution]):
    """Remembers one sensor: its last good poses, its noise scale, the model error near it.

    While no pose is good, ``suspect`` is the best bad one. It shows whether anything has changed,
    so that the costly scan need not run in every frame of a long distortion; it never becomes a
    pose unless a scan confirms it.
    """

    suspect: CoilSolution | None = None
    failures: int = 0
    retry_ns: int = 0
    error: PoseErrors | None = None

    def forget(self) -> None:
        """Drop the last poses, so that the next solve starts cold."""
        super().forget()
        self.suspect, self.failures = None, 0


@dataclass
class CoilFrame(SolveFrame):
    """Holds one sensor's fluxes (2K,), finite, and its length, m."""

    length: float

    @property
    def freedom(self) -> int:
        """Return the degrees of freedom of the residual."""
        return max(self.flux.size - UNKNOWNS, 1)

    @property
    def limit(self) -> float:
        """Return the chi-square up to which a pose is accepted."""
        return self.settings.gate**2 * self.freedom


class CoilResult(NamedTuple):
    """Holds an estimate with its solution and the errors reckoned with (None: not solved).

    ``is_received`` is whether the fluxes of a coil are good although nothing was solved for it.
    """

    estimate: PoseEstimate
    solution: CoilSolution | None
    cold: bool = False
    error: PoseErrors | None = None
    is_received: bool = False

    @property
    def usable(self) -> bool:
        """Return whether a body may use the coil: it has a solution, and is not among metal."""
        return (self.is_received or self.solution is not None) and not (
            self.error and self.error.among_metal
        )


def take_errors(
    context: SolveContext, points: Array, axes: Array, lengths: Array
) -> list[PoseErrors]:
    """Work out the model's error for sensors (S of them) at some poses, all of them at once."""
    errors, whitening, away, among = context.error_whitening(points, axes, lengths)
    reach = (ERROR_REACH * away).tolist()
    rows = points, axes, errors, whitening, reach, among.tolist()
    return list(map(PoseErrors, repeat(context), *rows))


def whitening_at(
    track: CoilTrack, context: SolveContext, position: Array, axis: Array, length: float
) -> Array:
    """Whitening with the model's error at a pose, reused while the sensor stays near."""
    if track.error is None or not track.error.holds(context, position, axis):
        if context.modes is None:
            empty = np.empty((0, context.sigma.size))
            weights = whitening_of(context.sigma)
            track.error = PoseErrors(context, position, axis, empty, weights, math.inf, 0.0)
        else:
            (track.error,) = take_errors(context, position[None], axis[None], np.array([length]))
    return track.error.whitening


def track_coil(track: CoilTrack, frame: CoilFrame, warm: CoilSolution | None) -> CoilResult:
    """Estimate a sensor's pose from one frame's fluxes.

    ``warm`` is its solution near where it was expected; None where it was expected nowhere.
    """
    context, settings = frame.context, frame.settings
    loudness = frame.flux / context.sigma
    signal = math.sqrt(float(loudness @ loudness) / loudness.size)
    if signal < settings.min_signal:
        reason = f'flux is {signal:.2g} times the noise'
        return CoilResult(frame.no_pose(states.NO_SIGNAL, reason), None)
    if context.readings < UNKNOWNS:
        reason = f'{context.readings} readings are too few for the {UNKNOWNS} unknowns of a pose'
        return CoilResult(frame.no_pose(states.AMBIGUOUS, reason), None, is_received=True)
    if warm is not None and _is_confirmed(track, frame, warm):
        return _finish(track, frame, warm, [], False)
    if track.suspect is not None and frame.stamp_ns < track.retry_ns:
        solution = _descend(track, frame, track.suspect.position, track.suspect.axis)
        judged = _judge(track, frame, solution, [])
        change = solution.chi2 / max(track.suspect.chi2, 1e-300)
        if judged.state != states.OK and 1.0 / CHANGED < change < CHANGED:
            return CoilResult(judged, solution, False, track.error)
    solution, *rivals = _cold(track, frame)
    return _finish(track, frame, solution, rivals, True)


def _is_confirmed(track: CoilTrack, frame: CoilFrame, warm: CoilSolution) -> bool:
    """Whether the solution near the last good pose needs no scan."""
    if track.good is None or warm.chi2 > frame.limit or not warm.converged:
        return False
    return distance(warm.position, track.good.position) <= SUSPICIOUS_JUMP_M


def _cold(track: CoilTrack, frame: CoilFrame) -> list[CoilSolution]:
    """All distinct poses in order of chi-square, with the model's error at each in the weights."""
    context = frame.context
    # Far from the truth only the size of the model's error counts, not its pattern.
    power = float(np.mean((frame.flux / context.sigma) ** 2))
    limit = frame.limit * (1.0 + context.relative_error**2 * power)
    found = solve_cold(
        context.field, context.grid, frame.flux, whitening_of(context.sigma), context.low,
        context.high, frame.length, limit, thorough=track.failures % THOROUGH_EVERY == 0,
    )  # fmt: skip
    if context.modes is None:
        return found
    near = [s for s in found if s.chi2 <= 100.0 * limit or s is found[0]]
    return sorted(
        (_descend(track, frame, s.position, s.axis) for s in near),
        key=lambda solution: solution.chi2,
    )


def _descend(track: CoilTrack, frame: CoilFrame, position: Array, axis: Array) -> CoilSolution:
    context, length = frame.context, frame.length
    weights = whitening_at(track, context, position, axis, length)
    return solve_coil(
        context.field, frame.flux, weights, position, axis, context.low, context.high, length
    )


def _finish(
    track: CoilTrack,
    frame: CoilFrame,
    solution: CoilSolution,
    rivals: list[CoilSolution],
    cold: bool,
) -> CoilResult:
    """Judge a solution and remember it as good or suspect."""
    judged = _judge(track, frame, solution, rivals)
    if judged.state == states.OK:
        track.remember(solution, frame.stamp_ns)
        track.suspect, track.failures = None, 0
        place = solution.position, solution.axis
        weights = whitening_at(track, frame.context, *place, frame.length)
        residual = solution.residual
        whitened = weights[0] * residual if len(weights) == 1 else weights @ residual
        track.noise.add(judged.chi2, whitened, frame.freedom)
    elif cold:
        wait_s = min(FIRST_RETRY_S * 2.0**track.failures, LAST_RETRY_S)
        track.suspect, track.failures = solution, track.failures + 1
        track.retry_ns = frame.stamp_ns + round(wait_s / NANO)
    return CoilResult(judged, solution, cold, track.error)


def _judge(
    track: CoilTrack, frame: CoilFrame, solution: CoilSolution, rivals: list[CoilSolution]
) -> PoseEstimate:
    position, axis, settings = solution.position, solution.axis, frame.settings
    others = (
        (rival.chi2, f'{millimetres(rival.position)} mm')
        for rival in rivals
        if rival.converged and settings.box.contains(rival.position)
    )
    return frame.estimate(
        track.noise, solution, Freedom(frame.freedom, UNKNOWNS, SELDOM), (position, axis, None),
        lambda scale: coil_covariance(solution.normal, axis, settings.roll_variance / scale),
        others, position, in_metal=track.error is not None and track.error.among_metal,
    )  # fmt: skip


def _expected(tracks: list[CoilTrack], stamp_ns: int) -> tuple[Array, Array]:
    """Positions and axes (S, 3) of sensors that move on as between their last two good poses.

    For all coils together this takes a third of the time.
    """
    good = [track.good for track in tracks if track.good is not None]
    old = [g if t.before is None else t.before[1] for t, g in zip(tracks, good, strict=True)]
    steps = np.array([track.steps(stamp_ns) for track in tracks])[:, None]
    place, last_place = (np.concatenate([s.position for s in some]) for some in (good, old))
    axis, last_axis = (np.concatenate([s.axis for s in some]) for some in (good, old))
    positions = place.reshape(-1, 3) + steps * (place - last_place).reshape(-1, 3)
    axes = axis.reshape(-1, 3) + steps * (axis - last_axis).reshape(-1, 3)
    axes /= np.where(steps > 0.0, np.sqrt((axes * axes).sum(axis=1, keepdims=True)), 1.0)
    return positions, axes


def solve_warm(
    tracks: list[CoilTrack],
    lengths: Array,
    stamp_ns: int,
    values: Array,
    sound: NDArray[np.bool_],
    context: SolveContext,
    settings: TrackerSettings,
) -> list[CoilSolution | None]:
    """Return each sensor's solution near where it is expected; None where it is nowhere.

    ``lengths`` (S,) are the coils', m; ``values`` (S, 2K) flux components, T; ``sound`` (S,) tells
    which of them can be used.
    """
    solutions: list[CoilSolution | None] = [None] * len(tracks)
    rows = [i for i in np.flatnonzero(sound).tolist() if tracks[i].fresh(stamp_ns, settings)]
    if not rows or context.readings < UNKNOWNS:
        return solutions
    followed = [tracks[i] for i in rows]
    positions, axes = _expected(followed, stamp_ns)
    spans = lengths[rows]
    if context.modes is not None:
        far = [
            k for k, track in enumerate(followed)
            if not (track.error and track.error.holds(context, positions[k], axes[k]))
        ]  # fmt: skip
        if far:
            fresh = take_errors(context, positions[far], axes[far], spans[far])
            for k, error in zip(far, fresh, strict=True):
                followed[k].error = error
    each = zip(followed, positions, axes, spans.tolist(), strict=True)
    weights = np.array([whitening_at(track, context, *start) for track, *start in each])
    found = solve_coils(
        context.field, values[rows], weights, positions, axes, context.low, context.high, spans
    )
    for i, solution in zip(rows, found, strict=True):
        solutions[i] = solution
    return solutions
