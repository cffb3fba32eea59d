"""Evaluates a recorded session: tracks it as live, compares with the optical poses, and writes
tables.
"""

import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import isfinite
from operator import itemgetter
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros import extensions
from anser_ros.arrays import Array, Booleans
from anser_ros.chain.chain import Chain
from anser_ros.chain.tracking_half import TrackingHalf
from anser_ros.errors import BagError, ParameterError
from anser_ros.field.model import FieldModel
from anser_ros.physics.rotations import axis_angles, rotation_angles
from anser_ros.pose_states import OK
from anser_ros.sessions.baseline import check_place
from anser_ros.sessions.disagreement import Disagreement, disagreement
from anser_ros.sessions.follower import ModelFollower, RefitSummary
from anser_ros.sessions.prepared import PreparedSession, prepare, with_truth
from anser_ros.sessions.session import Session, frames_of, settings_for
from anser_ros.tracking.estimate import PoseEstimate, TrackerSettings
from anser_ros.tracking.tracker import Observer, Tracker

Progress = Callable[[float], None]


class SessionObserver(Observer, Protocol):
    """Follows what an application tracks besides coils and bodies, and compares it afterwards."""

    KIND: str  # of what is tracked, as documents and tables name it
    found: dict[str, PoseEstimate]  # by body, in the last frame

    @staticmethod
    def compare(
        prepared: PreparedSession, estimates: Mapping[str, Sequence[PoseEstimate]]
    ) -> 'dict[str, PoseSeries]':
        """Compare the estimates of all frames, by body, with the optical poses."""


def in_phase_model(model: FieldModel) -> FieldModel:
    """Return the model without its quadrature part, as the article's own method uses it."""
    modes = None if model.modes is None else model.modes.real.astype(complex)
    return replace(model, moments=model.moments.real.astype(complex), modes=modes)


def track(
    prepared: PreparedSession,
    settings: TrackerSettings | None = None,
    follower: ModelFollower | None = None,
    in_phase: bool = False,
    progress: Progress | None = None,
) -> 'Evaluation':
    """Track every tool sensor and body of a session at every frame, and compare with the optics.

    The optical pose is never used before: neither as a start value nor to refuse a pose. The noise
    is that of the session's setup. With ``in_phase``, for an `in_phase_model`, only the fluxes'
    in-phase parts are used. Raises `BagError` when the session has no tool fluxes.
    """
    if not prepared.session.tools:
        raise BagError(
            f'{prepared.session.path}: the session has no tool fluxes to track, on a topic that '
            f'ends with /tool/flux'
        )
    observers: list[SessionObserver] = [make() for make in extensions.loaded('OBSERVERS')]
    settings = settings or TrackerSettings()
    settings = replace(settings, volume=settings.volume or prepared.volume)
    settings = settings_for(prepared.session.setup, settings, prepared.model)
    # A drift's recorded course is used if nothing follows it.
    settings = replace(settings, recorded_drift=prepared.recorded_drift and follower is None)
    tracker = Tracker(prepared.model, prepared.sensors, settings, observers)
    estimates: dict[str, list[PoseEstimate]] = {}
    further: dict[str, dict[str, list[PoseEstimate]]] = {one.KIND: {} for one in observers}
    half = TrackingHalf(tracker, prepared.session.setup.refit.references_age_s)
    chain = Chain(follower, half)
    frames = list(frames_of(prepared.session))
    for count, frame in enumerate(frames, start=1):
        for estimate in chain.step(frame.in_phase() if in_phase else frame):
            estimates.setdefault(estimate.name, []).append(estimate)
        if frame.tools is not None:
            for observer in observers:
                for body, estimate in observer.found.items():
                    further[observer.KIND].setdefault(body, []).append(estimate)
        if progress is not None:
            progress(count / len(frames))
    sensors, bodies, apart = _compared(prepared, estimates)
    found_by = {one.KIND: one for one in observers if further[one.KIND]}
    others = {kind: one.compare(prepared, further[kind]) for kind, one in found_by.items()}
    others = {kind: series for kind, series in others.items() if series}
    summary = None if follower is None else follower.summary
    return Evaluation(sensors, bodies, summary, others, half.tracker.emitter_strengths, apart)


@dataclass(frozen=True)
class PoseSeries:
    """Holds the estimates of one sensor or body, one a frame, and their errors where known."""

    name: str
    estimates: tuple[PoseEstimate, ...]
    position_error: Array
    orientation_error: Array

    @property
    def ok(self) -> Booleans:
        """Return the mask (F,) of the frames in which a pose was given."""
        return np.array([estimate.state == OK for estimate in self.estimates], dtype=bool)

    def followed_by(self, later: 'PoseSeries') -> 'PoseSeries':
        """Return the series with the frames of another after its own."""
        place = np.concatenate([self.position_error, later.position_error])
        turn = np.concatenate([self.orientation_error, later.orientation_error])
        return PoseSeries(self.name, self.estimates + later.estimates, place, turn)


def pose_series(
    name: str, estimates: Sequence[PoseEstimate], position: Array, orientation: Array
) -> PoseSeries:
    """Compare F poses of a sensor or body with where it truly was, m, frame fg; NaN if unknown."""
    of_body = orientation.ndim == 3
    distance, angle = np.full(len(estimates), np.nan), np.full(len(estimates), np.nan)
    for i, estimate in enumerate(estimates):
        if estimate.state != OK or (of_body and estimate.rotation is None):
            continue
        distance[i] = np.linalg.norm(estimate.position - position[i])
        if of_body:
            assert estimate.rotation is not None
            angle[i] = rotation_angles(estimate.rotation.T @ orientation[i])
        else:
            angle[i] = axis_angles(estimate.axis, orientation[i])
    return PoseSeries(name, tuple(estimates), distance, angle)


def metrics(series: PoseSeries) -> dict[str, Any]:
    """Return the figures of one sensor or body as the evaluation document has them.

    RMSE, mean, 50th and 95th percentile (equation 7 of the article) of position and orientation
    are None where nothing could be compared.
    """
    result: dict[str, Any] = {
        'n': int(np.isfinite(series.position_error).sum()),
        'tracked_fraction': float(series.ok.mean()) if series.ok.size else 0.0,
    }
    for key, unit, errors in (
        ('position', 'm', series.position_error),
        ('orientation', 'rad', series.orientation_error),
    ):
        result |= error_statistics(key, unit, errors[np.isfinite(errors)])
    return result


def error_statistics(key: str, unit: str, errors: Array) -> dict[str, float | None]:
    """Return RMSE, mean and percentiles of errors by ``KEY_rmse_UNIT``, ...; None of no error."""
    names = [f'{key}_{name}_{unit}' for name in ('rmse', 'me', 'prc50', 'prc95')]
    if not errors.size:
        return dict.fromkeys(names)
    values = (
        np.sqrt(np.mean(errors**2)), errors.mean(), np.percentile(errors, 50),
        np.percentile(errors, 95),
    )  # fmt: skip
    return dict(zip(names, map(float, values), strict=True))


@dataclass(frozen=True)
class Evaluation:
    """Holds tracked poses and their errors, by the names of sensors, and of bodies in six degrees.

    ``refit`` is what the refit did, None where the model did not follow the references, and
    ``further`` what else was tracked, by kind and name.
    """

    sensors: dict[str, PoseSeries]
    bodies: dict[str, PoseSeries]
    refit: RefitSummary | None = None
    further: dict[str, dict[str, PoseSeries]] = field(default_factory=dict)
    # How emitters differed from the model at the end, in words, where they did
    strengths: str = ''
    disagreements: tuple[Disagreement, ...] = ()  # of bodies with the optical poses as a whole

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
) -> Evaluation:
    """Track every tool sensor and body of a session at every frame, and compare with the optics.

    A baseline is a distortion-free recording of the same board. With ``refit`` the model follows
    the references as it does live, with witnesses also what the coils of rigid tools contradict.
    In phase, only these fluxes and moments are used (the article's way). Progress gets the
    finished share, 0 to 1. Raises `BagError` when the session has no tool fluxes, or a refit lacks
    references or a baseline; `ParameterError` for a baseline without a refit; `ModelFileError`
    when the model's emitters are not the session's, or its references locate the board elsewhere,
    which is not checked with the gate switched off. Parts of several mountings are tracked each by
    itself, but with a refit.
    """
    if baseline is not None and not refit:
        raise ParameterError('a baseline is of a refit, and has no effect without one')
    if settings is None or settings.has_gate:
        check_place(model, session)
    used = in_phase_model(model) if in_phase else model
    found = list[Evaluation]()
    for part in (session,) if refit else session.mountings():
        prepared = prepare(part, used, baseline)
        follower = ModelFollower(prepared, witnesses) if refit else None
        found.append(track(prepared, settings, follower, in_phase, progress))
    return _one_after_another(found)


def _one_after_another(found: Sequence[Evaluation]) -> Evaluation:
    """The evaluations of a session's parts as one."""
    groups: dict[str, dict[str, PoseSeries]] = {}
    for kind, group in (pair for one in found for pair in one.groups.items()):
        whole = groups.setdefault(kind, {})
        for name, part in group.items():
            whole[name] = whole[name].followed_by(part) if name in whole else part
    apart = tuple(each for one in found for each in one.disagreements)
    bare, strengths = (groups.pop('sensors'), groups.pop('bodies')), found[-1].strengths
    return Evaluation(*bare, found[0].refit, groups, strengths, apart)


def _compared(
    prepared: PreparedSession, estimates: Mapping[str, Sequence[PoseEstimate]]
) -> tuple[dict[str, PoseSeries], dict[str, PoseSeries], tuple[Disagreement, ...]]:
    """Compare sensors and bodies with the optical poses, as the model's corrections place them."""
    sensors: dict[str, PoseSeries] = {}
    bodies: dict[str, PoseSeries] = {}
    apart, accuracy = tuple[Disagreement, ...](), prepared.session.setup.accuracy
    for tool in prepared.session.tools:
        true = with_truth(tool, prepared.correction)
        position = np.where(true.has_pose[:, None], true.position, np.nan)
        centres, axes = true.sensors.placed(position, true.rotation)
        for column, name in enumerate(true.sensors.name):
            given = estimates.get(name, ())
            sensors[name] = pose_series(name, given, centres[:, column], axes[:, column])
        if tool.body in estimates:
            given = estimates[tool.body]
            bodies[tool.body] = pose_series(tool.body, given, position, true.rotation)
            where = f'{prepared.session.path}: {tool.body}'
            apart += disagreement(where, given, (position, true.rotation), accuracy)
    return sensors, bodies, apart


SCHEMA = 'anser_evaluation/1'
"""Name of the document's layout, which stands in every such document."""


def to_document(evaluation: Evaluation) -> dict[str, Any]:
    """Return the figures of every sensor and body, and of a refit, as plain data."""
    document: dict[str, Any] = {'schema': SCHEMA}
    for kind, group in evaluation.groups.items():
        document[kind] = {name: metrics(series) for name, series in group.items()}
    if evaluation.refit is not None:
        document['refit'] = {
            'states': dict(evaluation.refit.states),
            'left_out': dict(evaluation.refit.left_out),
        }
    return document


POSE_COLUMNS = (
    'stamp_ns', 'sensor', 'x_m', 'y_m', 'z_m', 'ax', 'ay', 'az', 'sigma_position_m', 'residual_t',
    'status',
)  # fmt: skip
"""Columns of the sensors' table; a coil's pose is its centre and its sensitive axis."""
BODY_COLUMNS = (
    'stamp_ns', 'body', 'x_m', 'y_m', 'z_m', 'qx', 'qy', 'qz', 'qw', 'sigma_position_m',
    'residual_t', 'status',
)  # fmt: skip
"""Columns of the bodies' table; the orientation is a quaternion."""
POSES_FILE, BODIES_FILE, ERRORS_FILE = 'poses.csv', 'bodies.csv', 'errors.csv'
ERROR_COLUMNS = ('stamp_ns', 'name', 'position_error_m', 'orientation_error_rad')
"""Columns of the table of errors, of coils and bodies."""


def write_tables(folder: Path, evaluation: Evaluation) -> list[Path]:
    """Write the tables of poses, sensors' by stamp, and of errors into a folder; the files."""
    of_sensors = _pose_rows(evaluation.sensors, POSE_COLUMNS)
    tables = {
        POSES_FILE: (POSE_COLUMNS, sorted(of_sensors, key=itemgetter(0))),
        BODIES_FILE: (BODY_COLUMNS, _pose_rows(evaluation.bodies, BODY_COLUMNS)),
        ERRORS_FILE: (ERROR_COLUMNS, _error_rows(evaluation)),
        **{
            f'{kind}.csv': (POSE_COLUMNS, _pose_rows(group, POSE_COLUMNS))
            for kind, group in evaluation.further.items()
        },
    }
    for name, (columns, rows) in tables.items():
        with (folder / name).open('w', newline='', encoding='utf-8') as stream:
            writer = csv.writer(stream)
            writer.writerow(columns)
            writer.writerows(rows)
    return [folder / name for name in tables]


def _error_rows(evaluation: Evaluation) -> list[list[Any]]:
    """The error of every pose that has an optical one."""
    return [
        [estimate.stamp_ns, series.name, f'{place:.9g}', f'{turn:.9g}']
        for group in evaluation.groups.values()
        for series in group.values()
        for estimate, place, turn in zip(
            series.estimates, series.position_error.tolist(), series.orientation_error.tolist(),
            strict=True,
        )
        if isfinite(place)
    ]  # fmt: skip


def _pose_rows(group: Mapping[str, PoseSeries], columns: Sequence[str]) -> list[list[Any]]:
    """Rows with an axis, or, in the columns of bodies, a quaternion; empty cells for no pose."""
    of_body, rows = columns is BODY_COLUMNS, []
    for series in group.values():
        for pose in series.estimates:
            cells = [''] * (len(columns) - 3)
            if pose.state == OK and not (of_body and pose.rotation is None):
                turn = Rotation.from_matrix(pose.rotation).as_quat() if of_body else pose.axis
                values = [*pose.position, *turn, pose.sigma_position_m, pose.residual_t]
                cells = [f'{float(value):.9g}' for value in values]
            rows.append([pose.stamp_ns, series.name, *cells, pose.state])
    return rows
