"""Follows tool sensors through time: warm or cold solve, gate, state, uncertainty.

The steps of a frame: all coils are solved near where they are expected, judged by themselves and
remembered if they are good, in one compiled step (`coil_step`); any other coil is looked at again,
or scanned for (`track_coil`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from anser_ros import pose_states as states
from anser_ros.arrays import Array, Booleans
from anser_ros.errors import TrackingError
from anser_ros.stamps import NANO
from anser_ros.tracking import coil_step
from anser_ros.tracking.estimate import FRESH_NOISE, PoseEstimate, TrackerSettings
from anser_ros.tracking.seed import solve_cold
from anser_ros.tracking.solve import CoilSolution, coil_covariance, solve_coil, whitening_of
from anser_ros.tracking.solve_context import NOT_FINITE, ErrorModes, SolveContext, growth_at
from anser_ros.tracking.solve_verdict import SOUND, Freedom, SolveFrame, millimetres

FIRST_RETRY_S, LAST_RETRY_S = 0.05, 0.25
"""Pauses after a scan without a good pose, s: the first one, which doubles from scan to scan, and
the longest. Scans cost far more than warm solves, and a long distortion would ask for one in every
frame; the longest pause bounds how late the end of a distortion is noticed."""
THOROUGH_EVERY = 4
"""Every so many scans of a long distortion one tries all starts."""
CHANGED = 3.0
"""A suspect's chi-square that changes by this factor calls for a scan before its time."""


@dataclass
class Scans:
    """Remembers the scans for one coil while none of its poses is good.

    ``suspect`` is the best bad one. It shows whether anything has changed, so that the costly scan
    need not run in every frame of a long distortion; it never becomes a pose unless a scan
    confirms it.
    """

    suspect: CoilSolution | None = None
    failures: int = 0
    retry_ns: int = 0

    def forget(self) -> None:
        """Forget the suspect."""
        self.suspect, self.failures = None, 0


class CoilTracks:
    """Remembers coils, a row each, and solves them near where they are expected.

    ``freedom`` is what the readings of the last frame left to the pose of each, and ``rules`` are
    those that its poses were judged by.
    """

    freedom: Freedom
    rules: coil_step.Rules

    def __init__(self, count: int) -> None:
        self.scans = [Scans() for _ in range(count)]
        self._made_for: tuple[ErrorModes | None, Array, Array] | None = None
        self._ruled: tuple[TrackerSettings, Freedom] | None = None
        noise = np.tile(FRESH_NOISE, (count, 1))
        some, none = np.zeros((count, 6)), np.empty((count, 0, 0))
        stamps = np.zeros(count, dtype=np.int64)
        self.memory = coil_step.CoilMemory(
            stamps, stamps.copy(), some, some.copy(), noise, np.empty((count, 0)), some.copy(),
            np.full(count, -1.0), np.zeros(count), none, none,
        )  # fmt: skip

    def forget(self) -> None:
        """Drop the last poses, so that the next solves start cold."""
        self.memory.good_ns[:] = self.memory.before_ns[:] = 0
        for scans in self.scans:
            scans.forget()

    def prepare(self, context: SolveContext) -> coil_step.CoilMemory:
        """Drop what is remembered of the errors of another model; return the memory."""
        modes, sigma = context.modes, context.sigma
        if self._made_for is not None:
            known, own, strengths = self._made_for
            is_same = own is sigma or np.array_equal(own, sigma)
            if known is modes and strengths is context.strengths and is_same:
                return self.memory
        memory, count, width = self.memory, len(self.scans), sigma.size
        rank = 0 if modes is None else modes.moments.shape[1] // width
        rows = 1 if context.is_certain else width
        if memory.whitening.shape[1:] != (rows, width) or memory.errors.shape[1] != rank:
            memory = memory._replace(
                errors=np.empty((count, rank, width)), whitening=np.empty((count, rows, width))
            )
        if memory.whitened.shape[1] != width:
            memory = memory._replace(whitened=np.full((count, width), np.nan))
        if context.is_certain:
            memory.whitening[:] = whitening_of(sigma)
        memory.reach_m[:], memory.among[:] = -1.0, 0.0
        self.memory, self._made_for = memory, (modes, sigma, context.strengths)
        return memory

    def follow(
        self,
        stamp_ns: int,
        values: Array,
        sound: Booleans,
        lengths: Array,
        context: SolveContext,
        settings: TrackerSettings,
    ) -> coil_step.Followed:
        """Solve all coils near where they are expected; see `follow_coils`."""
        out, memory = coil_step.Followed.empty(*values.shape), self.prepare(context)
        ruled, freedom = self._ruled, coil_step.freedom_of(values.shape[1], context.readings)
        if ruled is None or ruled[0] is not settings or ruled[1] != freedom:
            self._ruled, self.freedom = (settings, freedom), freedom
            self.rules = coil_step.rules_of(settings, freedom)
        if context.readings >= coil_step.UNKNOWNS and not coil_step.follow_coils(
            stamp_ns, values, sound, lengths, memory, context.arrays, self.rules, out
        ):
            raise TrackingError(NOT_FINITE)
        return out

    def followed(
        self, stamp_ns: int, names: Sequence[str], ended: coil_step.Followed, model_id: str
    ) -> 'list[CoilResult | None]':
        """Return what `follow` found of each coil; None where it is not good where expected."""
        results: list[CoilResult | None] = [None] * len(names)
        among, freedom = self.memory.among.tolist(), self.freedom
        for i in np.flatnonzero(ended.fault == SOUND).tolist():
            self.scans[i].forget()
            found = ended.solution(i)
            estimate = PoseEstimate(
                names[i], stamp_ns, states.OK, found.position, found.axis, None,
                ended.covariance[i], ended.residual_t.item(i), found.chi2 / freedom.of_residual,
                model_id, '', freedom.checks,
            )  # fmt: skip
            results[i] = CoilResult(estimate, found, False, among[i] > 1.0)
        return results


@dataclass
class CoilFrame(SolveFrame):
    """Holds one sensor's fluxes (2K,), finite, its length, m, and its row among the tracks.

    ``freedom`` is what the readings leave to the pose.
    """

    length: float
    row: int
    tracks: CoilTracks
    freedom: Freedom

    @property
    def among_metal(self) -> bool:
        """Return whether the sensor is where dipoles that stand for metal describe it no more."""
        return bool(self.tracks.memory.among[self.row] > 1.0)


class CoilResult(NamedTuple):
    """Holds an estimate with its solution; None where nothing was solved.

    ``is_received`` is whether the fluxes of a coil are good although nothing was solved for it,
    ``among_metal`` as for the frame.
    """

    estimate: PoseEstimate
    solution: CoilSolution | None
    cold: bool = False
    among_metal: bool = False
    is_received: bool = False

    @property
    def usable(self) -> bool:
        """Return whether a body may use the coil: it has a solution, and is not among metal."""
        return (self.is_received or self.solution is not None) and not self.among_metal


def track_coil(frame: CoilFrame, followed: coil_step.Followed) -> CoilResult:
    """Estimate the pose of a sensor that is not good where it was expected, there or anywhere."""
    context, settings, row = frame.context, frame.settings, frame.row
    scans, fault = frame.tracks.scans[row], followed.fault[row]
    if fault != coil_step.UNKNOWN:
        solution = followed.solution(row)
        return CoilResult(_judge(frame, solution, []), solution, False, frame.among_metal)
    loudness = frame.flux / context.sigma
    signal = math.sqrt(float(loudness @ loudness) / loudness.size)
    if signal < settings.min_signal:
        reason = f'flux is {signal:.2g} times the noise'
        return CoilResult(frame.no_pose(states.NO_SIGNAL, reason), None)
    if context.readings < coil_step.UNKNOWNS:
        few = f'{context.readings} readings are too few'
        reason = f'{few} for the {coil_step.UNKNOWNS} unknowns of a pose'
        return CoilResult(frame.no_pose(states.AMBIGUOUS, reason), None, is_received=True)
    if scans.suspect is not None and frame.stamp_ns < scans.retry_ns:
        solution = _descend(frame, scans.suspect.position, scans.suspect.axis)
        judged = _judge(frame, solution, [])
        change = solution.chi2 / max(scans.suspect.chi2, 1e-300)
        if judged.state != states.OK and 1.0 / CHANGED < change < CHANGED:
            return CoilResult(judged, solution, False, frame.among_metal)
    return _scanned(frame, scans, *_cold(frame, scans))


def _cold(frame: CoilFrame, scans: Scans) -> list[CoilSolution]:
    """All distinct poses in order of chi-square, with the model's error at each in the weights."""
    context = frame.context
    # Far from the truth only the size of the model's error counts, not its pattern.
    power = float(np.mean((frame.flux / context.sigma) ** 2))
    limit = frame.settings.gate**2 * frame.freedom.of_residual
    limit *= 1.0 + context.relative_error**2 * power
    found = solve_cold(
        context.field, context.grid, frame.flux, whitening_of(context.sigma), context.low,
        context.high, frame.length, limit, thorough=scans.failures % THOROUGH_EVERY == 0,
    )  # fmt: skip
    if context.is_certain:
        return [_grown(context, s) for s in found]
    near = [s for s in found if s.chi2 <= 100.0 * limit or s is found[0]]
    ended = (_descend(frame, s.position, s.axis) for s in near)
    # as if errors were alike everywhere: a place where they are large explains anything
    return sorted(ended, key=lambda solution: solution.chi2 * solution.growth)


def _descend(frame: CoilFrame, position: Array, axis: Array) -> CoilSolution:
    context, length, row = frame.context, frame.length, frame.row
    _take_errors(frame, position, axis)
    solution = solve_coil(
        context.field, frame.flux, frame.tracks.memory.whitening[row], position, axis,
        context.low, context.high, length,
    )  # fmt: skip
    return _grown(context, solution)


def _grown(context: SolveContext, solution: CoilSolution) -> CoilSolution:
    """Return a solution weighed by the field's error where it ended, not the typical one."""
    growth = growth_at.py_func(solution.position, context.arrays)
    return solution._replace(
        chi2=solution.chi2 / growth, normal=solution.normal / growth, growth=growth
    )


def _take_errors(frame: CoilFrame, position: Array, axis: Array) -> None:
    """Remember the model's error for the coil at a pose."""
    length, memory, flux = np.array([frame.length]), frame.tracks.memory, frame.flux[None]
    model = frame.context.arrays
    if not coil_step.take_errors(frame.row, position, axis, length, flux, memory, model):
        raise TrackingError(NOT_FINITE)


def _scanned(
    frame: CoilFrame, scans: Scans, solution: CoilSolution, *rivals: CoilSolution
) -> CoilResult:
    """Judge the best solution of a scan and remember it as good or suspect."""
    judged = _judge(frame, solution, rivals)
    if judged.state == states.OK:
        _take_errors(frame, solution.position, solution.axis)
        if frame.among_metal:  # where it ended, not where it began
            judged = _judge(frame, solution, rivals)
    if judged.state == states.OK:
        scans.forget()
        coil_step.remember(
            frame.row, frame.stamp_ns, solution.position, solution.axis, solution.residual,
            judged.chi2, frame.freedom.of_residual * solution.growth, frame.tracks.memory,
        )  # fmt: skip
    else:
        wait_s = min(FIRST_RETRY_S * 2.0 ** min(scans.failures, 10), LAST_RETRY_S)
        scans.suspect, scans.failures = solution, scans.failures + 1
        scans.retry_ns = frame.stamp_ns + round(wait_s / NANO)
    return CoilResult(judged, solution, True, frame.among_metal)


def _judge(
    frame: CoilFrame, solution: CoilSolution, rivals: Sequence[CoilSolution]
) -> PoseEstimate:
    position, axis, settings = solution.position, solution.axis, frame.settings
    others = (
        (rival.chi2 * rival.growth / solution.growth, f'{millimetres(rival.position)} mm')
        for rival in rivals
        if rival.converged and settings.box.contains(rival.position)
    )
    return frame.estimate(
        frame.tracks.memory.noise[frame.row], solution, frame.freedom, (position, axis, None),
        lambda scale: coil_covariance(solution.normal, axis, settings.roll_variance / scale),
        others, position, in_metal=frame.among_metal,
    )  # fmt: skip
