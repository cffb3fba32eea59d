"""Diagnoses a recorded session: the problem, the search, and tracking of the held-out part."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from anser_ros.diagnosis.diagnose import Diagnosis, diagnose
from anser_ros.diagnosis.prepare import build_problem, test_blocks
from anser_ros.diagnosis.problem import Problem
from anser_ros.diagnosis.whitening import Spread
from anser_ros.effects.correction import DRIFTS, Correction
from anser_ros.errors import DiagnosisError, SetupError
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import FieldModel
from anser_ros.field.nominal import nominal_model
from anser_ros.sessions.evaluation import (
    FOUND_ON,
    baseline_flux,
    drift_recorded,
    track_session,
)
from anser_ros.sessions.session import LONGEST_OPTICAL_GAP_S, Session, noise_of
from anser_ros.sessions.starting_model import board_of, check_fits
from anser_ros.tracking.estimate import TrackerSettings

Array = NDArray[np.float64]

SCHEMA = 'anser_diagnosis/1'
DEPENDENCIES = (
    'time', 'position', 'orientation', 'speed', 'emitter', 'channel', 'amplitude', 'frequency',
)  # fmt: skip
DEFAULT_NOISE_T = 60e-12
ROOM = 2.0
BULKY = ('groups', 'knots_s', 'course', 'couplings_m3')
"""Parameters that only a program needs; they stand in the model file."""


@dataclass(frozen=True)
class TrackingErrors:
    """RMSE over all coils tracked singly in the held-out part; None where none was tracked."""

    position_rmse_m: float | None
    orientation_rmse_rad: float | None


@dataclass(frozen=True)
class SessionDiagnosis:
    """What was found, and how the held-out part is tracked without and with it."""

    diagnosis: Diagnosis
    before: TrackingErrors
    after: TrackingErrors


def diagnose_session(
    session: Session,
    model: FieldModel,
    baseline: Session | None = None,
    progress: Callable[[str], None] | None = None,
) -> SessionDiagnosis:
    """Find what a model lacks on a session.

    Parameters
    ----------
    session : Session
        With optical poses of at least one tool.
    model : FieldModel
        Of the session's emitters.
    baseline : Session, optional
        Distortion-free recording of the same board; with it the reference sensors have a say.
    progress : callable, optional
        Told in words what goes on.

    Raises
    ------
    DiagnosisError
        When fewer than 30 frames have fluxes and a pose.
    ModelFileError
        When the model's emitters are not the session's.
    BagError
        When the baseline's references are not the session's.
    """
    check_fits(model, session)
    if baseline is not None:
        check_fits(model, baseline)
    if not session.tools:
        raise DiagnosisError(
            f'{session.path}: a diagnosis needs tool fluxes, the session has none'
        )
    clean = None
    if baseline is not None and session.reference is not None:
        clean = baseline_flux(baseline, session.reference.sensors)
    noise_t = noise_of(session.setup) or DEFAULT_NOISE_T
    spread = Spread(flux_t=float(np.hypot(noise_t, model.flux_error_t)), noise_t=noise_t)
    same = drift_recorded(model, session)
    known = [corrected(tool, model, recorded=same) for tool in session.tools]
    reference = session.reference
    if reference is not None:
        reference = corrected(reference, model, recorded=same)
    problem = build_problem(known, reference, clean, model, drawn(session), spread)
    found = _dated(diagnose(problem, model, progress=progress), session.start_ns)
    say = progress or (lambda text: None)
    say('tracking the held-out part')
    unseen = _unseen(session, problem)
    # What only the references can follow live: metal that moves, an emitter without a course.
    moves = any(
        term.effect.moving or term.effect.name == 'coil_fluctuation' for term in found.terms
    )
    follow = moves and baseline is not None and session.reference is not None
    floor = max(found.flux_rms_floor_t, 1e-30)
    return SessionDiagnosis(
        found,
        _tracked(unseen, model, None, found.flux_rms_before_t / floor, refit=False),
        _tracked(unseen, found.model, baseline, found.flux_rms_after_t / floor, refit=follow),
    )


def _dated(found: Diagnosis, start_ns: int) -> Diagnosis:
    """The diagnosis with drifts that say on which session they took their course."""
    effects = tuple(
        replace(effect, evidence={**effect.evidence, FOUND_ON: start_ns})
        if effect.name in DRIFTS and FOUND_ON not in effect.evidence
        else effect
        for effect in found.model.effects
    )
    return replace(found, model=replace(found.model, effects=effects))


def corrected(
    measurements: Measurements, model: FieldModel, *, recorded: bool = False
) -> Measurements:
    """The measurements as the effects that the model already knows leave them.

    ``recorded`` as for `Correction.flux`.
    """
    correction = Correction.of(model.effects, measurements.sensors, model.frequencies_hz)
    if not correction.terms:
        return measurements
    flux = measurements.flux
    if correction.changes_flux:
        channels = measurements.sensors.channel
        rows = zip(measurements.time.tolist(), flux, strict=True)
        flux = np.array(
            [correction.flux(time, channels, frame, recorded=recorded) for time, frame in rows]
        )
    out = replace(measurements, sensors=correction.sensors(), flux=flux)
    if measurements.track is None:
        return out
    track = correction.optical(measurements.track)
    position, rotation, has_pose = track.at(measurements.time, LONGEST_OPTICAL_GAP_S)
    return replace(out, track=track, position=position, rotation=rotation, has_pose=has_pose)


def drawn(session: Session) -> FieldModel | None:
    """The nominal model, where the setup's geometry makes one."""
    try:
        return nominal_model(board_of(session.setup))
    except SetupError:
        return None


def _unseen(session: Session, problem: Problem) -> Session:
    """The first frame, which sets the clock, and those in the blocks that took no part."""
    held = {
        tool.body: tool.time[np.isin(blocks, test_blocks())]
        for tool, blocks in zip(problem.tools, problem.blocks, strict=True)
    }
    tools = tuple(
        tool.frames(np.union1d([0], np.flatnonzero(np.isin(tool.time, held[tool.body]))))
        for tool in session.tools
        if tool.body in held
    )
    reference = session.reference
    if reference is not None:
        times = np.concatenate([tool.time for tool in tools])
        reference = _at(reference, times)
    return replace(session, tools=tools, reference=reference)


def _at(measurements: Measurements, times: Array) -> Measurements:
    return measurements.frames(np.flatnonzero(np.isin(measurements.time, times)))


def _tracked(
    session: Session, model: FieldModel, baseline: Session | None, misfit: float, *, refit: bool
) -> TrackingErrors:
    """Errors with a gate as wide as the misfit: a wrong model's poses are to be seen here.

    A gate that lets everything pass would also take wrong minima for poses.
    """
    usual = TrackerSettings()
    settings = replace(usual, gate=usual.gate * max(1.0, ROOM * misfit))
    evaluation = track_session(session, model, settings, baseline=baseline, refit=refit)
    return TrackingErrors(
        _rms([series.position_error[1:] for series in evaluation.sensors.values()]),
        _rms([series.orientation_error[1:] for series in evaluation.sensors.values()]),
    )


def _rms(errors: list[Array]) -> float | None:
    values = np.concatenate(errors)
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(values**2))) if values.size else None


def plain(value: Any) -> Any:
    """Numbers, lists and mappings as JSON and YAML have them."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, complex):
        return [value.real, value.imag]
    return value


def to_document(result: SessionDiagnosis) -> dict[str, Any]:
    """The contract's diagnosis document."""
    found = result.diagnosis
    return {
        'schema': SCHEMA,
        'held_out': {
            'flux_rms_before_t': found.flux_rms_before_t,
            'flux_rms_after_t': found.flux_rms_after_t,
            'flux_rms_floor_t': found.flux_rms_floor_t,
            'position_rmse_before_m': result.before.position_rmse_m,
            'position_rmse_after_m': result.after.position_rmse_m,
            'orientation_rmse_before_rad': result.before.orientation_rmse_rad,
            'orientation_rmse_after_rad': result.after.orientation_rmse_rad,
        },
        'effects': [
            {
                'name': finding.record.name,
                'parameters': plain(
                    {k: v for k, v in finding.record.parameters.items() if k not in BULKY}
                ),
                'uncertainty': plain(dict(finding.record.uncertainty)),
                'evidence': plain(dict(finding.record.evidence)),
                'flux_rms_without_t': finding.flux_rms_without_t,
            }
            for finding in found.findings
        ],
        'unexplained': {
            'fraction': found.unexplained,
            'depends_on': [name for name in found.depends_on if name in DEPENDENCIES],
        },
    }
