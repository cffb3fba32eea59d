"""Judges a frame's poses by each other and by the frames before, before any is given out.

Each pose has passed its own frame's gate. Here a coil has to agree with its body, a pose with its
course, and the model with most of the readings; see `anser_ros.integrity`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros import pose_states as states
from anser_ros.integrity import pose_checks
from anser_ros.integrity.model_trust import ModelRecord
from anser_ros.integrity.pose_checks import Continuity, MotionBounds, Place, SurveyErrors
from anser_ros.stamps import NANO
from anser_ros.tracking.body_track import BodyResult
from anser_ros.tracking.coil_track import CoilResult
from anser_ros.tracking.estimate import PoseEstimate, TrackerSettings
from anser_ros.tracking.rigid import BodyCoils
from anser_ros.tracking.solve import add_motion

Array = NDArray[np.float64]
Estimates = list[PoseEstimate]

CONTRADICTS = (states.RESIDUAL, states.INCONSISTENT)
"""States of a pose that the model, or the body, does not explain although there are signals."""


@dataclass(frozen=True)
class RigidBody:
    """Holds a body's coils: their rows among the sensors, their places, and what was found."""

    rows: NDArray[np.int64]
    coils: BodyCoils
    result: BodyResult


class Judgement:
    """Holds what the checks remember of a tracker's sensors and bodies."""

    def __init__(self) -> None:
        self._continuity: dict[str, Continuity] = {}
        self._last: dict[str, PoseEstimate] = {}
        self.record = ModelRecord()

    def forget(self) -> None:
        """Forget all frames that were judged so far."""
        self._continuity.clear()
        self._last.clear()
        self.record.forget()

    def judged(
        self,
        stamp_ns: int,
        coils: Sequence[CoilResult],
        bodies: Sequence[RigidBody],
        settings: TrackerSettings,
    ) -> Estimates:
        """Return the estimates of a frame, sensors first, with what the checks say of them."""
        found = [result.estimate for result in coils]
        if settings.has_gate:
            for body in bodies:
                _judge_coils(found, body, settings)
        found += [body.result.estimate for body in bodies]
        if settings.has_gate:
            self._add_to_record(stamp_ns, found[: len(coils)])
            found = [self._judged_in_time(estimate, settings) for estimate in found]
        return [self._with_stamp_error(e, settings) if e.state == states.OK else e for e in found]

    def _add_to_record(self, stamp_ns: int, coils: Estimates) -> None:
        refused = [math.sqrt(e.chi2) for e in coils if e.state in CONTRADICTS]
        total = len(refused) + sum(e.state == states.OK for e in coils)
        typical = sorted(refused)[len(refused) // 2] if refused else math.nan
        self.record.add(stamp_ns, len(refused), total, typical)

    def _judged_in_time(self, estimate: PoseEstimate, settings: TrackerSettings) -> PoseEstimate:
        """The estimate, or why it is not given out: its own past, or that of the whole model."""
        place = None
        if estimate.state == states.OK:
            where = estimate.position.tolist()
            place = Place(estimate.stamp_ns, where, estimate.sigma_position_m)
        continuity = self._continuity.setdefault(estimate.name, Continuity())
        tools = settings.tools
        bounds = MotionBounds(tools.max_speed_m_s, tools.max_acceleration_m_s2)
        refused = estimate.state in CONTRADICTS
        reason = continuity.judge(estimate.stamp_ns, place, refused, bounds)
        if place is not None and self.record.is_doubtful:
            return replace(estimate, state=states.MODEL_DOUBTFUL, reason=self.record.reason)
        if reason:
            return replace(estimate, state=states.UNCONFIRMED, reason=reason)
        return estimate

    def _with_stamp_error(self, estimate: PoseEstimate, settings: TrackerSettings) -> PoseEstimate:
        """The estimate with what the stamp's error makes of its motion in the covariance."""
        last = self._last.get(estimate.name)
        self._last[estimate.name] = estimate
        if last is None or settings.stamp_sigma_s == 0.0:
            return estimate
        seconds = (estimate.stamp_ns - last.stamp_ns) * NANO
        if not 0.0 < seconds <= settings.warm_age_s:
            return estimate
        before, after = last.rotation, estimate.rotation
        if before is None or after is None:
            before, after = last.axis[:, None], estimate.axis[:, None]
        # The estimate's own matrix is not used elsewhere.
        sigma = add_motion(
            estimate.covariance, last.position, estimate.position, before, after,
            settings.stamp_sigma_s / seconds,
        )  # fmt: skip
        return estimate.with_sigma(sigma)


def _judge_coils(found: Estimates, body: RigidBody, settings: TrackerSettings) -> None:
    """Withhold, in ``found``, the poses of coils that contradict their body.

    If all coils together fit the model in no pose, even without those that disagree most, it is
    unknown which of them are right: a smooth distortion can look like a pose to each.
    """
    estimate, fit = body.result.estimate, body.result.fit
    members = [i for i, row in enumerate(body.rows.tolist()) if found[row].state == states.OK]
    if fit is not None and estimate.state == states.RESIDUAL:
        reason = f"the body's coils fit no pose together: {estimate.reason}"
        for row in body.rows[members].tolist():
            found[row] = replace(found[row], state=states.INCONSISTENT, reason=reason)
        return
    if fit is None or estimate.state not in (states.OK, states.OUTSIDE_VOLUME) or not members:
        return
    rows = body.rows[members].tolist()
    own = [found[row] for row in rows]
    used = set(fit.used.tolist())
    coils = body.coils.subset(np.array(members))
    tools = settings.tools
    away = pose_checks.distances(
        (estimate.position, fit.solution.rotation, estimate.covariance),
        coils.offsets, coils.axes,
        (
            np.array([e.position for e in own]), np.array([e.axis for e in own]),
            np.array([e.covariance for e in own]),
        ),
        np.array([i in used for i in members]),
        SurveyErrors(tools.tool_coil_position_m, tools.tool_coil_axis_rad, tools.tool_coil_gain),
    )  # fmt: skip
    for row, one, (distance, away_m, angle) in zip(rows, own, away.T.tolist(), strict=True):
        allowed_m = pose_checks.allowed_m(one.sigma_position_m, tools.tool_coil_position_m)
        if not (distance <= pose_checks.GATE and away_m <= allowed_m):
            reason = pose_checks.reason(distance, away_m, angle)
            found[row] = replace(one, state=states.INCONSISTENT, reason=reason)
