"""Follows a rigid tool through time by all of its usable coils, without those that disagree."""

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from anser_ros import pose_states as states
from anser_ros.stamps import NANO
from anser_ros.tracking.body_descent import step_to_coils
from anser_ros.tracking.coil_track import (
    MOST_STEPS,
    SUSPICIOUS_JUMP_M,
    CoilResult,
    distance,
    take_errors,
)
from anser_ros.tracking.estimate import NoiseScale, PoseEstimate, TrackerSettings, no_pose
from anser_ros.tracking.rigid import (
    BodyCoils,
    BodySolution,
    common_factor,
    solve_body,
    start_from_coils,
    start_from_grid,
)
from anser_ros.tracking.rotations import rotation_between, rotation_of_vector
from anser_ros.tracking.seed import SAME_PLACE_M
from anser_ros.tracking.solve_context import SolveContext
from anser_ros.tracking.solve_verdict import RARE, variance_scale, verdict
from anser_ros.tracking.uncertainty import bounded_inverse

Array = NDArray[np.float64]
Start = tuple[Array, Array]

DISAGREES = 4.0
"""A coil is left out when its share of the misfit is so many times the mean of the others'."""

UNKNOWNS = 6
"""Numbers that a body's pose has."""

SAME_TURN = 0.1
"""Two poses whose rotation matrices differ by no more (Frobenius norm: 0.1 is 4 deg) are one, as
for a coil (`seed.SAME_PLACE_M`). In 1980 pairs of descents of a nine-coil tool that ended at one
pose they differed by less than 1e-6. Smaller, and a pose that two descents reached makes itself
ambiguous; larger, and a second pose near by is not seen."""

LEFT_OUT_S = 1.0
"""How long a coil that disagreed stays out before it is tried again."""


@dataclass
class BodyTrack:
    """Remembers one body: its last good pose, its noise scale, the coils that disagreed."""

    good: BodySolution | None = None
    good_ns: int = 0
    before: tuple[int, BodySolution] | None = None
    left_out: frozenset[int] = frozenset()
    again_ns: int = 0
    noise: NoiseScale = field(default_factory=NoiseScale)

    def forget(self) -> None:
        """Drop the last poses, so that the next solve starts cold."""
        self.good = self.before = None
        self.left_out = frozenset()

    def expected(self, stamp_ns: int) -> Start | None:
        """Return where the body is if it moves on as it did between its last two good poses."""
        if self.good is None:
            return None
        position, rotation = self.good.position, self.good.rotation
        if self.before is None:
            return position, rotation
        before_ns, old = self.before
        steps = (stamp_ns - self.good_ns) / max(self.good_ns - before_ns, 1)
        if not 0.0 < steps <= MOST_STEPS:
            return position, rotation
        turn = rotation_between(old.rotation, rotation)
        return (
            position + steps * (position - old.position),
            rotation_of_vector(steps * turn) @ rotation,
        )


@dataclass(frozen=True)
class BodyFit:
    """Holds a body's solution, the coils (indices) that took part, and the degrees of freedom."""

    solution: BodySolution
    used: NDArray[np.int64]
    freedom: int

    @property
    def ratio(self) -> float:
        """Return chi-square divided by the degrees of freedom."""
        return self.solution.chi2 / self.freedom

    def good(self, gate: float) -> bool:
        """Return whether the descent has ended, and below the gate."""
        return self.solution.converged and self.ratio <= gate**2


@dataclass(frozen=True)
class BodyResult:
    """Holds an estimate with the fit behind it; None where nothing was solved."""

    estimate: PoseEstimate
    fit: BodyFit | None = None


@dataclass(frozen=True)
class _BodyFrame:
    """A body's fluxes (S, 2K) in one frame, and what its coils found by themselves."""

    coils: BodyCoils
    flux: Array
    single: list[CoilResult]
    context: SolveContext

    @cached_property
    def inverse_sigma(self) -> Array:
        """Return the inverse of each sigma, 1/T, shape (2K,)."""
        return 1.0 / self.context.sigma

    def common(self, used: NDArray[np.int64], start: Start) -> Array:
        """Errors that some coils share, see `common_factor`.

        They are those that the coils' own solves reckoned with, where these were near.
        """
        weights = np.tile(self.inverse_sigma, (len(used), 1))
        gains = self.coils.subset(used).gain_errors(self.flux[used])
        if self.context.modes is None:
            return common_factor(gains, weights)
        coils, (position, rotation) = self.coils.subset(used), start
        points, axes = coils.offsets @ rotation.T + position, coils.axes @ rotation.T
        known = [self.single[i].error for i in used.tolist()]
        far = [
            i for i, error in enumerate(known)
            if error is None or not error.holds(self.context, points[i], axes[i])
        ]  # fmt: skip
        if far:
            fresh = take_errors(self.context, points[far], axes[far], coils.lengths[far])
            for i, error in zip(far, fresh, strict=True):
                known[i] = error
        shared = np.array([e.errors for e in known if e is not None])
        return common_factor(np.concatenate([shared, gains], axis=1), weights)

    def nearer(self, start: Start, used: NDArray[np.int64]) -> Start:
        """Return a start moved to where the coils' own good poses agree best."""
        rows = [i for i in used.tolist() if self.single[i].estimate.state == states.OK]
        coils = self.coils.subset(np.array(rows, dtype=np.int64))
        if not coils.observable:
            return start
        known = [s for s in (self.single[i].solution for i in rows) if s is not None]
        position, rotation = start[0].copy(), start[1].copy()
        step_to_coils(
            position, rotation, coils.offsets, coils.axes, np.array([s.position for s in known]),
            np.array([s.axis for s in known]), np.array([s.normal for s in known]),
            self.context.low - coils.reach, self.context.high + coils.reach,
        )  # fmt: skip
        return position, rotation


def _solve(frame: _BodyFrame, used: NDArray[np.int64], start: Start) -> BodyFit:
    part, context = frame.coils.subset(used), frame.context
    weights = np.tile(frame.inverse_sigma, (len(used), 1))
    solution = solve_body(
        context.field, part, np.ascontiguousarray(frame.flux[used]), weights,
        frame.common(used, start), *start, context.low - part.reach, context.high + part.reach,
    )  # fmt: skip
    return BodyFit(solution, used, max(weights.size - UNKNOWNS, 1))


def _without_disagreeing(fit: BodyFit, frame: _BodyFrame, gate: float) -> BodyFit:
    """Leave out, one by one, up to a third of the coils while one of them spoils the fit."""
    for _ in range(len(fit.used) // 3):
        if fit.ratio <= gate**2:
            break
        misfit = fit.solution.coil_chi2
        worst = int(np.argmax(misfit))
        others = np.delete(misfit, worst)
        rest = np.delete(fit.used, worst)
        if len(rest) < 2 or not frame.coils.subset(rest).observable:
            break
        if misfit[worst] < DISAGREES * others.mean():
            break
        fit = _solve(frame, rest, (fit.solution.position, fit.solution.rotation))
    return fit


def _cold_starts(frame: _BodyFrame, used: NDArray[np.int64]) -> list[Start]:
    context, coils, single = frame.context, frame.coils, frame.single
    for wanted in (states.OK, states.RESIDUAL):
        rows = [i for i in used if single[i].estimate.state == wanted]
        solutions = [single[i].solution for i in rows]
        known = [s for s in solutions if s is not None]
        if known:
            start = start_from_coils(
                coils.subset(np.array(rows)),
                np.array([s.position for s in known]),
                np.array([s.axis for s in known]),
                np.array([1.0 / single[i].estimate.sigma_position_m ** 2 for i in rows]),
            )
            if start is not None:
                return [start]
    if any(single[i].estimate.state == states.RESIDUAL for i in used):
        return []
    return start_from_grid(context.grid, context.field, coils.subset(used), frame.flux[used])


def track_body(
    track: BodyTrack,
    name: str,
    coils: BodyCoils,
    stamp_ns: int,
    flux: Array,
    usable: NDArray[np.bool_],
    single: list[CoilResult],
    context: SolveContext,
    settings: TrackerSettings,
) -> BodyResult:
    """Estimate a body's pose from the fluxes, shape (S, 2K), of its usable coils."""
    used = np.flatnonzero(usable)
    if len(used) < 2 or not coils.subset(used).observable:
        reason = f'{len(used)} of {len(usable)} coils usable; two that are not parallel are needed'
        worst = next(
            (s.estimate.state for i, s in enumerate(single) if not usable[i]), states.STALE
        )
        return BodyResult(no_pose(name, stamp_ns, worst, context.model_id, reason))
    frame = _BodyFrame(coils, flux, single, context)
    fits = _from_good(track, stamp_ns, frame, used, settings)
    if not fits:
        fits = [_solve(frame, used, start) for start in _cold_starts(frame, used)]
        fits.sort(key=lambda candidate: candidate.ratio)
        fits[:1] = [_without_disagreeing(f, frame, settings.gate) for f in fits[:1]]
    if not fits:
        reason = 'no coil of this body has a pose to start from'
        return BodyResult(no_pose(name, stamp_ns, states.RESIDUAL, context.model_id, reason))
    fit = fits[0]
    result = _judge(track, name, stamp_ns, fit, fits[1:], coils, context, settings)
    if result.state == states.OK:
        last, track.before = track.good, None
        moved = math.inf if last is None else distance(last.position, fit.solution.position)
        if last is not None and moved < SUSPICIOUS_JUMP_M:
            track.before = (track.good_ns, last)
        track.good, track.good_ns = fit.solution, stamp_ns
        track.noise.add(fit.ratio)
        left_out = frozenset(used.tolist()) - frozenset(fit.used.tolist())
        if left_out != track.left_out:
            track.left_out, track.again_ns = left_out, stamp_ns + round(LEFT_OUT_S / NANO)
    return BodyResult(result, fit)


def _from_good(
    track: BodyTrack,
    stamp_ns: int,
    frame: _BodyFrame,
    used: NDArray[np.int64],
    settings: TrackerSettings,
) -> list[BodyFit]:
    """The fit near the last good pose, when there is one that passes the gate."""
    if track.good is None or (stamp_ns - track.good_ns) * NANO > settings.warm_age_s:
        return []
    start = track.expected(stamp_ns)
    assert start is not None
    start = frame.nearer(start, used)
    if track.left_out and stamp_ns < track.again_ns:
        kept = np.array([i for i in used if int(i) not in track.left_out], dtype=np.int64)
        if len(kept) > 1 and frame.coils.subset(kept).observable:
            fit = _solve(frame, kept, start)
            if fit.good(settings.gate):
                return [fit]
    track.again_ns = stamp_ns + round(LEFT_OUT_S / NANO)
    fit = _without_disagreeing(_solve(frame, used, start), frame, settings.gate)
    return [fit] if fit.good(settings.gate) else []


def _judge(
    track: BodyTrack,
    name: str,
    stamp_ns: int,
    fit: BodyFit,
    rivals: list[BodyFit],
    coils: BodyCoils,
    context: SolveContext,
    settings: TrackerSettings,
) -> PoseEstimate:
    solution = fit.solution
    scale = variance_scale(
        track.noise, solution.chi2, fit.freedom, UNKNOWNS, RARE, context, settings
    )
    covariance = scale * bounded_inverse(solution.information)
    sigma = math.sqrt(covariance[0, 0] + covariance[1, 1] + covariance[2, 2])
    residual = float(np.sqrt(np.mean(solution.residual**2)))
    others = (
        (rival.solution.chi2, 'another pose')
        for rival in rivals
        if rival.solution.converged and _apart(rival.solution, solution)
    )
    state, reason = verdict(
        settings, solution.chi2, fit.freedom, residual,
        solution.position + solution.rotation @ coils.subset(fit.used).offsets.mean(axis=0),
        solution.converged, sigma, scale, rivals=others,
    )  # fmt: skip
    left_out = len(coils.offsets) - len(fit.used)
    if state == states.OK and left_out:
        reason = f'{left_out} of {len(coils.offsets)} coils left out'
    return PoseEstimate(
        name, stamp_ns, state, solution.position, solution.rotation[:, 2].copy(),
        solution.rotation, covariance, sigma, residual, fit.ratio, context.model_id, reason,
    )  # fmt: skip


def _apart(one: BodySolution, other: BodySolution) -> bool:
    """Whether two solutions are different poses, not one that two descents ended at."""
    return bool(
        np.linalg.norm(one.position - other.position) > SAME_PLACE_M
        or np.linalg.norm(one.rotation - other.rotation) > SAME_TURN
    )
