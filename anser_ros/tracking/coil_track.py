"""One tool sensor through time: warm or cold solve, gate, state, uncertainty."""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from anser_ros.tracking import estimate as states
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
WHITENING_REACH_M = 3e-3
WHITENING_REACH = 0.05
"""Move (m) and turn (chord of the axes) up to which the model's error at a pose is reused."""


@dataclass
class CoilTrack:
    """Memory of one sensor: its last good pose, its noise scale, the model error near it."""

    good: CoilSolution | None = None
    good_ns: int = 0
    noise: NoiseScale = field(default_factory=NoiseScale)
    whitening: Array | None = None
    whitening_at: tuple[Scene, Array, Array] | None = None

    def forget(self) -> None:
        """Drop the warm start."""
        self.good = None


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
            modes = scene.error_modes(position[None], axis[None], np.array([length]))
            track.whitening = whitening_of(scene.sigma, None if modes is None else modes[:, 0])
            track.whitening_at = (scene, position, axis)
    assert track.whitening is not None
    return track.whitening


def _cold(
    track: CoilTrack, scene: Scene, flux: Array, length: float, limit: float
) -> list[CoilSolution]:
    """All distinct poses in order of chi-square, with the model's error at each in the weights."""
    # Far from the truth only the size of the model's error counts, not its pattern.
    extra = scene.relative_error**2 * float(np.mean((flux / scene.sigma) ** 2))
    scale = 1.0 + extra
    plain = whitening_of(scene.sigma)
    found = solve_cold(
        scene.field, scene.grid, flux, plain, scene.low, scene.high, length, limit * scale
    )
    if scene.modes is None:
        return found
    refined = []
    for solution in found:
        if solution.chi2 <= 100.0 * limit * scale or solution is found[0]:
            weights = _whitening(track, scene, solution.position, solution.axis, length)
            refined.append(
                solve_coil(
                    scene.field,
                    flux,
                    weights,
                    solution.position,
                    solution.axis,
                    scene.low,
                    scene.high,
                    length,
                )  # fmt: skip
            )
    refined.sort(key=lambda solution: solution.chi2)
    return refined


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
    signal = float(np.sqrt(np.mean((flux / scene.sigma) ** 2)))
    if signal < settings.min_signal:
        reason = f'flux is {signal:.2g} times the noise'
        return CoilResult(no_pose(name, stamp_ns, states.NO_SIGNAL, scene.model_id, reason), None)
    freedom = max(flux.size - 5, 1)
    limit = settings.gate**2 * freedom
    recent = (stamp_ns - track.good_ns) * NANO <= settings.warm_age_s
    solution, rivals, cold = None, [], False
    if track.good is not None and recent:
        start = track.good
        weights = _whitening(track, scene, start.position, start.axis, length)
        solution = solve_coil(
            scene.field, flux, weights, start.position, start.axis, scene.low, scene.high, length
        )
        jump = float(np.linalg.norm(solution.position - start.position))
        if solution.chi2 > limit or not solution.converged or jump > SUSPICIOUS_JUMP_M:
            solution = None
    if solution is None:
        cold = True
        solution, *rivals = _cold(track, scene, flux, length, limit)
    result = _judge(track, name, stamp_ns, solution, rivals, limit, freedom, scene, settings)
    if result.state == states.OK:
        track.good, track.good_ns = solution, stamp_ns
        track.noise.add(solution.chi2 / freedom)
    return CoilResult(result, solution, cold)


def _judge(
    track: CoilTrack,
    name: str,
    stamp_ns: int,
    solution: CoilSolution,
    rivals: list[CoilSolution],
    limit: float,
    freedom: int,
    scene: Scene,
    settings: TrackerSettings,
) -> PoseEstimate:
    ratio = solution.chi2 / freedom
    scale = 1.0
    if settings.adaptive:
        scale = track.noise.of_frame(ratio, chi2_limit(freedom, RARE) / freedom)
    covariance = scale * coil_covariance(
        solution.normal, solution.axis, settings.roll_variance / scale
    )
    sigma = math.sqrt(float(np.trace(covariance[:3, :3])))
    residual = float(np.sqrt(np.mean(solution.residual**2)))
    state, reason = states.OK, ''
    if not solution.chi2 <= limit:
        state = states.RESIDUAL
        reason = f'residual {residual:.3g} T is {math.sqrt(ratio):.3g} times the expected one'
    elif not settings.volume.contains(solution.position):
        state, reason = states.OUTSIDE_VOLUME, f'at {_millimetres(solution.position)} mm'
    elif not solution.converged:
        state, reason = states.AMBIGUOUS, 'the solve did not converge'
    elif sigma > settings.max_sigma_m:
        state, reason = states.AMBIGUOUS, f'position uncertain by {1e3 * sigma:.3g} mm'
    else:
        margin = 2.0 * math.log(settings.odds) * max(1.0, ratio)
        for rival in rivals:
            likely = rival.converged and rival.chi2 < solution.chi2 + margin
            if likely and settings.volume.contains(rival.position):
                state = states.AMBIGUOUS
                reason = f'{_millimetres(rival.position)} mm would explain the fluxes too'
    return PoseEstimate(
        name, stamp_ns, state, solution.position, solution.axis, None, covariance, sigma,
        residual, ratio, scene.model_id, reason,
    )  # fmt: skip


def _millimetres(position: Array) -> str:
    return ', '.join(f'{1e3 * v:.1f}' for v in position)
