"""Diagnoses a recorded session, and tracks its held-out part without and with what was found.

Each stage can be called alone: `prepare`, `correct`, `problem_of`, `diagnosis.diagnose`,
`held_out_part`, `track_held_out`; `diagnose_session` runs all of them.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from functools import partial
from types import ModuleType
from typing import Any

import numpy as np

from anser_ros import extensions
from anser_ros.diagnosis.decisions import BETTER
from anser_ros.diagnosis.diagnose import SCHEMA, WIRING_FRAMES, Diagnosis, diagnose, screen
from anser_ros.diagnosis.fit import Fitter
from anser_ros.diagnosis.problem import Problem, Spread, build_problem, test_blocks, train_blocks
from anser_ros.diagnosis.search import SearchSettings
from anser_ros.diagnosis.wiring import power_left, wiring_faults, without_dead
from anser_ros.effects.effect import Term, effect_named
from anser_ros.errors import DiagnosisError, ParameterError, PlausibilityError
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


NEAR = 4e-4
"""Share of the readings' power below which poses are not grossly off, so that nothing needs to be
tracked: 5 mm at 0.35 m, a large volume's end, change a reading by 2 % or more."""
STAND_FRAMES = 90
"""Frames of each tool, about, by which it is told which of a model's sessions a session stands
like: a dozen parameters take tens, and twice as many take twice the time."""


@dataclass(frozen=True)
class TrackingErrors:
    """Holds root mean square errors of all coils tracked singly in the held-out part.

    They are of the source where only that was seen, and of the bodies where no coil alone has a
    pose; None where nothing was tracked.
    """

    position_rmse_m: float | None = None
    orientation_rmse_rad: float | None = None


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
    frames have fluxes and a pose; `PlausibilityError` when all phases are reversed, or the optical
    poses are grossly off the tracked ones, and no effect is that or mends it; `ModelFileError`
    when the model's emitters are not the session's; `BagError` when the baseline's references are
    not the session's.
    """
    say = progress or (lambda text: None)
    prepared = prepare(session, model, baseline)
    problem = problem_of(correct(prepared))
    some = problem.thinned(WIRING_FRAMES)
    plugs = wiring_faults(some)
    tools = tuple(replace(tool, flux=tool.flux.conj()) for tool in session.tools)
    mirrored = problem_of(correct(prepared.with_session(replace(session, tools=tools))))
    share, in_phase, quadrature = power_left(some, plugs)
    *_, otherwise = power_left(mirrored.thinned(WIRING_FRAMES), plugs)
    # Exchanged channels leave their delays, too, which are little beside what they leave in phase.
    if otherwise < BETTER * quadrature and quadrature > BETTER * in_phase:
        raise PlausibilityError(
            f"{session.path}: all phases are opposite to the model's: "
            'have imaginary parts the other sign?'
        )
    is_near = bool(plugs) or share < NEAR
    gross = [] if is_near else [one for one in track(prepared).disagreements if one.is_gross]
    for one in gross:
        if one.is_stated:
            raise PlausibilityError(one.words)
    differing = {effect.name for effect in model.effects if SESSION in effect.parameters}
    if differing or plugs:
        ways = [prepare(session, one, baseline) for one in each_stand(model)] or [prepared]
        tried = [(way, problem_of(correct(way, plugs))) for way in ways]
        prepared, problem = min(tried, key=lambda pair: _left(pair[1], differing))
    found = diagnose(problem, prepared.model, progress=say)
    dated = date_drifts(found.model, session)
    found = replace(found, model=made_for(dated, session.setup))
    left = track(prepared.with_model(found.model)).disagreements if gross else ()
    if any(one.is_gross for one in left):
        raise PlausibilityError(gross[0].words)
    say('tracking the held-out part')
    unseen = prepared.with_session(held_out_part(session, problem))
    before, after = track_held_out(unseen, found)
    return SessionDiagnosis(found, before, after)


def _left(problem: Problem, differing: Collection[str]) -> float:
    """Misfit of a problem's wiring, and at most one of these effects, by which sessions differ.

    What stands elsewhere than in any session of a model must not choose another of them, nor an
    emitter that is dead for a part of the time.
    """
    screened = screen(without_dead(problem))
    some, steps = screened.training(STAND_FRAMES), SearchSettings.iterations
    fitter = Fitter(some, train_blocks(), steps)
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
    moves = any(term.effect.followed for term in found.terms) and after.baseline is not None
    with_effects = partial(_errors, after, found.flux_rms_after_t / floor, moves)
    without = partial(_errors, unseen, found.flux_rms_before_t / floor, False)
    later, earlier = in_order(lambda work: work(), [with_effects, without])
    return earlier, later


def _errors(prepared: PreparedSession, misfit: float, moves: bool) -> TrackingErrors:
    """Errors with a gate as wide as the misfit: a wrong model's poses are to be seen here."""
    settings = TrackerSettings(gate=TrackerSettings().gate * max(1.0, ROOM * misfit))
    evaluation = track(prepared, settings, ModelFollower(prepared) if moves else None)
    # Where no coil has a pose (a field that is the same all around an axis), the source has; where
    # one coil alone cannot have one (over few emitters), its body has.
    further = [one for group in evaluation.further.values() for one in group.values()]
    kinds = (further or list(evaluation.sensors.values())), list(evaluation.bodies.values())
    errors = []
    for series in kinds:
        # The first frame of a held-out part is there for its stamp alone.
        pairs = [np.array([one.position_error, one.orientation_error])[:, 1:] for one in series]
        rows = np.concatenate([np.zeros((2, 0)), *pairs], axis=1)
        each = [row[np.isfinite(row)] for row in rows]
        rms = [float(np.sqrt(np.mean(e**2))) if e.size else None for e in each]
        errors.append(TrackingErrors(*rms))
    return next((e for e in errors if e.position_rmse_m is not None), errors[0])


DEPENDENCIES = (
    'time', 'position', 'orientation', 'speed', 'emitter', 'channel', 'amplitude', 'frequency',
)  # fmt: skip
"""Variables on which a remainder may depend in words; other tests are for the report only."""
MODEL_FILE_ONLY = ('groups', 'knots_s', 'course', 'couplings_m3')
"""Parameters of hundreds of numbers, which stand in the model file only."""


def to_document(result: SessionDiagnosis) -> dict[str, Any]:
    """Return what was found as plain data."""
    found, before, after = result.diagnosis, result.before, result.after
    flux_t = found.flux_rms_before_t, found.flux_rms_after_t, found.flux_rms_floor_t
    effects = [effect_figures(one.record, one.flux_rms_without_t) for one in found.findings]
    depends_on = [name for name in found.depends_on if name in DEPENDENCIES]
    return document_of(flux_t, before, after, effects, found.unexplained, depends_on)


def document_of(
    flux_t: tuple[float, float, float], before: TrackingErrors, after: TrackingErrors,
    effects: list[dict[str, Any]], unexplained: float, depends_on: list[str],
) -> dict[str, Any]:  # fmt: skip
    """Return the document of errors before and after, of effects, and of what is unexplained.

    Of fluxes there is the error of noise alone too.
    """
    keys = ('flux_rms_before_t', 'flux_rms_after_t', 'flux_rms_floor_t')
    held_out: dict[str, float | None] = dict(zip(keys, flux_t, strict=True))
    for when, errors in (('before', before), ('after', after)):
        held_out[f'position_rmse_{when}_m'] = errors.position_rmse_m
        held_out[f'orientation_rmse_{when}_rad'] = errors.orientation_rmse_rad
    rest = {'fraction': unexplained, 'depends_on': depends_on}
    return {'schema': SCHEMA, 'held_out': held_out, 'effects': effects, 'unexplained': rest}


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
