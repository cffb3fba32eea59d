"""Follows a rigid tool through time by all of its usable coils, without those that disagree."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from anser_ros import pose_states as states
from anser_ros.arrays import Array, Integers
from anser_ros.errors import TrackingError
from anser_ros.integrity.pose_checks import STREAM_GAP_S, is_part
from anser_ros.stamps import NANO
from anser_ros.tracking import body_step, rigid
from anser_ros.tracking.body_step import UNKNOWNS
from anser_ros.tracking.coil_step import Followed, Rules
from anser_ros.tracking.coil_track import CoilResult
from anser_ros.tracking.estimate import SYSTEMATIC, PoseEstimate
from anser_ros.tracking.seed import SAME_PLACE_M
from anser_ros.tracking.solve_context import NOT_FINITE
from anser_ros.tracking.solve_verdict import RARE, Freedom, SolveFrame, usual_and_most

DISAGREES = 4.0
"""A coil is left out when its share of the misfit is so many times the mean of the others'."""

SAME_TURN = 0.1
"""Two poses whose rotation matrices differ by no more (Frobenius norm: 0.1 is 4 deg) are one, as
for a coil (`seed.SAME_PLACE_M`). In 1980 pairs of descents of a nine-coil tool that ended at one
pose they differed by less than 1e-6. Smaller, and a pose that two descents reached makes itself
ambiguous; larger, and a second pose near by is not seen."""

LEFT_OUT_S = 1.0
"""How long a coil that disagreed stays out before it is tried again."""


Start = tuple[Array, Array]
"""A position, and a unit axis or a rotation matrix."""


class BodyTrack:
    """Remembers one body: its last good poses, its noise scale, the coils that disagreed."""

    def __init__(self) -> None:
        self.memory = body_step.BodyMemory.empty()
        self.left_out: frozenset[int] = frozenset()
        self.again_ns = 0

    def forget(self) -> None:
        """Drop the last poses, so that the next solves start cold."""
        self.memory.last[:] = 0
        self.left_out = frozenset()

    def note(self, frame: 'BodyFrame', fit: 'BodyFit') -> None:
        """Keep the residuals of a good solution; note which coils were left out of it."""
        self.memory = self.memory._replace(whitened=fit.solution.whitened)
        left_out: frozenset[int] = frozenset()
        if len(fit.used) < len(frame.usable):
            kept = fit.used.tolist()
            left_out = frozenset(frame.usable.tolist()).difference(kept)
            if is_part(frame.coils.offsets, left_out, kept):
                left_out = frozenset()  # the body waits for it, and asks again in the next frame
        if left_out != self.left_out:
            self.left_out, self.again_ns = left_out, frame.stamp_ns + round(LEFT_OUT_S / NANO)


@dataclass(frozen=True)
class BodyFit:
    """Holds a body's solution, the coils (indices) that took part, and the degrees of freedom."""

    solution: rigid.BodySolution
    used: Integers
    freedom: int

    @property
    def ratio(self) -> float:
        """Return chi-square divided by the degrees of freedom."""
        return self.solution.chi2 / self.freedom

    def good(self, gate: float) -> bool:
        """Return whether the descent has ended, and below the gate."""
        return self.solution.converged and self.ratio <= gate**2


@dataclass
class BodyFrame(SolveFrame):
    """Holds a body's fluxes (S, 2K), its coils, and what each of these found by itself.

    ``ended`` is what was found of all coils, of which the body's are ``rows`` (S,), and ``rules``
    are those that they were judged by.
    """

    coils: rigid.BodyCoils
    single: list[CoilResult]
    rows: Integers
    ended: Followed
    rules: Rules

    @cached_property
    def usable(self) -> Integers:
        """Return the indices of the coils that the body may use."""
        return np.flatnonzero([coil.usable for coil in self.single])

    def freedom(self, used: Integers) -> Freedom:
        """Return what the readings of some coils leave to the body's pose."""
        size, readings = len(used) * self.flux.shape[1], len(used) * self.context.readings
        return Freedom(max(size - UNKNOWNS, 1), UNKNOWNS, RARE, readings - UNKNOWNS)

    @cached_property
    def good(self) -> Integers:
        """Return the coils whose own poses tell where the body is; none where they don't."""
        good = np.array(
            [i for i in self.usable.tolist() if self.single[i].estimate.state == states.OK],
            dtype=np.int64,
        )
        return good if self.coils.subset(good).observable else good[:0]


@dataclass(frozen=True)
class BodyResult:
    """Holds a frame's estimate with the fit behind it; None where nothing was solved."""

    frame: BodyFrame
    estimate: PoseEstimate
    fit: BodyFit | None = None


def solve_with(frame: BodyFrame, used: Integers, start: Start) -> BodyFit:
    """Return the fit of some of a body's coils from a start near it."""
    part, context = frame.coils.subset(used), frame.context
    solution = rigid.solve_body(part, frame.flux[used], context.arrays, *start)
    return BodyFit(solution, used, frame.freedom(used).of_residual)


def _without_disagreeing(fit: BodyFit, frame: BodyFrame, gate: float) -> BodyFit:
    """Leave out, one by one, up to a third of the coils while one of them spoils the fit.

    What is left must be able to contradict the pose: whatever is wrong, three coils of three
    emitters fit some pose without the coil that disagrees most.
    """
    for _ in range(len(fit.used) // 3):
        if fit.ratio <= gate**2:
            break
        misfit = fit.solution.coil_chi2
        worst = int(np.argmax(misfit))
        others = np.delete(misfit, worst)
        rest = np.delete(fit.used, worst)
        if frame.freedom(rest).checks <= 0 or not frame.coils.subset(rest).observable:
            break
        if misfit[worst] < DISAGREES * others.mean():
            break
        fit = solve_with(frame, rest, (fit.solution.position, fit.solution.rotation))
    return fit


def _cold_starts(frame: BodyFrame, used: Integers) -> list[Start]:
    context, coils, single = frame.context, frame.coils, frame.single
    for wanted in (states.OK, states.RESIDUAL):
        rows = [i for i in used if single[i].estimate.state == wanted]
        solutions = [single[i].solution for i in rows]
        known = [s for s in solutions if s is not None]
        if known:
            start = rigid.start_from_coils(
                coils.subset(np.array(rows)),
                np.array([s.position for s in known]),
                np.array([s.axis for s in known]),
                np.array([1.0 / single[i].estimate.sigma_position_m ** 2 for i in rows]),
            )
            if start is not None:
                return [start]
    if any(single[i].estimate.state == states.RESIDUAL for i in used):
        return []
    return rigid.start_from_grid(context.grid, context.field, coils.subset(used), frame.flux[used])


def _misfit(fit: BodyFit) -> float:
    """Misfit as if errors were alike everywhere: where they are large, anything is explained."""
    return fit.ratio * fit.solution.growth


def track_body(track: BodyTrack, frame: BodyFrame) -> BodyResult:
    """Estimate a body's pose from the fluxes of its usable coils."""
    used, coils, gate = frame.usable, frame.coils, frame.settings.gate
    if len(used) < 2 or not coils.subset(used).observable:
        count = f'{len(used)} of {len(frame.single)} coils usable'
        reason = f'{count}; two that are not parallel are needed'
        bad = (c.estimate.state for c in frame.single if not c.usable)
        worst = next((state for state in bad if state != states.OK), states.AMBIGUOUS)
        return BodyResult(frame, frame.no_pose(worst, reason))
    fit, estimate = _follow(track, frame)
    if fit is not None and estimate is not None:
        return BodyResult(frame, estimate, fit)
    if fit is not None:
        fit = _without_disagreeing(fit, frame, gate)
    fits = [fit] if fit is not None and fit.good(gate) else []
    continues = bool(fits)
    if not fits:
        fits = [solve_with(frame, used, start) for start in _cold_starts(frame, used)]
        fits.sort(key=_misfit)
        fits[:1] = [_without_disagreeing(f, frame, gate) for f in fits[:1]]
    if not fits:
        reason = 'no coil of this body has a pose to start from'
        return BodyResult(frame, frame.no_pose(states.RESIDUAL, reason))
    fits += _on_other_sides(frame, fits[0])
    fits.sort(key=_misfit)
    fit = fits[0]
    result = _judge(track, frame, fit, fits[1:], continues)
    if result.state == states.OK:
        found = fit.solution
        body_step.remember(
            frame.stamp_ns, found.position, found.rotation, fit.ratio, found.whitened,
            fit.freedom, track.memory,
        )  # fmt: skip
        track.note(frame, fit)
    return BodyResult(frame, result, fit)


def _follow(track: BodyTrack, frame: BodyFrame) -> tuple[BodyFit | None, PoseEstimate | None]:
    """The fit near the last good pose, if there is one, and its estimate if it is sound."""
    whole, coils, context, stamp_ns = frame.usable, frame.coils, frame.context, frame.stamp_ns
    tries, last_ns, fit = [whole], int(track.memory.last[0]), None
    age_s = (stamp_ns - last_ns) * NANO
    if not last_ns or age_s > frame.settings.warm_age_s:
        return None, None
    if age_s > STREAM_GAP_S and frame.freedom(whole).checks <= 0:
        return None, None  # neither a reading nor a motion is left to contradict the pose
    if track.left_out and stamp_ns < track.again_ns:
        kept = np.array([i for i in whole.tolist() if i not in track.left_out], dtype=np.int64)
        if len(kept) > 1 and coils.subset(kept).observable:
            tries.insert(0, kept)
    ended, rows = frame.ended, frame.rows
    own = ended.position[rows], ended.axis[rows], ended.normal[rows]
    for used in tries:
        freedom, is_whole = frame.freedom(used), len(used) == len(whole)
        is_finite, is_sound, covariance, residual_t, solution = body_step.follow_body(
            stamp_ns, frame.flux, coils.arrays, used, is_whole, own, frame.good,
            track.memory, context.arrays, context.middle, frame.rules,
            usual_and_most(frame.settings, freedom),
        )  # fmt: skip
        if not is_finite:
            raise TrackingError(NOT_FINITE)
        fit = BodyFit(solution, used, freedom.of_residual)
        if used is whole:
            track.again_ns = stamp_ns + round(LEFT_OUT_S / NANO)
        if is_sound and is_whole:
            track.note(frame, fit)
            return fit, PoseEstimate(
                frame.name, stamp_ns, states.OK, solution.position,
                solution.rotation[:, 2].copy(), solution.rotation, covariance, residual_t,
                fit.ratio, context.model_id, _left_out(frame, fit), freedom.checks,
            )  # fmt: skip
        if fit.good(frame.settings.gate):
            break
    return fit, None


def _left_out(frame: BodyFrame, fit: BodyFit) -> str:
    """How many coils were not used; empty for none."""
    left_out = len(frame.single) - len(fit.used)
    return f'{left_out} of {len(frame.single)} coils left out' if left_out else ''


OTHER_SIDES = -np.ones(3), np.array([1.0, 1.0, -1.0])
"""What takes a place to the other side of a source, and to that of a board (its plane is z)."""


def _on_other_sides(frame: BodyFrame, fit: BodyFit) -> list[BodyFit]:
    """Fits across the source and the board, where the volume reaches there.

    A dipole has the same field at opposite places, and upright dipoles in a plane have on its
    other side the field that half a turn about z makes of it: what is read cannot tell them apart.
    """
    solution, middle = fit.solution, frame.context.middle
    lever = frame.coils.subset(fit.used).middle
    place, found = solution.position + solution.rotation @ lever - middle, []
    for signs in OTHER_SIDES:
        across = middle + signs * place
        if not frame.settings.box.contains(across):
            continue
        if np.linalg.norm((signs - 1.0) * place) > SAME_PLACE_M:
            rotation = -signs[:, None] * solution.rotation
            found.append(solve_with(frame, fit.used, (across - rotation @ lever, rotation)))
    return found


def _judge(
    track: BodyTrack, frame: BodyFrame, fit: BodyFit, rivals: list[BodyFit], continues: bool
) -> PoseEstimate:
    """The estimate, which has the error of a gain that all coils have in common, too."""
    solution, covariance = fit.solution, fit.solution.covariance
    by_gain = np.outer(*[solution.gain * solution.carried] * 2)
    position, rotation = solution.position, solution.rotation
    others = (
        (rival.solution.chi2 * rival.solution.growth / solution.growth, 'another pose')
        for rival in rivals
        if rival.solution.converged and _apart(rival.solution, solution)
    )
    freedom = frame.freedom(fit.used)
    usual, _ = usual_and_most(frame.settings, freedom)
    if fit.ratio > usual and len(fit.used) < len(frame.usable):
        # Some disagreed, and the others do not agree without them.
        covariance = SYSTEMATIC * covariance
    estimate = frame.estimate(
        track.memory.noise, solution, freedom,
        (position, rotation[:, 2].copy(), rotation), lambda scale: covariance + by_gain / scale,
        others,
        position + rotation @ frame.coils.subset(fit.used).middle,
        continues=continues,
    )  # fmt: skip
    if estimate.state == states.OK:
        estimate.reason = _left_out(frame, fit)
    return estimate


def _apart(one: rigid.BodySolution, other: rigid.BodySolution) -> bool:
    """Whether two solutions are different poses, not one that two descents ended at."""
    return bool(
        np.linalg.norm(one.position - other.position) > SAME_PLACE_M
        or np.linalg.norm(one.rotation - other.rotation) > SAME_TURN
    )
