"""Evaluates a recorded session: tracks its poses, and compares them with the optical ones.

The stages are `prepare`, `track` and `compare`; each can be called alone, and `track_session` runs
all of them. `evaluation_document` and `pose_table` write their results.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from anser_ros.errors import ParameterError
from anser_ros.field.model import FieldModel
from anser_ros.field.symmetry import symmetry_axis
from anser_ros.sessions.baseline import check_place
from anser_ros.sessions.follower import FrameModels, ModelFollower, RefitSummary
from anser_ros.sessions.pose_errors import PoseSeries, pose_series
from anser_ros.sessions.prepared import PreparedSession, prepare, with_truth
from anser_ros.sessions.session import Session
from anser_ros.sessions.tracked_session import (
    SOURCES,
    Progress,
    TrackedSession,
    in_phase_model,
    track,
)
from anser_ros.tracking.estimate import PoseEstimate, TrackerSettings
from anser_ros.tracking.source_track import seen_from


@dataclass(frozen=True)
class Evaluation:
    """Holds tracked poses and their errors, by the names of sensors, and of bodies in six degrees.

    The seconds are the mean wall time of a frame; ``refit`` is what the refit did, None where the
    model did not follow the references, and ``further`` what else was tracked (`FURTHER`), by kind
    and name.
    """

    sensors: dict[str, PoseSeries]
    bodies: dict[str, PoseSeries]
    seconds_per_frame: float
    refit: RefitSummary | None = None
    further: dict[str, dict[str, PoseSeries]] = field(default_factory=dict)

    @property
    def groups(self) -> dict[str, dict[str, PoseSeries]]:
        """Return all series by kind, sensors and bodies first."""
        return {'sensors': self.sensors, 'bodies': self.bodies, **self.further}


def track_session(
    session: Session,
    model: FieldModel,
    settings: TrackerSettings | None = None,
    baseline: Session | None = None,
    refit: bool = False,
    in_phase: bool = False,
    progress: Progress | None = None,
    witnesses: bool = False,
    models: Callable[[PreparedSession], FrameModels] | None = None,
) -> Evaluation:
    """Track every tool sensor and body of a session at every frame, and compare with the optics.

    A baseline is a distortion-free recording of the same board. With ``refit`` the model follows
    the references as it does live, with witnesses also what the coils of rigid tools contradict;
    ``models`` gives each frame's model in another way, instead of a refit. In phase, only these
    fluxes and moments are used (the article's way). Progress gets the finished share, 0 to 1.

    Raises
    ------
    BagError
        When the session has no tool fluxes, or a refit lacks references or a baseline.
    ParameterError
        When such models are to be used beside a refit, or with one phase of the fluxes.
    ModelFileError
        When the model's emitters are not the session's, or the session's references locate the
        board elsewhere. With the gate switched off the latter is not checked.
    """
    if models is not None and (refit or in_phase):
        raise ParameterError(
            "models of their own are used without a refit, with both of the fluxes' phases"
        )
    if settings is None or settings.has_gate:
        check_place(model, session)
    used = in_phase_model(model) if in_phase else model
    prepared = prepare(session, used, baseline if refit else None)
    follower = None if models is None else models(prepared)
    if refit:
        follower = ModelFollower(prepared, witnesses)
    tracked = track(prepared, settings, follower, in_phase, progress)
    return compare(prepared, tracked)


def compare(prepared: PreparedSession, tracked: TrackedSession) -> Evaluation:
    """Compare tracked poses with the optical ones, as the model's corrections place these."""
    sensors: dict[str, PoseSeries] = {}
    bodies: dict[str, PoseSeries] = {}
    for tool in prepared.session.tools:
        true = with_truth(tool, prepared.correction)
        position = np.where(true.has_pose[:, None], true.position, np.nan)
        centres, axes = true.sensors.placed(position, true.rotation)
        for column, name in enumerate(true.sensors.name):
            given = tracked.estimates.get(name, ())
            sensors[name] = pose_series(name, given, centres[:, column], axes[:, column])
        if tool.body in tracked.estimates:
            given = tracked.estimates[tool.body]
            bodies[tool.body] = pose_series(tool.body, given, position, true.rotation)
    further = {
        kind: series
        for kind, estimates in tracked.further.items()
        if (series := FURTHER[kind](prepared, estimates))
    }
    return Evaluation(sensors, bodies, tracked.seconds_per_frame, tracked.refit, further)


def _sources(
    prepared: PreparedSession, estimates: Mapping[str, Sequence[PoseEstimate]]
) -> dict[str, PoseSeries]:
    """Compare where bodies saw the source with where the optical poses say it was."""
    model, out = prepared.model, {}
    axis = symmetry_axis(model.positions, model.directions, model.moments)
    for tool in prepared.session.tools:
        if axis is None or tool.body not in estimates:
            continue
        true = with_truth(tool, prepared.correction)
        position = np.where(true.has_pose[:, None], true.position, np.nan)
        place, direction = seen_from(axis, position, true.rotation)
        name = f'{tool.body}/source'
        out[tool.body] = pose_series(name, estimates[tool.body], place, direction)
    return out


FURTHER = {SOURCES: _sources}
"""What compares tracked things other than sensors and bodies with the optical poses, by kind."""
