"""Follows a rigid tool through time by all of its usable coils, without those that disagree."""

import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from anser_ros import pose_states as states
from anser_ros.arrays import Array, Integers
from anser_ros.errors import TrackingError
from anser_ros.integrity.pose_checks import is_part
from anser_ros.stamps import NANO
from anser_ros.tracking import rigid
from anser_ros.tracking.coil_step import MOST_STEPS, SUSPICIOUS_JUMP_M
from anser_ros.tracking.coil_track import CoilResult
from anser_ros.tracking.estimate import NoiseScale, PoseEstimate, TrackerSettings
from anser_ros.tracking.seed import SAME_PLACE_M
from anser_ros.tracking.solve_context import NOT_FINITE
from anser_ros.tracking.solve_verdict import RARE, SYSTEMATIC, Freedom, SolveFrame, usual_and_most

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


Start = tuple[Array, Array]
"""A position, and a unit axis or a rotation matrix."""


@dataclass
class Track:
    """Remembers the last two good solutions of one thing, and its noise scale."""

    good: rigid.BodySolution | None = None
    good_ns: int = 0
    before: tuple[int, rigid.BodySolution] | None = None
    noise: NoiseScale = field(default_factory=NoiseScale)

    def forget(self) -> None:
        """Drop the last poses, so that the next solve starts cold."""
        self.good = self.before = None

    def fresh(self, stamp_ns: int, settings: TrackerSettings) -> rigid.BodySolution | None:
        """Return the last good solution; None where there is none, or it is too old."""
        return self.good if (stamp_ns - self.good_ns) * NANO <= settings.warm_age_s else None

    def steps(self, stamp_ns: int) -> float:
        """Return how many of the last good step's durations have passed since; 0 for too many."""
        if self.before is None:
            return 0.0
        steps = (stamp_ns - self.good_ns) / max(self.good_ns - self.before[0], 1)
        return steps if 0.0 < steps <= MOST_STEPS else 0.0

    def remember(self, solution: rigid.BodySolution, stamp_ns: int) -> None:
        """Take in a good solution."""
        last, self.before = self.good, None
        if last is not None and math.dist(last.position, solution.position) < SUSPICIOUS_JUMP_M:
            self.before = (self.good_ns, last)
        self.good, self.good_ns = solution, stamp_ns


@dataclass
class BodyTrack(Track):
    """Remembers one body: its last good poses, its noise scale, the coils that disagreed."""

    left_out: frozenset[int] = frozenset()
    again_ns: int = 0

    def forget(self) -> None:
        """Drop the last poses, so that the next solve starts cold."""
        super().forget()
        self.left_out = frozenset()

    def expected(self, good: rigid.BodySolution, stamp_ns: int) -> Start:
        """Return where the body is if it moves on as it did between its last two good poses."""
        steps = self.steps(stamp_ns)
        if self.before is None or steps == 0.0:
            return good.position, good.rotation
        old = self.before[1]
        start: Start = rigid.carried_on(
            good.position, good.rotation, old.position, old.rotation, steps
        )
        return start


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


@dataclass(frozen=True)
class BodyResult:
    """Holds an estimate with the fit behind it; None where nothing was solved.

    ``gain`` is what all coils' gain may be off by, see `BodySolution.gain`; 0 where that is known
    of none.
    """

    estimate: PoseEstimate
    fit: BodyFit | None = None
    gain: float = 0.0


@dataclass
class BodyFrame(SolveFrame):
    """Holds a body's fluxes (S, 2K), its coils, and what each of these found by itself.

    ``own`` are positions (S, 3), m, axes (S, 3) and normal matrices (S, 6, 6) of their solutions.
    """

    coils: rigid.BodyCoils
    single: list[CoilResult]
    own: tuple[Array, Array, Array]

    @property
    def usable(self) -> Integers:
        """Return the indices of the coils that the body may use."""
        return np.flatnonzero([coil.usable for coil in self.single])

    @cached_property
    def inverse_sigma(self) -> Array:
        """Return the inverse of each sigma, 1/T, shape (2K,)."""
        return 1.0 / self.context.sigma

    def checks(self, used: Integers) -> int:
        """Return how many readings of some coils are beyond the pose's unknowns."""
        return len(used) * self.context.readings - UNKNOWNS

    def common(self, used: Integers, start: Start, strengths: Array | None = None) -> Array:
        """Return what some coils' errors have in common, see `fill_common`.

        Errors of the emitters' ``strengths`` are those of the context unless others are given.
        """
        coils, of, flux = self.coils.subset(used), self.context.arrays, self.flux[used]
        strengths = of.strengths if strengths is None else strengths
        changes = coils.gain_changes
        rank = of.modes.shape[1] // flux.shape[1] + len(changes) + strengths.shape[1]
        out = np.empty((rank, flux.size))
        if not rigid.fill_common(
            *start, coils.offsets, coils.axes, coils.lengths, changes, flux, of.uncertain,
            of.modes, of.sigma, strengths, out,
        ):  # fmt: skip
            raise TrackingError(NOT_FINITE)
        return out

    def nearer(self, start: Start, used: Integers) -> Start:
        """Return a start moved to where the coils' own good poses agree best."""
        good = [i for i in used.tolist() if self.single[i].estimate.state == states.OK]
        coils, own = self.coils, self.own
        if len(good) < len(coils.axes):
            coils, own = (
                coils.subset(np.array(good, np.int64)),
                (own[0][good], own[1][good], own[2][good]),
            )
        if not coils.observable:
            return start
        nearer: Start = rigid.step_to_coils(
            *start, coils.offsets, coils.axes, *own,
            self.context.low - coils.reach, self.context.high + coils.reach,
        )  # fmt: skip
        return nearer


def solve_with(frame: BodyFrame, used: Integers, start: Start) -> BodyFit:
    """Return the fit of some of a body's coils from a start near it."""
    part, context = frame.coils.subset(used), frame.context
    flux = frame.flux[used]
    solution = rigid.solve_body(
        context.field, part, flux, frame.inverse_sigma, frame.common(used, start), *start,
        context.low - part.reach, context.high + part.reach,
    )  # fmt: skip
    return BodyFit(solution, used, max(flux.size - UNKNOWNS, 1))


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
        if frame.checks(rest) <= 0 or not frame.coils.subset(rest).observable:
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


def track_body(track: BodyTrack, frame: BodyFrame) -> BodyResult:
    """Estimate a body's pose from the fluxes of its usable coils."""
    used, coils, gate = frame.usable, frame.coils, frame.settings.gate
    if len(used) < 2 or not coils.subset(used).observable:
        count = f'{len(used)} of {len(frame.single)} coils usable'
        reason = f'{count}; two that are not parallel are needed'
        bad = (c.estimate.state for c in frame.single if not c.usable)
        worst = next((state for state in bad if state != states.OK), states.AMBIGUOUS)
        return BodyResult(frame.no_pose(worst, reason))
    fits = _from_good(track, frame, used)
    continues = bool(fits)
    if not fits:
        fits = [solve_with(frame, used, start) for start in _cold_starts(frame, used)]
        fits.sort(key=lambda candidate: candidate.ratio)
        fits[:1] = [_without_disagreeing(f, frame, gate) for f in fits[:1]]
    if not fits:
        reason = 'no coil of this body has a pose to start from'
        return BodyResult(frame.no_pose(states.RESIDUAL, reason))
    fits += _on_other_sides(frame, fits[0])
    fits.sort(key=lambda candidate: candidate.ratio)
    fit = fits[0]
    result, gain = _judge(track, frame, fit, fits[1:], continues)
    if result.state == states.OK:
        track.remember(fit.solution, frame.stamp_ns)
        track.noise.add(fit.ratio, fit.solution.whitened, fit.freedom)
        left_out = frozenset(used.tolist()) - frozenset(fit.used.tolist())
        if is_part(coils.offsets, left_out, fit.used.tolist()):
            left_out = frozenset()  # the body waits for it, and asks again in the next frame
        if left_out != track.left_out:
            track.left_out, track.again_ns = left_out, frame.stamp_ns + round(LEFT_OUT_S / NANO)
    return BodyResult(result, fit, gain)


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


def _from_good(track: BodyTrack, frame: BodyFrame, used: Integers) -> list[BodyFit]:
    """The fit near the last good pose, when there is one that passes the gate."""
    stamp_ns, gate = frame.stamp_ns, frame.settings.gate
    good = track.fresh(stamp_ns, frame.settings)
    if good is None:
        return []
    start = frame.nearer(track.expected(good, stamp_ns), used)
    if track.left_out and stamp_ns < track.again_ns:
        kept = np.array([i for i in used if int(i) not in track.left_out], dtype=np.int64)
        if len(kept) > 1 and frame.coils.subset(kept).observable:
            fit = solve_with(frame, kept, start)
            if fit.good(gate):
                return [fit]
    track.again_ns = stamp_ns + round(LEFT_OUT_S / NANO)
    fit = _without_disagreeing(solve_with(frame, used, start), frame, gate)
    return [fit] if fit.good(gate) else []


def _judge(
    track: BodyTrack, frame: BodyFrame, fit: BodyFit, rivals: list[BodyFit], continues: bool
) -> tuple[PoseEstimate, float]:
    """The estimate, and by how much a common gain may be off, the error of which it has too."""
    solution = fit.solution
    covariance, gain = solution.covariance, solution.gain
    by_gain = np.outer(gain * solution.carried, gain * solution.carried)
    position, rotation = solution.position, solution.rotation
    others = (
        (rival.solution.chi2, 'another pose')
        for rival in rivals
        if rival.solution.converged and _apart(rival.solution, solution)
    )
    freedom = Freedom(fit.freedom, UNKNOWNS, RARE, frame.checks(fit.used))
    usual, _ = usual_and_most(frame.settings, freedom)
    if fit.ratio > usual and len(fit.used) < len(frame.usable):
        # Some disagreed, and the others do not agree without them.
        covariance = SYSTEMATIC * covariance
    estimate = frame.estimate(
        track.noise, solution, freedom,
        (position, rotation[:, 2].copy(), rotation), lambda scale: covariance + by_gain / scale,
        others,
        position + rotation @ frame.coils.subset(fit.used).middle,
        continues=continues,
    )  # fmt: skip
    left_out = len(frame.single) - len(fit.used)
    if estimate.state == states.OK and left_out:
        reason = f'{left_out} of {len(frame.single)} coils left out'
        estimate = replace(estimate, reason=reason)
    return estimate, gain


def _apart(one: rigid.BodySolution, other: rigid.BodySolution) -> bool:
    """Whether two solutions are different poses, not one that two descents ended at."""
    return bool(
        np.linalg.norm(one.position - other.position) > SAME_PLACE_M
        or np.linalg.norm(one.rotation - other.rotation) > SAME_TURN
    )
