"""Judges a frame's poses by each other and by the frames before, before any is given out.

Each pose has passed its own frame's gate. Here a coil has to agree with its body, a pose with its
course (`anser_ros.integrity`), and the model with most of the readings: one that leaves most of
the last seconds' unexplained is doubtful, though single poses pass by chance.
"""

import math
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from anser_ros import pose_states as states
from anser_ros.arrays import Integers
from anser_ros.integrity import pose_checks
from anser_ros.integrity.pose_checks import ARM_M, STREAM_GAP_S, Continuity, Place
from anser_ros.stamps import NANO
from anser_ros.tracking.body_track import BodyResult
from anser_ros.tracking.coil_step import UNKNOWNS
from anser_ros.tracking.coil_track import CoilResult
from anser_ros.tracking.estimate import PoseEstimate, TrackerSettings
from anser_ros.tracking.rigid import BodyCoils
from anser_ros.tracking.solve import add_gain, add_motion

Estimates = list[PoseEstimate]

CONTRADICTS = (states.RESIDUAL, states.INCONSISTENT)
"""States of a pose that the model, or the body, does not explain although there are signals."""


RECORD_S = 2.0
"""How far back readings count, s. Smaller, and metal that passes makes the model doubtful; larger,
and a wrong model gives poses for longer."""
DOUBTFUL = 0.8
"""Share of refused readings from which on the model is doubtful; by chance every third pose passes
a model that is a little wrong."""
FEWEST_JUDGED_READINGS = 6
"""Readings that a share is made of at least: a single bad coil is not the whole chain."""
GOOD_SHARE = 0.2
"""Share of refused readings up to which a frame speaks for the model: one bad coil of five."""
RECOVERY_S = 0.5
"""For so long, s, all frames must speak for a doubtful model before it gives poses again: where it
happens to fit, it is not yet right."""


class ModelRecord:
    """Counts how many readings the model explained lately."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        self._frames: deque[tuple[int, int, int, float]] = deque()
        self._refused = self._total = self._sound_since_ns = self._last_ns = 0
        self.is_doubtful = False

    @property
    def refused_share(self) -> float:
        """Return the share of the last seconds' readings that the model did not explain."""
        return self._refused / max(self._total, 1)

    def add(self, stamp_ns: int, refused: int, total: int, residual: float) -> None:
        """Take in a frame: how many of its readings the model did not explain.

        ``residual`` is the typical one of these in units of the expected one; NaN for none.
        """
        last_ns = self._last_ns
        if not last_ns or not 0 < stamp_ns - last_ns <= STREAM_GAP_S / NANO:
            self.forget()
        self._last_ns = stamp_ns
        frames = self._frames
        while frames and stamp_ns - frames[0][0] > RECORD_S / NANO:
            _, gone, counted, _ = frames.popleft()
            self._refused, self._total = self._refused - gone, self._total - counted
        frames.append((stamp_ns, refused, total, residual))
        self._refused, self._total = self._refused + refused, self._total + total
        if (total and refused > GOOD_SHARE * total) or not self._sound_since_ns:
            self._sound_since_ns = stamp_ns
        is_sound = stamp_ns - self._sound_since_ns >= RECOVERY_S / NANO
        if is_sound:
            self.is_doubtful = False
        elif self._total >= FEWEST_JUDGED_READINGS and self.refused_share > DOUBTFUL:
            self.is_doubtful = True

    @property
    def reason(self) -> str:
        """Return why the model is doubtful: the share, and how large residuals are."""
        residuals = sorted(r for _, _, _, r in self._frames if math.isfinite(r))
        typical = residuals[len(residuals) // 2] if residuals else math.nan
        return (
            f'{100 * self.refused_share:.0f} % of the readings of the last {RECORD_S:g} s '
            f'contradict the model, residual {typical:.3g} times the expected one'
        )


class Judgement:
    """Holds what the checks remember of a tracker's sensors and bodies."""

    def __init__(self) -> None:
        self._continuity: dict[str, Continuity] = {}
        self._last: dict[str, PoseEstimate] = {}
        # The two parts of a body that contradicted each other and have not agreed since, and why
        self._split: dict[str, tuple[set[int], set[int], str]] = {}
        self.record = ModelRecord()

    def forget(self) -> None:
        self._continuity.clear()
        self._last.clear()
        self._split.clear()
        self.record.forget()

    def judged(
        self,
        stamp_ns: int,
        coils: Sequence[CoilResult],
        bodies: Sequence[BodyResult],
        settings: TrackerSettings,
        loose: Sequence[tuple[Integers, BodyCoils]] = (),
    ) -> Estimates:
        """Return the estimates of a frame, sensors first, with what the checks say of them.

        ``loose`` are the rows and coils of bodies that have no pose in this frame.
        """
        found = [result.estimate for result in coils]
        alone = set(range(len(coils)))
        for body in bodies:
            if body.fit is not None:
                rows, gain = body.frame.rows.tolist(), body.fit.solution.gain
                alone.difference_update(rows)
                _add_gain_error(found, coils, rows if gain > 0.0 else (), gain)
        _add_gain_error(found, coils, alone, math.nan)
        of_bodies = [body.estimate for body in bodies]
        if settings.judges:
            of_bodies = [self._judged_by_coils(found, body, settings) for body in bodies]
            for rows, table in loose:
                _take_strangers(found, rows, table, settings)
        found += of_bodies
        if settings.judges:
            self._add_to_record(stamp_ns, found[: len(coils)])
            found = [self._judged_in_time(estimate, settings) for estimate in found]
            single = set(range(len(coils)))
            for i, body in enumerate(bodies):
                rows = body.frame.rows.tolist()
                self._take_alternating(found, [*rows, len(coils) + i])
                single.difference_update(rows)
            groups = [rows.tolist() for rows, _ in loose]
            single.difference_update(*groups)
            for group in (*groups, *([row] for row in single)):
                self._take_alternating(found, group)
        for estimate in found:
            if estimate.state == states.OK:
                self._add_stamp_error(estimate, settings)
        return found

    def _judged_by_coils(
        self, found: Estimates, body: BodyResult, settings: TrackerSettings
    ) -> PoseEstimate:
        """Return a body's estimate; withhold, in ``found``, the poses of coils that contradict it.

        If all coils together fit the model in no pose, even without those that disagree most, it
        is unknown which of them are right: a smooth distortion can look like a pose to each. So it
        is where one part of the tool contradicts the other, see `pose_checks.is_part`, and stays
        until a frame in which coils of both agree: a bend lasts, also where one part is unseen.
        """
        estimate, fit = body.estimate, body.fit
        rows = body.frame.rows.tolist()
        members = {i for i, row in enumerate(rows) if found[row].state == states.OK}
        if fit is None or not members:
            return estimate
        against: dict[int, str] = {}
        if estimate.state == states.RESIDUAL:
            why = f"the body's coils fit no pose together: {estimate.reason}"
            against = dict.fromkeys(members, why)
        elif estimate.state in (states.OK, states.OUTSIDE_VOLUME):
            against = _contradictions(body, sorted(members), settings)
            agree = members & set(fit.used.tolist()) - {*against}
            apart = members - agree
            if against and pose_checks.is_part(body.frame.coils.offsets, apart, agree):
                words = next(iter(against.values()))
                why = f'{len(apart)} of {len(members)} coils contradict the others: {words}'
                self._split[estimate.name] = apart, agree, why
            elif all(agree & part for part in self._split.get(estimate.name, ())[:2]):
                self._split.pop(estimate.name, None)
            if estimate.name in self._split:
                why = self._split[estimate.name][2]
                against = dict.fromkeys(members, why)
                estimate = replace(estimate, state=states.INCONSISTENT, reason=why)
        for i, why in against.items():
            found[rows[i]] = replace(found[rows[i]], state=states.INCONSISTENT, reason=why)
        return estimate

    def _add_to_record(self, stamp_ns: int, coils: Estimates) -> None:
        refused = [math.sqrt(e.chi2) for e in coils if e.state in CONTRADICTS]
        total = len(refused) + sum(e.state == states.OK for e in coils)
        typical = sorted(refused)[len(refused) // 2] if refused else math.nan
        self.record.add(stamp_ns, len(refused), total, typical)

    def _judged_in_time(self, estimate: PoseEstimate, settings: TrackerSettings) -> PoseEstimate:
        """The estimate, or why it is not given out: its own past, or that of the whole model."""
        place = None
        if estimate.state in (states.OK, states.INCONSISTENT):
            place = _place_of(estimate)
        continuity = self._continuity.get(estimate.name)
        if continuity is None:
            continuity = self._continuity[estimate.name] = Continuity()
        refused = estimate.state in CONTRADICTS
        reason = continuity.judge(estimate.stamp_ns, place, refused, settings.tools)
        if place is not None and not refused and self.record.is_doubtful:
            return replace(estimate, state=states.MODEL_DOUBTFUL, reason=self.record.reason)
        if reason:
            return replace(estimate, state=states.UNCONFIRMED, reason=reason)
        return estimate

    def _take_alternating(self, found: Estimates, members: list[int]) -> None:
        """Withhold, in ``found``, a body and its coils while these jump between two worlds: which
        of them is true, no frame says.
        """
        said = (self._continuity[found[row].name].alternates for row in members)
        if why := next((words for words in said if words), ''):
            for row in members:
                if found[row].state == states.OK:
                    found[row] = replace(found[row], state=states.UNCONFIRMED, reason=why)

    def _add_stamp_error(self, estimate: PoseEstimate, settings: TrackerSettings) -> None:
        """Add to the estimate's covariance what the stamp's error makes of its motion."""
        last = self._last.get(estimate.name)
        self._last[estimate.name] = estimate
        if last is None or settings.stamp_sigma_s == 0.0:
            return
        seconds = (estimate.stamp_ns - last.stamp_ns) * NANO
        if not 0.0 < seconds <= settings.warm_age_s:
            return
        before, after = last.rotation, estimate.rotation
        if before is None or after is None:
            before, after = last.axis[:, None], estimate.axis[:, None]
        add_motion(
            estimate.covariance, last.position, estimate.position, before, after,
            settings.stamp_sigma_s / seconds,
        )  # fmt: skip


def _place_of(estimate: PoseEstimate) -> Place:
    """Return the place of an estimate, with what turns about it; no roll of a single coil does."""
    known = estimate.covariance.tolist()
    tilt = known[3][3] + known[4][4] + known[5][5]
    if estimate.rotation is None:
        arm, turns = ARM_M, estimate.axis.tolist()
        for x, row in zip(turns, known[3:], strict=True):
            tilt -= x * (row[3] * turns[0] + row[4] * turns[1] + row[5] * turns[2])
    else:
        arm, turns = (
            ARM_M / math.sqrt(2.0),
            estimate.rotation.ravel().tolist(),
        )  # two of three turn
    where = [*estimate.position.tolist(), *[arm * one for one in turns]]
    square = known[0][0] + known[1][1] + known[2][2] + ARM_M**2 * max(tilt, 0.0)
    return Place(estimate.stamp_ns, where, math.sqrt(square))


def _add_gain_error(
    found: Estimates, coils: Sequence[CoilResult], rows: Iterable[int], gain: float
) -> None:
    """Add to some coils' covariances, in ``found``, what a common gain does, see `add_gain`."""
    for row in rows:
        one, solution = found[row], coils[row].solution
        if solution is not None and one.state == states.OK:
            misfit = max(one.chi2 - 1.0, 0.0) * (solution.residual.size - UNKNOWNS)
            add_gain(one.covariance, solution.normal, solution.axis, gain, misfit)


def _take_strangers(
    found: Estimates, rows: Integers, coils: BodyCoils, settings: TrackerSettings
) -> None:
    """Withhold, in ``found``, the poses of coils of a body without a pose that cannot be of it."""
    good = np.array([i for i, row in enumerate(rows) if found[row].state == states.OK], np.int64)
    if len(good) < 2:
        return
    coils, ones = coils.subset(good), [found[row] for row in rows[good].tolist()]
    places = [_place_of(one) for one in ones]
    sigmas = np.array([one.sigma_position_m for one in ones])
    off = pose_checks.strangers(coils.offsets, coils.axes, places, sigmas, settings.tools)
    for i in np.flatnonzero(off).tolist():
        why = f'{1e3 * off[i]:.2g} mm off its distance from the other coils of the body'
        found[int(rows[good[i]])] = replace(ones[i], state=states.INCONSISTENT, reason=why)


def _contradictions(
    body: BodyResult, members: list[int], settings: TrackerSettings
) -> dict[int, str]:
    """Return why some coils of a body, ``members`` by their numbers in it, contradict its pose."""
    estimate, fit, tools = body.estimate, body.fit, settings.tools
    assert fit is not None
    rows, ended = body.frame.rows[members], body.frame.ended
    coils, used = body.frame.coils.subset(np.array(members)), set(fit.used.tolist())
    away = pose_checks.distances(
        estimate.position, fit.solution.rotation, estimate.covariance, coils.offsets, coils.axes,
        ended.position[rows], ended.axis[rows], ended.covariance[rows],
        np.array([i in used for i in members]),
        np.array([tools.tool_coil_position_m, tools.tool_coil_axis_rad, tools.tool_coil_gain]),
    )  # fmt: skip
    return {
        i: pose_checks.reason(*one)
        for i, (*one, is_against) in zip(members, away.T.tolist(), strict=True)
        if is_against
    }
