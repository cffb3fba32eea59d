"""Tracks a recorded session as the live nodes would, and compares the poses with the optical ones.

The optical pose is never used to track: no start value, no gate. Error metrics are those of the
article's equation (7): RMSE, mean error, and the 50th and 95th percentile.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.correction import DRIFTS, Correction
from anser_ros.errors import BagError, FitError
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import FieldModel
from anser_ros.physics.sensor import SensorTable
from anser_ros.refit.baseline import check_enough
from anser_ros.refit.change import Pace
from anser_ros.refit.live_refit import LiveRefit, RefitResult, RefitSettings
from anser_ros.sessions.patches import PatchFollower
from anser_ros.sessions.session import LONGEST_OPTICAL_GAP_S, NANO, Session, noise_of
from anser_ros.sessions.starting_model import check_fits, drawing_of
from anser_ros.sessions.volume import pose_volume, stated_volume
from anser_ros.tracking.tracker import PoseEstimate, Tracker, TrackerSettings

Array = NDArray[np.float64]
Progress = Callable[[float], None]

SAME_PLACE_M = 0.005
"""Reference sensors of one setup may be surveyed anew, but are not elsewhere."""
FOUND_ON = 'session_start_ns'
"""Evidence of a drift: the first stamp of the session on which it took its course."""


@dataclass(frozen=True)
class PoseSeries:
    """Every estimate of one sensor or body, with its error where the truth is known.

    ``position_error`` (m) and ``orientation_error`` (rad) are NaN where either is missing.
    """

    name: str
    estimates: tuple[PoseEstimate, ...]
    position_error: Array
    orientation_error: Array

    @property
    def ok(self) -> NDArray[np.bool_]:
        """Frames in which a pose was given."""
        return np.array([estimate.state == 'ok' for estimate in self.estimates], dtype=bool)


@dataclass
class RefitSummary:
    """In how many frames the refit was in which state, and left out which reference sensor."""

    states: Counter[str] = field(default_factory=Counter)
    left_out: Counter[str] = field(default_factory=Counter)

    def add(self, result: RefitResult) -> None:
        """Count one frame's result."""
        self.states[result.state] += 1
        self.left_out.update(result.left_out)


@dataclass(frozen=True)
class Evaluation:
    """What tracking gave: a series a sensor and a body, and the wall time a frame took."""

    sensors: dict[str, PoseSeries]
    bodies: dict[str, PoseSeries]
    seconds_per_frame: float
    refit: RefitSummary | None = None


def baseline_flux(baseline: Session, sensors: SensorTable) -> NDArray[np.complex128]:
    """Mean clean-room reading of each reference sensor, shape (S, K), T; NaN where it has none.

    Raises
    ------
    BagError
        When the baseline has no reference fluxes, or its references are not the session's.
    """
    reference = baseline.reference
    if reference is None:
        raise BagError(f'{baseline.path}: the baseline has no reference fluxes')
    mean = np.full((len(sensors), reference.flux.shape[2]), np.nan, dtype=complex)
    for row, (channel, name) in enumerate(
        zip(sensors.channel.tolist(), sensors.name, strict=True)
    ):
        found = np.flatnonzero(reference.sensors.channel == channel)
        if found.size == 0 or reference.sensors.name[found[0]] != name:
            raise BagError(f'{baseline.path}: the baseline lacks the reference sensor {name}')
        apart = np.linalg.norm(reference.sensors.position[found[0]] - sensors.position[row])
        if apart > SAME_PLACE_M:
            raise BagError(
                f'{baseline.path}: in the baseline the reference sensor {name} is '
                f'{1e3 * apart:.0f} mm from where the session has it; is it of another setup?'
            )
        good = reference.valid[:, found[0]]
        if good.any():
            mean[row] = reference.flux[good, found[0]].mean(axis=0)
    return mean


def in_phase_model(model: FieldModel) -> FieldModel:
    """The model without its quadrature part, as the article's own method uses it."""
    modes = None if model.modes is None else model.modes.real.astype(complex)
    return replace(model, moments=model.moments.real.astype(complex), modes=modes)


def _frames(
    session: Session,
) -> Iterator[tuple[float, list[tuple[Measurements, int]], int | None]]:
    """Time, tool frames and reference frame of every stamp, in order."""
    table: dict[float, tuple[list[tuple[Measurements, int]], list[int]]] = {}
    for tool in session.tools:
        for frame, stamp in enumerate(tool.time.tolist()):
            table.setdefault(stamp, ([], []))[0].append((tool, frame))
    if session.reference is not None:
        for frame, stamp in enumerate(session.reference.time.tolist()):
            table.setdefault(stamp, ([], []))[1].append(frame)
    for stamp in sorted(table):
        tools, references = table[stamp]
        yield stamp, tools, references[0] if references else None


def track_session(
    session: Session,
    model: FieldModel,
    settings: TrackerSettings | None = None,
    baseline: Session | None = None,
    refit: bool = False,
    in_phase: bool = False,
    progress: Progress | None = None,
    patches: dict[str, str] | None = None,
) -> Evaluation:
    """Track every tool sensor and body of a session at every frame.

    Parameters
    ----------
    session : Session
    model : FieldModel
    settings : TrackerSettings, optional
    baseline : Session, optional
        Distortion-free recording of the same board, whose reference readings are the clean ones.
    refit : bool
        Whether the model follows the session's reference sensors, as the node does live.
    in_phase : bool
        Whether only in-phase fluxes and moments are used (the article's way).
    progress : callable, optional
        Called with the finished share, 0 to 1.
    patches : dict of str to str, optional
        Bodies that carry further reference coils, each with the topic of its poses in the bag.

    Raises
    ------
    BagError
        When the session has no tool fluxes, or a refit lacks references or a baseline.
    ModelFileError
        When the model's emitters are not the session's.
    """
    if not session.tools:
        raise BagError(f'{session.path}: the session has no tool fluxes to track')
    check_fits(model, session)
    if in_phase:
        model = in_phase_model(model)
    sensors = _all_sensors(session)
    correction = Correction.of(model.effects, sensors, model.frequencies_hz)
    wanted = settings or TrackerSettings()
    noise_t = max(wanted.flux_noise_t, noise_of(session.setup))
    recorded = not refit and drift_recorded(model, session)
    tracker = Tracker(
        model,
        sensors,
        replace(
            wanted,
            flux_noise_t=noise_t,
            recorded_drift=recorded,
            volume=wanted.volume or pose_volume(session.setup),
        ),
    )
    follower = _follower(session, model, baseline, patches or {}) if refit else None
    pace, summary = Pace(), RefitSummary() if refit else None
    estimates: dict[str, list[PoseEstimate]] = {}
    frames = list(_frames(session))
    start = time.perf_counter()
    for count, (stamp, tools, reference_frame) in enumerate(frames):
        stamp_ns = session.start_ns + round(stamp / NANO)
        reference = session.reference
        channels, flux, flags = _tool_frame(tools)
        if isinstance(follower, PatchFollower) and tools:
            follower.take_flux(stamp_ns, channels, flux, flags)
        due = follower is not None and reference_frame is not None and pace.is_due(stamp_ns)
        if due and follower is not None and reference is not None:
            result = follower.update(
                stamp_ns,
                reference.sensors.channel,
                reference.flux[reference_frame],
                reference.flags[reference_frame],
            )
            tracker = tracker.with_model(result.model)
            if summary is not None:
                summary.add(result)
        if tools:
            if in_phase:
                flux = flux.real.astype(complex)
            for estimate in tracker.update(stamp_ns, channels, flux, flags):
                estimates.setdefault(estimate.name, []).append(estimate)
        if progress is not None:
            progress((count + 1) / len(frames))
    seconds = (time.perf_counter() - start) / max(len(frames), 1)
    return replace(_compare(session, correction, estimates, seconds), refit=summary)


def drift_recorded(model: FieldModel, session: Session) -> bool:
    """Whether this is the session on which the model's drifts were found."""
    found = [effect.evidence.get(FOUND_ON) for effect in model.effects if effect.name in DRIFTS]
    return session.start_ns in found


def _all_sensors(session: Session) -> SensorTable:
    tables = [tool.sensors for tool in session.tools]
    return SensorTable(
        channel=np.concatenate([t.channel for t in tables]),
        name=tuple(name for t in tables for name in t.name),
        body=tuple(body for t in tables for body in t.body),
        position=np.concatenate([t.position for t in tables]),
        axis=np.concatenate([t.axis for t in tables]),
        length=np.concatenate([t.length for t in tables]),
    )


def _tool_frame(
    tools: list[tuple[Measurements, int]],
) -> tuple[NDArray[np.int64], NDArray[np.complex128], NDArray[np.int64]]:
    """Channels, fluxes and flags of all bodies in one frame; nothing where there are none."""
    if not tools:
        return np.empty(0, np.int64), np.empty((0, 0), np.complex128), np.empty(0, np.int64)
    return (
        np.concatenate([tool.sensors.channel for tool, _ in tools]),
        np.concatenate([tool.flux[frame] for tool, frame in tools]),
        np.concatenate([tool.flags[frame] for tool, frame in tools]),
    )


def _follower(
    session: Session, model: FieldModel, baseline: Session | None, patches: dict[str, str]
) -> LiveRefit | PatchFollower:
    if session.reference is None:
        raise BagError(f'{session.path}: a refit needs reference fluxes, the session has none')
    if baseline is None:
        raise BagError('a refit needs --baseline, a distortion-free recording of the same board')
    check_fits(model, baseline)
    sensors = session.reference.sensors
    clean = baseline_flux(baseline, sensors)
    try:
        check_enough(clean, RefitSettings().min_references)
    except FitError as error:
        raise BagError(f'{baseline.path}: {error}') from error
    if patches:
        return PatchFollower(session, model, clean, patches)
    setup = session.setup
    return LiveRefit(model, sensors, clean, drawing=drawing_of(setup), volume=stated_volume(setup))


def _truth(
    tool: Measurements, correction: Correction
) -> tuple[Array, Array, NDArray[np.bool_], SensorTable]:
    """Optical pose at the flux stamps, with the model's corrections of clock and frame."""
    sensors = correction.sensors(tool.sensors)
    if tool.track is None:
        return tool.position, tool.rotation, tool.has_pose, sensors
    track = correction.optical(tool.track)
    position, rotation, valid = track.at(tool.time, LONGEST_OPTICAL_GAP_S)
    return position, rotation, valid, sensors


def _compare(
    session: Session,
    correction: Correction,
    estimates: dict[str, list[PoseEstimate]],
    seconds: float,
) -> Evaluation:
    sensors: dict[str, PoseSeries] = {}
    bodies: dict[str, PoseSeries] = {}
    for tool in session.tools:
        position, rotation, valid, table = _truth(tool, correction)
        position = np.where(valid[:, None], position, np.nan)
        centres, axes = table.placed(position, rotation)
        for column, name in enumerate(table.name):
            given = estimates.get(name, [])
            sensors[name] = _sensor_series(name, given, centres[:, column], axes[:, column])
        if tool.body in estimates:
            bodies[tool.body] = _body_series(tool.body, estimates[tool.body], position, rotation)
    return Evaluation(sensors, bodies, seconds)


def _sensor_series(
    name: str, estimates: list[PoseEstimate], centres: Array, axes: Array
) -> PoseSeries:
    distance, angle = np.full(len(estimates), np.nan), np.full(len(estimates), np.nan)
    for i, estimate in enumerate(estimates):
        if estimate.state == 'ok':
            distance[i] = np.linalg.norm(estimate.position - centres[i])
            cross = np.linalg.norm(np.cross(estimate.axis, axes[i]))
            angle[i] = np.arctan2(cross, float(np.dot(estimate.axis, axes[i])))
    return PoseSeries(name, tuple(estimates), distance, angle)


def _body_series(
    name: str, estimates: list[PoseEstimate], position: Array, rotation: Array
) -> PoseSeries:
    distance, angle = np.full(len(estimates), np.nan), np.full(len(estimates), np.nan)
    for i, estimate in enumerate(estimates):
        if estimate.state == 'ok' and estimate.rotation is not None:
            distance[i] = np.linalg.norm(estimate.position - position[i])
            turn = estimate.rotation.T @ rotation[i]
            sine = 0.5 * np.linalg.norm(
                [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
            )
            angle[i] = np.arctan2(sine, 0.5 * (np.trace(turn) - 1.0))
    return PoseSeries(name, tuple(estimates), distance, angle)


def metrics(series: PoseSeries) -> dict[str, Any]:
    """The contract's figures of one sensor or body; None where nothing could be compared."""
    result: dict[str, Any] = {
        'n': int(np.isfinite(series.position_error).sum()),
        'tracked_fraction': float(series.ok.mean()) if series.ok.size else 0.0,
    }
    for key, unit, errors in (
        ('position', 'm', series.position_error),
        ('orientation', 'rad', series.orientation_error),
    ):
        e = errors[np.isfinite(errors)]
        values = (
            (
                float(np.sqrt(np.mean(e**2))),
                float(e.mean()),
                float(np.percentile(e, 50)),
                float(np.percentile(e, 95)),
            )
            if e.size
            else (None,) * 4
        )
        for statistic, value in zip(('rmse', 'me', 'prc50', 'prc95'), values, strict=True):
            result[f'{key}_{statistic}_{unit}'] = value
    return result
