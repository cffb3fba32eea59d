"""One tool sensor through time: warm or cold solve, gate, state, uncertainty."""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import TrackingError
from anser_ros.tracking import estimate as states
from anser_ros.tracking.error_whitening import error_whitening
from anser_ros.tracking.estimate import NoiseScale, PoseEstimate, TrackerSettings, no_pose
from anser_ros.tracking.scene import Scene
from anser_ros.tracking.seed import solve_cold
from anser_ros.tracking.solve import CoilSolution, solve_coil, whitening_of
from anser_ros.tracking.uncertainty import chi2_limit, coil_covariance

Array = NDArray[np.float64]

NANO = 1e-9
RARE = 0.01
"""Probability of a residual that counts as more than this frame's share of noise."""
SUSPICIOUS_JUMP_M = 0.02
FIRST_RETRY_S = 0.05
LAST_RETRY_S = 0.25
THOROUGH_EVERY = 4
"""A long distortion gets a scan after growing pauses; every so many of them tries all starts."""
CHANGED = 3.0
"""A suspect's chi-square that changes by this factor calls for a scan before its time."""
MOST_STEPS = 2.5
"""Motion is carried on for so many of the last step's durations."""
WHITENING_REACH_M = 3e-3
WHITENING_REACH = 0.05
"""Move (m) and turn (chord of the axes) up to which the model's error at a pose is reused."""


@dataclass
class CoilTrack:
    """Memory of one sensor: its last good pose, its noise scale, the model error near it.

    While no pose is good, ``suspect`` is the best bad one. It tells whether anything has changed,
    so that the costly scan need not run in every frame of a long distortion; it never becomes a
    pose without a scan that confirms it.
    """

    good: CoilSolution | None = None
    good_ns: int = 0
    before: tuple[int, Array, Array] | None = None
    suspect: CoilSolution | None = None
    failures: int = 0
    retry_ns: int = 0
    noise: NoiseScale = field(default_factory=NoiseScale)
    whitening: Array | None = None
    whitening_at: tuple[Scene, Array, Array] | None = None

    def forget(self) -> None:
        """Drop the warm start."""
        self.good = self.suspect = self.before = None
        self.failures = 0

    def expected(self, stamp_ns: int) -> tuple[Array, Array] | None:
        """Where the sensor is if it moves on as it did between its last two good poses."""
        if self.good is None:
            return None
        position, axis = self.good.position, self.good.axis
        if self.before is None:
            return position, axis
        before_ns, old_position, old_axis = self.before
        steps = (stamp_ns - self.good_ns) / max(self.good_ns - before_ns, 1)
        if not 0.0 < steps <= MOST_STEPS:
            return position, axis
        turned = axis + steps * (axis - old_axis)
        turned /= math.sqrt(float(turned @ turned))
        return position + steps * (position - old_position), turned


@dataclass(frozen=True)
class _Frame:
    """One sensor's fluxes (2K,) in one frame, and what they are tracked with."""

    name: str
    length: float
    stamp_ns: int
    flux: Array
    scene: Scene
    settings: TrackerSettings

    @property
    def freedom(self) -> int:
        return max(self.flux.size - 5, 1)

    @property
    def limit(self) -> float:
        """Chi-square up to which a pose is accepted."""
        return self.settings.gate**2 * self.freedom


@dataclass(frozen=True)
class CoilResult:
    """An estimate with the solution behind it (None where nothing was solved)."""

    estimate: PoseEstimate
    solution: CoilSolution | None
    cold: bool = False


def _whitening(
    track: CoilTrack, scene: Scene, position: Array, axis: Array, length: float
) -> Array:
    """Whitening with the model's error at a pose, reused while the sensor stays near."""
    if scene.modes is None:
        if track.whitening_at is None or track.whitening_at[0].sigma is not scene.sigma:
            track.whitening = whitening_of(scene.sigma)
            track.whitening_at = (scene, position, axis)
    else:
        at = track.whitening_at
        fresh = (
            at is not None
            and at[0].modes is scene.modes
            and float(np.abs(position - at[1]).max()) < WHITENING_REACH_M
            and float(np.abs(axis - at[2]).max()) < WHITENING_REACH
        )
        if not fresh:
            field = scene.field
            weights = error_whitening(
                position, axis, length, field.positions, field.directions, scene.modes,
                scene.sigma,
            )  # fmt: skip
            if weights is None:
                raise TrackingError('the model covariance must be finite')
            track.whitening, track.whitening_at = weights, (scene, position, axis)
    assert track.whitening is not None
    return track.whitening


def _cold(track: CoilTrack, frame: _Frame) -> list[CoilSolution]:
    """All distinct poses in order of chi-square, with the model's error at each in the weights."""
    scene = frame.scene
    # Far from the truth only the size of the model's error counts, not its pattern.
    power = float(np.mean((frame.flux / scene.sigma) ** 2))
    limit = frame.limit * (1.0 + scene.relative_error**2 * power)
    found = solve_cold(
        scene.field,
        scene.grid,
        frame.flux,
        whitening_of(scene.sigma),
        scene.low,
        scene.high,
        frame.length,
        limit,
        thorough=track.failures % THOROUGH_EVERY == 0,
    )
    if scene.modes is None:
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
    scene: Scene,
    settings: TrackerSettings,
) -> CoilResult:
    """Estimate a sensor's pose from one frame's fluxes, shape (2K,), finite, T."""
    loudness = flux / scene.sigma
    signal = math.sqrt(float(loudness @ loudness) / loudness.size)
    if signal < settings.min_signal:
        reason = f'flux is {signal:.2g} times the noise'
        return CoilResult(no_pose(name, stamp_ns, states.NO_SIGNAL, scene.model_id, reason), None)
    frame = _Frame(name, length, stamp_ns, flux, scene, settings)
    solution = _from_good(track, frame)
    if solution is not None:
        return _finish(track, frame, solution, [], False)
    if track.suspect is not None and stamp_ns < track.retry_ns:
        solution = _descend(track, frame, track.suspect.position, track.suspect.axis)
        verdict = _judge(track, frame, solution, [])
        change = solution.chi2 / max(track.suspect.chi2, 1e-300)
        if verdict.state != states.OK and 1.0 / CHANGED < change < CHANGED:
            return CoilResult(verdict, solution)
    solution, *rivals = _cold(track, frame)
    return _finish(track, frame, solution, rivals, True)


def _finish(
    track: CoilTrack,
    frame: _Frame,
    solution: CoilSolution,
    rivals: list[CoilSolution],
    cold: bool,
) -> CoilResult:
    """Judge a solution and remember it as good or suspect."""
    verdict = _judge(track, frame, solution, rivals)
    if verdict.state == states.OK:
        last = track.good
        moved = last is not None and math.dist(last.position, solution.position)
        track.before = None
        if last is not None and moved < SUSPICIOUS_JUMP_M:
            track.before = (track.good_ns, last.position, last.axis)
        track.good, track.good_ns = solution, frame.stamp_ns
        track.suspect, track.failures = None, 0
        track.noise.add(verdict.chi2)
    elif cold:
        wait_s = min(FIRST_RETRY_S * 2.0**track.failures, LAST_RETRY_S)
        track.suspect, track.failures = solution, track.failures + 1
        track.retry_ns = frame.stamp_ns + round(wait_s / NANO)
    return CoilResult(verdict, solution, cold)


def _descend(track: CoilTrack, frame: _Frame, position: Array, axis: Array) -> CoilSolution:
    scene = frame.scene
    weights = _whitening(track, scene, position, axis, frame.length)
    return solve_coil(
        scene.field,
        frame.flux,
        weights,
        position,
        axis,
        scene.low,
        scene.high,
        frame.length,
    )


def _from_good(track: CoilTrack, frame: _Frame) -> CoilSolution | None:
    """Solution near the last good pose; None when there is none that a scan need not confirm."""
    start, expected = track.good, track.expected(frame.stamp_ns)
    old = (frame.stamp_ns - track.good_ns) * NANO > frame.settings.warm_age_s
    if start is None or expected is None or old:
        return None
    solution = _descend(track, frame, *expected)
    jump = math.dist(solution.position, start.position)
    if solution.chi2 > frame.limit or not solution.converged or jump > SUSPICIOUS_JUMP_M:
        return None
    return solution


def _judge(
    track: CoilTrack, frame: _Frame, solution: CoilSolution, rivals: list[CoilSolution]
) -> PoseEstimate:
    freedom, settings = frame.freedom, frame.settings
    ratio = solution.chi2 / freedom
    scale = 1.0
    if settings.adaptive:
        scale = track.noise.of_frame(ratio, chi2_limit(freedom, RARE) / freedom)
    covariance = scale * coil_covariance(
        solution.normal, solution.axis, settings.roll_variance / scale
    )
    sigma = math.sqrt(covariance[0, 0] + covariance[1, 1] + covariance[2, 2])
    residual = math.sqrt(float(solution.residual @ solution.residual) / solution.residual.size)
    state, reason = states.OK, ''
    if not solution.chi2 <= frame.limit:
        state = states.RESIDUAL
        reason = f'residual {residual:.3g} T is {math.sqrt(ratio):.3g} times the expected one'
    elif not settings.volume.contains(solution.position):
        state, reason = states.OUTSIDE_VOLUME, f'at {_millimetres(solution.position)} mm'
    elif not solution.converged:
        state, reason = states.AMBIGUOUS, 'the solve did not converge'
    elif sigma > settings.max_sigma_m * settings.leniency(scale):
        state, reason = states.AMBIGUOUS, f'position uncertain by {1e3 * sigma:.3g} mm'
    else:
        margin = settings.margin(ratio)
        for rival in rivals:
            likely = rival.converged and rival.chi2 < solution.chi2 + margin
            if likely and settings.volume.contains(rival.position):
                state = states.AMBIGUOUS
                reason = f'{_millimetres(rival.position)} mm would explain the fluxes too'
    return PoseEstimate(
        frame.name, frame.stamp_ns, state, solution.position, solution.axis, None, covariance,
        sigma, residual, ratio, frame.scene.model_id, reason,
    )  # fmt: skip


def _millimetres(position: Array) -> str:
    return ', '.join(f'{1e3 * v:.1f}' for v in position)
