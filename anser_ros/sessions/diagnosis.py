"""Diagnoses a recorded session, and tracks its held-out part without and with what was found.

Each stage can be called alone: `prepare`, `correct`, `problem_of`, `diagnosis.diagnose`,
`held_out_part`, `track_held_out`; `diagnose_session` runs all of them.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import numpy as np

from anser_ros import extensions
from anser_ros.arrays import Array
from anser_ros.diagnosis.diagnose import SCHEMA, WIRING_FRAMES, Diagnosis, diagnose, screen
from anser_ros.diagnosis.problem import Problem, Spread, build_problem, test_blocks, train_blocks
from anser_ros.diagnosis.search import SearchSettings
from anser_ros.diagnosis.wiring import wiring_faults
from anser_ros.effects.effect import Term, effect_named
from anser_ros.errors import DiagnosisError, ParameterError
from anser_ros.field.model import SESSION, EffectRecord, FieldModel, plain
from anser_ros.parallel import in_order
from anser_ros.sessions.follower import ModelFollower
from anser_ros.sessions.prepared import PreparedSession, correct, each_stand, prepare
from anser_ros.sessions.session import Session
from anser_ros.sessions.starting_model import date_drifts, made_for
from anser_ros.sessions.tracked_session import track
from anser_ros.tracking.estimate import TrackerSettings

ROOM = 2.0
"""Gate of the held-out part's tracking over its residual: less would refuse a wrong model's poses
instead of counting them, much more would take wrong minima for poses."""


STAND_FRAMES = 90
"""Frames of each tool, about, by which it is told which of a model's sessions a session stands
like: a dozen parameters take tens, and twice as many take twice the time."""


@dataclass(frozen=True)
class TrackingErrors:
    """Holds root mean square errors of all coils tracked singly in the held-out part.

    They are of the source where only that was seen, and of the bodies where no coil alone has a
    pose; None where nothing was tracked.
    """

    position_rmse_m: float | None
    orientation_rmse_rad: float | None


@dataclass(frozen=True)
class SessionDiagnosis:
    """Holds what a model lacks on a session, and tracking errors without and with it."""

    diagnosis: Diagnosis
    before: TrackingErrors
    after: TrackingErrors


def diagnose_session(
    session: Session,
    model: FieldModel,
    baseline: Session | None = None,
    progress: Callable[[str], None] | None = None,
) -> SessionDiagnosis:
    """Find what a model lacks on a session with optical poses of at least one tool.

    With a baseline, a distortion-free recording of the same board, the references are used.
    ``progress`` is called with words on what goes on. Raises `DiagnosisError` when fewer than 30
    frames have fluxes and a pose; `ModelFileError` when the model's emitters are not the
    session's; `BagError` when the baseline's references are not the session's.
    """
    say = progress or (lambda text: None)
    prepared = prepare(session, model, baseline)
    problem = problem_of(correct(prepared))
    plugs = wiring_faults(problem.thinned(WIRING_FRAMES))
    differing = {effect.name for effect in model.effects if SESSION in effect.parameters}
    if differing or plugs:
        ways = [prepare(session, one, baseline) for one in each_stand(model)] or [prepared]
        tried = [(way, problem_of(correct(way, plugs))) for way in ways]
        prepared, problem = min(tried, key=lambda pair: _left(pair[1], differing))
    found = diagnose(problem, prepared.model, progress=say)
    dated = date_drifts(found.model, session)
    found = replace(found, model=made_for(dated, session.setup))
    say('tracking the held-out part')
    unseen = prepared.with_session(held_out_part(session, problem))
    before, after = track_held_out(unseen, found)
    return SessionDiagnosis(found, before, after)


def _left(problem: Problem, differing: Collection[str]) -> float:
    """Misfit of a problem's wiring, and at most one of these effects, by which sessions differ.

    What stands elsewhere than in any session of a model must not choose another of them.
    """
    screened = screen(problem)
    fitter = SearchSettings().fitter(screened.training(STAND_FRAMES), train_blocks())
    sites = [effect_named(name).candidates(problem.apparatus) for name in differing]
    alone: list[tuple[Term, ...]] = [(), *((term,) for terms in sites for term in terms)]
    return min(fitter.fit([*screened.known, *terms]).misfit for terms in alone)


def problem_of(corrected: PreparedSession, spread: Spread | None = None) -> Problem:
    """Return the diagnosis problem of a session that was corrected (`correct`).

    Readings and poses may be off by ``spread``, by default that of `spread_of`. Raises
    `DiagnosisError` when too few frames have fluxes and a pose.
    """
    session, clean = corrected.session, corrected.baseline
    if not session.tools:
        raise DiagnosisError(
            f'{session.path}: a diagnosis needs tool fluxes, the session has none'
        )
    return build_problem(
        session.tools, session.reference, None if clean is None else clean.flux, corrected.model,
        corrected.nominal.model, spread or spread_of(corrected),
    )  # fmt: skip


def spread_of(prepared: PreparedSession) -> Spread:
    """Return how far readings and poses may be from what a right model says."""
    accuracy = prepared.session.setup.accuracy
    accuracy = replace(accuracy, flux_noise_t=prepared.noise_t or accuracy.flux_noise_t)
    return Spread(float(np.hypot(accuracy.flux_noise_t, prepared.model.flux_error_t)), accuracy)


def held_out_part(session: Session, problem: Problem) -> Session:
    """Return the frames of the blocks that took no part, and the first, which sets the clock."""
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
        reference = reference.frames(np.flatnonzero(np.isin(reference.time, times)))
    return replace(session, tools=tools, reference=reference)


def track_held_out(
    unseen: PreparedSession, found: Diagnosis
) -> tuple[TrackingErrors, TrackingErrors]:
    """Track the held-out part with the model as it was, and with the effects that were found.

    Then the model follows the references if only these can determine an effect live.
    """
    floor = max(found.flux_rms_floor_t, 1e-30)
    after = unseen.with_model(found.model)
    moves = any(term.effect.followed for term in found.terms)

    def with_effects() -> TrackingErrors:
        follower = ModelFollower(after) if moves and after.baseline is not None else None
        return _errors(after, found.flux_rms_after_t / floor, follower)

    def without() -> TrackingErrors:
        return _errors(unseen, found.flux_rms_before_t / floor)

    later, earlier = in_order(lambda work: work(), [with_effects, without])
    return earlier, later


def _errors(
    prepared: PreparedSession, misfit: float, follower: ModelFollower | None = None
) -> TrackingErrors:
    """Errors with a gate as wide as the misfit: a wrong model's poses are to be seen here."""
    usual = TrackerSettings()
    settings = replace(usual, gate=usual.gate * max(1.0, ROOM * misfit))
    evaluation = track(prepared, settings, follower)
    # Where no coil has a pose (a field that is the same all around an axis), the source has; where
    # one coil alone cannot have one (over few emitters), its body has.
    further = [one for group in evaluation.further.values() for one in group.values()]
    kinds = (further or list(evaluation.sensors.values())), list(evaluation.bodies.values())
    # The first frame of a held-out part is there for its stamp alone.
    errors = [
        TrackingErrors(
            _rms([one.position_error[1:] for one in series]),
            _rms([one.orientation_error[1:] for one in series]),
        )
        for series in kinds
    ]
    return next((e for e in errors if e.position_rmse_m is not None), errors[0])


def _rms(errors: list[Array]) -> float | None:
    values = np.concatenate([np.zeros(0), *errors])
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(values**2))) if values.size else None


DEPENDENCIES = (
    'time', 'position', 'orientation', 'speed', 'emitter', 'channel', 'amplitude', 'frequency',
)  # fmt: skip
"""Variables on which a remainder may depend in words; other tests are for the report only."""
MODEL_FILE_ONLY = ('groups', 'knots_s', 'course', 'couplings_m3')
"""Parameters of hundreds of numbers, which stand in the model file only."""


def to_document(result: SessionDiagnosis) -> dict[str, Any]:
    """Return what was found as plain data."""
    found, before, after = result.diagnosis, result.before, result.after
    return document_of(
        (found.flux_rms_before_t, found.flux_rms_after_t, found.flux_rms_floor_t),
        (before.position_rmse_m, after.position_rmse_m),
        (before.orientation_rmse_rad, after.orientation_rmse_rad),
        [effect_figures(one.record, one.flux_rms_without_t) for one in found.findings],
        (found.unexplained, [name for name in found.depends_on if name in DEPENDENCIES]),
    )


def document_of(
    flux_t: tuple[float, float, float],
    position_m: tuple[float | None, float | None],
    orientation_rad: tuple[float | None, float | None],
    effects: list[dict[str, Any]],
    unexplained: tuple[float, list[str]],
) -> dict[str, Any]:
    """Return the document of errors before and after, of effects, and of what is unexplained.

    Of fluxes there is the error of noise alone too; the last are the share that is unexplained,
    and what that depends on.
    """
    return {
        'schema': SCHEMA,
        'held_out': {
            'flux_rms_before_t': flux_t[0],
            'flux_rms_after_t': flux_t[1],
            'flux_rms_floor_t': flux_t[2],
            'position_rmse_before_m': position_m[0],
            'position_rmse_after_m': position_m[1],
            'orientation_rmse_before_rad': orientation_rad[0],
            'orientation_rmse_after_rad': orientation_rad[1],
        },
        'effects': effects,
        'unexplained': {'fraction': unexplained[0], 'depends_on': unexplained[1]},
    }


def effect_figures(record: EffectRecord, without_t: float) -> dict[str, Any]:
    """Return an effect as plain data; ``without_t``: held-out residual with all but it, T."""
    short = {key: value for key, value in record.parameters.items() if key not in MODEL_FILE_ONLY}
    return {
        'name': record.name,
        'parameters': plain(short),
        'uncertainty': plain(dict(record.uncertainty)),
        'evidence': plain(dict(record.evidence)),
        'flux_rms_without_t': without_t,
    }


def other_way(session: Session, baseline: Session | None = None) -> ModuleType | None:
    """Return the module of an application that diagnoses sessions of this kind, None for no other.

    Raises `ParameterError` where a baseline is given that it has no use for.
    It has ``accepts(session)``, ``diagnose(session, model, progress)`` whose result has a
    ``model``, ``to_document(result)``, and the name of a module ``REPORT`` with
    ``render(result, document, session=, model=)``.
    """
    way = next((way for way in extensions.loaded('DIAGNOSES') if way.accepts(session)), None)
    if baseline is not None and (way is not None or session.reference is None):
        raise ParameterError(f'{session.path}: a baseline has no effect: no references are used')
    return way
