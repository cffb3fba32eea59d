"""Evaluates a recorded session: tracks its poses, and compares them with the optical ones.

The stages are `prepare`, `track` and `compare`; each can be called alone, and `track_session` runs
all of them. `evaluation_document` and `pose_table` write their results.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from anser_ros.errors import ParameterError
from anser_ros.field.model import FieldModel
from anser_ros.field.symmetry import symmetry_axis
from anser_ros.sessions.baseline import check_place
from anser_ros.sessions.follower import FrameModels, ModelFollower, RefitSummary
from anser_ros.sessions.pose_errors import PoseSeries, body_series, sensor_series
from anser_ros.sessions.prepared import PreparedSession, prepare, with_truth
from anser_ros.sessions.session import Session
from anser_ros.sessions.tracked_session import Progress, TrackedSession, in_phase_model, track
from anser_ros.tracking.estimate import TrackerSettings
from anser_ros.tracking.source_track import seen_from


@dataclass(frozen=True)
class Evaluation:
    """Holds tracked poses and their errors.

    Attributes
    ----------
    sensors, bodies : dict of str to PoseSeries
        Poses and errors of every tool sensor, and of every body whose six degrees of freedom were
        tracked, by name.
    seconds_per_frame : float
        Mean wall time that a frame took.
    refit : RefitSummary or None
        What the refit did; None where the model did not follow the references.
    sources : dict of str to PoseSeries
        Of every body, where the field is the same all around an axis: place and axis of the source
        in the body's frame, and their errors.
    """

    sensors: dict[str, PoseSeries]
    bodies: dict[str, PoseSeries]
    seconds_per_frame: float
    refit: RefitSummary | None = None
    sources: dict[str, PoseSeries] = field(default_factory=dict)


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

    Parameters
    ----------
    session : Session
        What was recorded.
    model : FieldModel
        Of the session's emitters.
    settings : TrackerSettings, optional
        What the tracker may assume.
    baseline : Session, optional
        Distortion-free recording of the same board, whose reference readings are the clean ones.
    refit : bool
        Whether the model follows the session's reference sensors, as the node does live.
    in_phase : bool
        Whether only in-phase fluxes and moments are used (the article's way).
    progress : callable, optional
        Called with the finished share, 0 to 1.
    witnesses : bool
        Whether the refit also uses what the coils of rigid tools contradict.
    models : callable, optional
        Gives what another way gives each frame's model by, instead of a refit.

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
            sensors[name] = sensor_series(name, given, centres[:, column], axes[:, column])
        if tool.body in tracked.estimates:
            given = tracked.estimates[tool.body]
            bodies[tool.body] = body_series(tool.body, given, position, true.rotation)
    sources = _sources(prepared, tracked)
    return Evaluation(sensors, bodies, tracked.seconds_per_frame, tracked.refit, sources)


def _sources(prepared: PreparedSession, tracked: TrackedSession) -> dict[str, PoseSeries]:
    """Compare where bodies saw the source with where the optical poses say it was."""
    model, out = prepared.model, {}
    axis = symmetry_axis(model.positions, model.directions, model.moments)
    for tool in prepared.session.tools:
        if axis is None or tool.body not in tracked.sources:
            continue
        true = with_truth(tool, prepared.correction)
        position = np.where(true.has_pose[:, None], true.position, np.nan)
        place, direction = seen_from(axis, position, true.rotation)
        name = f'{tool.body}/source'
        out[tool.body] = sensor_series(name, tracked.sources[tool.body], place, direction)
    return out
