"""Follows one tool sensor through time: warm or cold solve, gate, state, uncertainty."""

import math
from dataclasses import dataclass, field
from itertools import repeat
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from anser_ros import pose_states as states
from anser_ros.kernel_cache import kernel
from anser_ros.stamps import NANO
from anser_ros.tracking.estimate import NoiseScale, PoseEstimate, TrackerSettings, no_pose
from anser_ros.tracking.seed import solve_cold
from anser_ros.tracking.solve import CoilSolution, solve_coil, whitening_of
from anser_ros.tracking.solve_context import SolveContext
from anser_ros.tracking.solve_verdict import millimetres, variance_scale, verdict
from anser_ros.tracking.uncertainty import coil_covariance

Array = NDArray[np.float64]
Start = tuple[Array, Array]

UNKNOWNS = 5
"""Numbers that a coil's pose has."""
SELDOM = 0.1
"""Probability of a residual beyond which it counts as more than noise and widens the sigma of its
frame. Smaller, and slight distortion is not seen; larger, and plain noise widens many poses."""
SUSPICIOUS_JUMP_M = 0.02
"""A pose that moved further from one frame to the next, m, is confirmed by a scan, for it may be
another solution of the same fluxes. Smaller, and fast tools are scanned for in every frame;
larger, and a wrong solution near by is followed."""
FIRST_RETRY_S, LAST_RETRY_S = 0.05, 0.25
"""Pauses after a scan without a good pose, s: the first one, which doubles from scan to scan, and
the longest. Scans cost far more than warm solves, and a long distortion would ask for one in every
frame; the longest pause bounds how late the end of a distortion is noticed."""
THOROUGH_EVERY = 4
"""Every so many scans of a long distortion one tries all starts."""
CHANGED = 3.0
"""A suspect's chi-square that changes by this factor calls for a scan before its time."""
MOST_STEPS = 2.5
"""Motion is carried on for so many of the last step's durations."""
ERROR_REACH = 0.05
"""Move, as a part of the distance from the nearest uncertain dipole, and turn (chord of the axes)
up to which the model's error at a pose is reused."""


def distance(one: Array, other: Array) -> float:
    """Return the distance of two points, m: of lists in a fifth of the time of arrays."""
    return math.dist(one.tolist(), other.tolist())


class PoseErrors(NamedTuple):
    """Says what the model's uncertainty does to a sensor at a pose.

    Attributes
    ----------
    context : SolveContext
    position, axis : ndarray, shape (3,)
    errors : ndarray, shape (R, 2K)
        Flux errors of one standard deviation each, T.
    whitening : ndarray, shape (1, 2K) or (2K, 2K)
        1/T; see `whitening_of`.
    reach_m : float
        Move up to which this is still good.
    among : float
        Above 1, the sensor is among dipoles that stand for metal and are no description of the
        field so near to them.
    """

    context: SolveContext
    position: Array
    axis: Array
    errors: Array
    whitening: Array
    reach_m: float
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


@kernel
def carried_on(position, old_position, axis, old_axis, steps):  # type: ignore[no-untyped-def]
    """Return position, m, and unit axis after so many more of the last steps."""
    new_position, new_axis, norm = np.empty(3), np.empty(3), 0.0
    for i in range(3):
        new_position[i] = position[i] + steps * (position[i] - old_position[i])
        new_axis[i] = axis[i] + steps * (axis[i] - old_axis[i])
        norm += new_axis[i] * new_axis[i]
    for i in range(3):
        new_axis[i] /= math.sqrt(norm)
    return new_position, new_axis


@dataclass
class CoilTrack:
    """Remembers one sensor: its last good pose, its noise scale, the model error near it.

    While no pose is good, ``suspect`` is the best bad one. It shows whether anything has changed,
    so that the costly scan need not run in every frame of a long distortion; it never becomes a
    pose unless a scan confirms it.
    """

    good: CoilSolution | None = None
    good_ns: int = 0
    before: tuple[int, Array, Array] | None = None
    suspect: CoilSolution | None = None
    failures: int = 0
    retry_ns: int = 0
    noise: NoiseScale = field(default_factory=NoiseScale)
    error: PoseErrors | None = None

    def forget(self) -> None:
        """Drop the last poses, so that the next solve starts cold."""
        self.good = self.suspect = self.before = None
        self.failures = 0

    def expected(self, stamp_ns: int) -> Start | None:
        """Return where the sensor is if it moves on as it did between its last two good poses."""
        if self.good is None:
            return None
        position, axis = self.good.position, self.good.axis
        if self.before is None:
            return position, axis
        before_ns, old_position, old_axis = self.before
        steps = (stamp_ns - self.good_ns) / max(self.good_ns - before_ns, 1)
        if not 0.0 < steps <= MOST_STEPS:
            return position, axis
        start: Start = carried_on(position, old_position, axis, old_axis, steps)
        return start


class _CoilFrame(NamedTuple):
    """One sensor's fluxes (2K,) in one frame, and what they are tracked with."""

    name: str
    length: float
    stamp_ns: int
    flux: Array
    context: SolveContext
    settings: TrackerSettings
    freedom: int

    @property
    def limit(self) -> float:
        """Chi-square up to which a pose is accepted."""
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


def _cold(track: CoilTrack, frame: _CoilFrame) -> list[CoilSolution]:
    """All distinct poses in order of chi-square, with the model's error at each in the weights."""
    context = frame.context
    # Far from the truth only the size of the model's error counts, not its pattern.
    power = float(np.mean((frame.flux / context.sigma) ** 2))
    limit = frame.limit * (1.0 + context.relative_error**2 * power)
    found = solve_cold(
        context.field,
        context.grid,
        frame.flux,
        whitening_of(context.sigma),
        context.low,
        context.high,
        frame.length,
        limit,
        thorough=track.failures % THOROUGH_EVERY == 0,
    )
    if context.modes is None:
        return found
    near = [s for s in found if s.chi2 <= 100.0 * limit or s is found[0]]
    return sorted(
        (_descend(track, frame, s.position, s.axis) for s in near),
        key=lambda solution: solution.chi2,
    )


def track_coil(
    track: CoilTrack,
    name: str,
    length: float,
    stamp_ns: int,
    flux: Array,
    context: SolveContext,
    settings: TrackerSettings,
    warm: CoilSolution | None,
) -> CoilResult:
    """Estimate a sensor's pose from one frame's fluxes, shape (2K,), finite, T.

    ``warm`` is its solution near where it was expected; None where it was expected nowhere.
    """
    loudness = flux / context.sigma
    signal = math.sqrt(float(loudness @ loudness) / loudness.size)
    if signal < settings.min_signal:
        reason = f'flux is {signal:.2g} times the noise'
        return CoilResult(
            no_pose(name, stamp_ns, states.NO_SIGNAL, context.model_id, reason), None
        )
    if context.readings < UNKNOWNS:
        reason = f'{context.readings} readings are too few for the {UNKNOWNS} unknowns of a pose'
        unknown = no_pose(name, stamp_ns, states.AMBIGUOUS, context.model_id, reason)
        return CoilResult(unknown, None, is_received=True)
    freedom = max(flux.size - UNKNOWNS, 1)
    frame = _CoilFrame(name, length, stamp_ns, flux, context, settings, freedom)
    solution = _confirmed(track, frame, warm)
    if solution is not None:
        return _finish(track, frame, solution, [], False)
    if track.suspect is not None and stamp_ns < track.retry_ns:
        solution = _descend(track, frame, track.suspect.position, track.suspect.axis)
        judged = _judge(track, frame, solution, [])
        change = solution.chi2 / max(track.suspect.chi2, 1e-300)
        if judged.state != states.OK and 1.0 / CHANGED < change < CHANGED:
            return CoilResult(judged, solution, False, track.error)
    solution, *rivals = _cold(track, frame)
    return _finish(track, frame, solution, rivals, True)


def _finish(
    track: CoilTrack,
    frame: _CoilFrame,
    solution: CoilSolution,
    rivals: list[CoilSolution],
    cold: bool,
) -> CoilResult:
    """Judge a solution and remember it as good or suspect."""
    judged = _judge(track, frame, solution, rivals)
    if judged.state == states.OK:
        last = track.good
        moved = last is not None and distance(last.position, solution.position)
        track.before = None
        if last is not None and moved < SUSPICIOUS_JUMP_M:
            track.before = (track.good_ns, last.position, last.axis)
        track.good, track.good_ns = solution, frame.stamp_ns
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


def _descend(track: CoilTrack, frame: _CoilFrame, position: Array, axis: Array) -> CoilSolution:
    context = frame.context
    weights = whitening_at(track, context, position, axis, frame.length)
    return solve_coil(
        context.field,
        frame.flux,
        weights,
        position,
        axis,
        context.low,
        context.high,
        frame.length,
    )


def _confirmed(
    track: CoilTrack, frame: _CoilFrame, warm: CoilSolution | None
) -> CoilSolution | None:
    """The solution near the last good pose; None where there is none that needs no scan."""
    start = track.good
    if start is None or warm is None or warm.chi2 > frame.limit or not warm.converged:
        return None
    return warm if distance(warm.position, start.position) <= SUSPICIOUS_JUMP_M else None


def _judge(
    track: CoilTrack, frame: _CoilFrame, solution: CoilSolution, rivals: list[CoilSolution]
) -> PoseEstimate:
    settings, context = frame.settings, frame.context
    ratio = solution.chi2 / frame.freedom
    scale = variance_scale(
        track.noise, solution.chi2, frame.freedom, UNKNOWNS, SELDOM, context, settings
    )
    covariance = scale * coil_covariance(
        solution.normal, solution.axis, settings.roll_variance / scale
    )
    sigma = math.sqrt(covariance[0, 0] + covariance[1, 1] + covariance[2, 2])
    residual = math.sqrt(float(solution.residual @ solution.residual) / solution.residual.size)
    others = (
        (rival.chi2, f'{millimetres(rival.position)} mm')
        for rival in rivals
        if rival.converged and settings.box.contains(rival.position)
    )
    state, reason = verdict(
        settings, solution.chi2, frame.freedom, residual, solution.position, solution.converged,
        sigma, scale, in_metal=track.error is not None and track.error.among_metal,
        rivals=others,
    )  # fmt: skip
    return PoseEstimate(
        frame.name, frame.stamp_ns, state, solution.position, solution.axis, None, covariance,
        sigma, residual, ratio, context.model_id, reason,
    )  # fmt: skip
