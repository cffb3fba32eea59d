"""Calibrates recorded sessions of one board by the first engine that accepts them.

A scan in which metal moved, and rested near before and after, is calibrated twice: frames in
which it moves are left out, but the field of the others contains the resting metal. Its motion
determines that part (`diagnosis.departure`), which is subtracted before the field is fitted again.
"""

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from anser_ros import extensions
from anser_ros.arrays import Array, Booleans, ComplexArray
from anser_ros.calibration import disturbances
from anser_ros.calibration.calibrate import Options, correct_scan, fit_scan
from anser_ros.calibration.drawn_fit import FINE
from anser_ros.calibration.held_out import rms
from anser_ros.calibration.layouts import Generator
from anser_ros.calibration.moments import Progress
from anser_ros.calibration.readings import check_single_coils, with_pose
from anser_ros.calibration.result import Calibration, Scan, at_start, drift_records
from anser_ros.calibration.sensor_parameters import EXTRA_KINDS, KINDS
from anser_ros.diagnosis.departure import KNOWN, Departure, departure
from anser_ros.diagnosis.problem import Problem, Spread, build_problem
from anser_ros.diagnosis.wiring import rightly_wired, scan_faults, session_faults, wiring_words
from anser_ros.effects.correction import tool_view
from anser_ros.effects.effect import Remedy, Term, effect_named
from anser_ros.errors import DiagnosisError, FitError
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import EffectRecord
from anser_ros.field.nominal import nominal_model
from anser_ros.sessions.baseline import readings_of
from anser_ros.sessions.drawn_calibration import fit_to_drawing, is_for_drawing
from anser_ros.sessions.nominal_board import NominalBoard, board_of
from anser_ros.sessions.plausibility import FLUX_UNITS, TOO_LARGE, silent, unit_words, unread
from anser_ros.sessions.session import Session, shifted
from anser_ros.sessions.starting_model import made_for
from anser_ros.settings import Accuracy
from anser_ros.wire.setup import Setup

MOTION_MARGIN_S = 1.0
"""Time (s) before and after a motion that is looked at: it begins before it is seen."""
FEWEST_STEADY = 10
"""Frames of the references at rest, of which their steady readings are the mean, at least."""
FIELD_REACH_M = 0.015
"""Distance (m) of a coil from where the field was learnt, up to which that is predicted well."""
ASIDE = 0.3
"""Distance of a look's free dipoles at the wiring from each emitter's middle, in its sides."""
MOST_UNEXPLAINED = 0.05
"""Share of the readings that a calibration leaves at most: good ones leave a thousandth, those of
a layout that is too coarse a hundredth, wrong signs or poses, or a source moved by 5 mm, a tenth
and more."""
SIGMAS = 3.0 * math.sqrt(2.0)
"""Stated errors of poses that a contradiction between parts of a scan has to exceed: both have
theirs."""
JITTER = 30.0
"""Errors of the poses, in those that are stated, from which on they are no jitter. What the model
cannot explain counts as theirs, which makes up to four of a good scan; poses in a frame that is a
quarter turn off made a hundred."""
UNCERTAINTY_FRAMES = 60
"""Frames of a tool, about, in which the uncertainty of the metal at rest is worked out."""


@dataclass(frozen=True)
class RestingMetal:
    """Holds what metal at rest did to tools' fluxes, (F, S, K) each, T, its error and places."""

    flux: tuple[ComplexArray, ...]
    sigma_t: float
    record: EffectRecord


def without_resting_metal(
    sessions: Sequence[Session],
    calibration: Calibration,
    progress: Callable[[str, float], None] | None = None,
) -> Scan | None:
    """Return a scan without metal that rested during it; None where there is none to take off."""
    scan = calibration.scan
    if scan.sensor_fit is None:
        return None
    measurements, start, found = list(scan.measurements), 0, []
    reported_effects = list(scan.reported_effects)
    for session in sessions:
        rows = range(start, start + len(session.tools))
        start += len(session.tools)
        spans = [
            span
            for row, tool in zip(rows, session.tools, strict=True)
            for span in disturbances.spans_of(tool.time, ~scan.sensor_fit.steady[row])
        ]
        if not spans or session.reference is None:
            continue
        if progress is not None:
            progress('metal at rest', 0.0)
        ends = min(s.start_s for s in spans), max(s.end_s for s in spans)
        metal = _resting(session, calibration, [measurements[row] for row in rows], ends)
        if metal is None:
            continue
        for row, flux in zip(rows, metal.flux, strict=True):
            whole = measurements[row]
            usable = whole.usable[:, :, None]
            measurements[row] = replace(
                whole, flux=np.where(usable, whole.flux - flux, whole.flux)
            )
        found.append(metal)
        reported_effects = [_completed(record, metal, ends) for record in reported_effects]
    if not found:
        return None
    sigma = float(np.sqrt(np.mean([metal.sigma_t**2 for metal in found])))
    return replace(
        scan,
        measurements=tuple(measurements),
        reported_effects=tuple(reported_effects),
        field_sigma_t=sigma,
    )


def _completed(
    record: EffectRecord, metal: RestingMetal, ends: tuple[float, float]
) -> EffectRecord:
    """The record of a span in which this metal moved, with where it rested."""
    parameters = record.parameters
    if not ends[0] <= parameters['t_start_s'] <= ends[1]:
        return record
    return replace(
        record,
        parameters={**metal.record.parameters, **parameters},
        uncertainty={**record.uncertainty, **metal.record.uncertainty},
        evidence={**record.evidence, **metal.record.evidence},
    )


def _resting(
    session: Session,
    calibration: Calibration,
    kept: Sequence[Measurements],
    ends: tuple[float, float],
) -> RestingMetal | None:
    """What metal that moves between two times does at rest to the frames that are kept."""
    begin, end = ends[0] - MOTION_MARGIN_S, ends[1] + MOTION_MARGIN_S
    problem = _problem(session, calibration, begin, end)
    if problem is None:
        return None
    # Before it moved, or, where it moved from the start, after.
    first = min(float(tool.time[0]) for tool in session.tools)
    rest_s = 0.0 if begin > first else problem.apparatus.duration
    found = departure(problem, rest_s)
    if found is None or not found.is_predictive:
        return None
    flux, variance, power = [], [], []
    for tool in kept:
        view = tool_view(tool, (), problem.fields)
        flux.append(found.term.rest_flux(view))
        some = np.arange(0, tool.time.size, max(1, tool.time.size // UNCERTAINTY_FRAMES))
        there, sigma = found.rest_flux(view.frames(some))
        variance.append(np.mean(sigma**2))
        power.append(np.mean(np.abs(there) ** 2) / 2.0)
    if np.mean(variance) > KNOWN**2 * np.mean(power):
        return None
    return RestingMetal(tuple(flux), float(np.sqrt(np.mean(variance))), _record(found, power))


def _record(found: Departure, power: Sequence[float]) -> EffectRecord:
    """Where the metal rested and where it came, and how strong it was at rest."""
    term, rest = found.term, np.array([found.term.rest_s])
    path = np.linspace(0.0, term.duration, 8 * max(term.knots, 1))
    way = term.centres(path) - term.centres(rest)
    farthest = int(np.argmax(np.linalg.norm(way, axis=1)))
    return EffectRecord(
        term.effect.name,
        {
            'start_m': term.centres(rest)[0].tolist(),
            'way_m': way[farthest].tolist(),
            'rest_flux_rms_t': float(np.sqrt(np.mean(power))),
        },
        {},
        {'misfit_before': found.before, 'misfit_after': found.after},
    )


def _problem(
    session: Session, calibration: Calibration, begin: float, end: float
) -> Problem | None:
    """The time between two times as a problem of its own, which starts at zero."""
    scan, reference, setup = calibration.scan, session.reference, session.setup
    assert scan.sensor_fit is not None and reference is not None
    inside = (reference.time >= begin) & (reference.time <= end)
    if (~inside).sum() < FEWEST_STEADY:
        return None
    steady = np.where(reference.valid[..., None], reference.flux, np.nan)[~inside]
    known = np.isfinite(steady).all(axis=2).any(axis=0)
    baseline = np.full(steady.shape[1:], np.nan, dtype=np.complex128)
    baseline[known] = np.nanmean(steady[:, known], axis=0)
    learnt = cKDTree(np.concatenate([m.placed()[0].reshape(-1, 3) for m in scan.measurements]))
    errors_of = scan.sensor_fit.errors_of
    tools = [
        _near(learnt, _between(errors_of(tool.body, tool.session).apply(tool), begin, end))
        for tool in session.tools
    ]
    accuracy = replace(scan.accuracy, flux_noise_t=scan.sensor_fit.noise_t)
    noise = float(np.hypot(scan.sensor_fit.noise_t, calibration.model.flux_error_t))
    try:
        return build_problem(
            tools, _between(reference, begin, end), baseline, calibration.model,
            NominalBoard.of(setup).model, Spread(noise, accuracy),
        )  # fmt: skip
    except DiagnosisError:
        return None  # too few frames with a pose


def _near(learnt: cKDTree, tool: Measurements) -> Measurements:
    """The frames with a pose in which all coils are near where the field was learnt."""
    posed = tool.frames(tool.has_pose)
    distance, _ = learnt.query(posed.placed()[0])
    return posed.frames((distance < FIELD_REACH_M).all(axis=1))


def _between(measurements: Measurements, begin: float, end: float) -> Measurements:
    """The frames between two times, the first of which becomes zero."""
    inside = (measurements.time >= begin) & (measurements.time <= end)
    return shifted(measurements.frames(inside), -begin)


Sessions = Sequence[Session]


@dataclass(frozen=True)
class Engine:
    """Describes one way to calibrate; of several, the first that accepts sessions fits them."""

    accepts: Callable[[Sessions, Options], bool]
    fit: Callable[[Sessions, Options, Progress | None], Calibration]
    # Whether it finds field, sensors and poses of few frames of many sensors jointly.
    is_joint: bool = False
    kinds: tuple[str, ...] = ()  # of errors that no scan shows, estimated only when named
    needs: str = ''  # what they can be determined from, in words


def generator_of(setup: Setup) -> Generator:
    """Return where the setup's coils are; their side from the geometry, or from their spacing."""
    centres = np.array([coil.centre_m for coil in setup.emitter.coils])
    turns = np.array([coil.rotation_deg for coil in setup.emitter.coils])
    side = setup.emitter.geometry.get('side_m')
    if not isinstance(side, int | float) or not side > 0:
        gaps = np.linalg.norm(centres[:, None] - centres[None], axis=2)
        gaps = gaps[gaps > 0.0]
        side = float(gaps.min()) if gaps.size else 0.1
    return Generator(centres, turns, float(side), setup.emitter_names, setup.frequencies_hz)


def at_constant_strength(
    sessions: Sessions, options: Options
) -> tuple[list[Session], list[EffectRecord]]:
    """Return sessions as emitters that do not drift would have given them, and which of them do.

    They are as they were recorded where nothing is estimated.
    """
    found, records = [], list[EffectRecord]()
    for session in sessions:
        reference = session.reference
        if options.estimate and reference is not None:
            strength = disturbances.emitter_strength(reference)
            if (strength != 1.0).any():
                tools = tuple(
                    disturbances.at_strength(m, reference.time, strength) for m in session.tools
                )
                constant = disturbances.at_strength(reference, reference.time, strength)
                session = replace(session, tools=tools, reference=constant)
                records += drift_records(strength)
        found.append(session)
    return found, records


def _fit_as_scan(
    sessions: Sessions, options: Options, progress: Progress | None = None
) -> Calibration:
    """Fit on all tool sensors of the sessions, and once more without metal that rested nearby."""
    sessions, drifts = at_constant_strength(sessions, options)
    tools = [
        [_with_readings(session.setup, tool) for tool in session.tools] for session in sessions
    ]
    check_single_coils(measurements := [tool for own in tools for tool in own])
    setup = sessions[0].setup
    generator = replace(generator_of(setup), nominal=NominalBoard.of(setup).model)
    around = ASIDE * generator.side_m * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    places = (generator.centres[:, None] + around).reshape(-1, 3)
    wrong = scan_faults([with_pose(m) for m in measurements], places)
    if not wrong:
        _check_alike(sessions, [[with_pose(m) for m in own] for own in tools], places)
    measurements = [rightly_wired(m, wrong) for m in measurements]
    names = [Path(session.path).name for session in sessions for _ in session.tools]
    steady = [_steady(session, tool) for session in sessions for tool in session.tools]
    scan = correct_scan(measurements, generator, options, progress, steady)
    scan = _with_faults(scan, wrong)
    calibration = fit_scan(scan, names, generator, options, progress)
    bare = without_resting_metal(sessions, calibration, progress)
    if bare is not None:
        same = replace(options, layout=calibration.layout)
        calibration = fit_scan(bare, names, generator, same, progress)
    # Who says what to fit, or that nothing is to be found of sensors, gets that, with its error.
    if options.layout is None and options.estimate:
        check_explained(calibration, setup.accuracy.optical_position_m)
    scan = calibration.scan
    scan = replace(scan, reported_effects=(*scan.reported_effects, *drifts))
    model = at_start(calibration.model) if drifts else calibration.model
    words = [
        f'{wiring_words(term, sessions[0].sensors, setup.emitter_names)}, according to the scan '
        'itself, and the model corrects it: correct the wiring, or what is stated'
        for term in wrong
    ]
    doubts = (*calibration.contradictions, *words)
    return replace(calibration, model=model, scan=scan, contradictions=doubts)


def _with_readings(setup: Setup, tool: Measurements) -> Measurements:
    """The tool without what sensors say that read nothing."""
    return replace(tool, valid=tool.valid & ~unread(setup, tool))


def _check_alike(
    sessions: Sessions, tools: Sequence[Sequence[Measurements]], places: Array
) -> None:
    """Raise `FitError` where a session is wired or mounted otherwise than the others."""
    there = [k for k, own in enumerate(tools) if any(m.usable.any() for m in own)]
    number, wrong = session_faults([tools[k] for k in there], places) if there[1:] else (0, [])
    if wrong:
        one, paths = sessions[there[number]], [str(sessions[k].path) for k in there]
        told = ', '.join(wiring_words(t, one.sensors, one.setup.emitter_names) for t in wrong)
        which = f'{one.path}: unlike in the other sessions, {told}'
        if not paths[2:]:  # neither is known to be right
            which = f'{" and ".join(paths)} contradict each other: in one of them, {told}'
        raise FitError(f'{which}. Correct its poses, stated axes or wiring, or omit it')


def _with_faults(scan: Scan, faults: Sequence[Term]) -> Scan:
    """The scan with what its wiring was found to be, in the order of the readings' way."""
    records = [term.effect.record(term, np.zeros((0, 0))) for term in faults]
    tables = [r for r in records if effect_named(r.name).remedy is Remedy.SENSORS]
    signs = [r for r in records if r not in tables]
    return replace(scan, corrections=(*tables, *scan.corrections, *signs))


def check_explained(
    calibration: Calibration, pose_error_m: float = Accuracy.optical_position_m
) -> None:
    """Raise `FitError` where a model leaves so much of the readings that it is none: of most of
    them, or where parts of the scan are predicted by the others, by more than an error of the
    poses as is stated, along each axis, makes of them.
    """
    left = calibration.residuals
    share, apart = left.unexplained, rms(calibration.held_out.error) / left.read_t
    if apart > max(MOST_UNEXPLAINED, share) and apart > SIGMAS * _by_poses(
        calibration, pose_error_m
    ):
        share = apart
    if share > MOST_UNEXPLAINED:
        raise FitError(
            f'no field explains the scan: {100 * share:.0f} % of the signal is left. Are axes, '
            'places or poses stated wrongly, coils exchanged, or was a source or sensor put '
            'elsewhere in between? What stands differently belongs into sessions of its own'
        )


def _by_poses(calibration: Calibration, pose_error_m: float) -> float:
    """Return the share of the field that an error of the poses along an axis, m, changes."""
    share = 0.0
    for one in calibration.scan.measurements:
        points, axes = one.placed()
        here = calibration.model.flux(points, axes)
        for way in pose_error_m * np.eye(3):
            share = max(share, rms(calibration.model.flux(points + way, axes) - here) / rms(here))
    return share


def _steady(session: Session, tool: Measurements) -> Booleans:
    """Which frames of a tool lie outside the times in which the session's references changed."""
    if session.reference is None:
        return np.ones(tool.time.size, dtype=bool)
    changed = disturbances.unsteady_references(session.reference)
    return disturbances.outside(tool.time, disturbances.spans_of(session.reference.time, changed))


def _fit_drawn(
    sessions: Sessions, options: Options, progress: Progress | None = None
) -> Calibration:
    """Fit the drawn board; where its field is not the readings', a free one."""
    setup = sessions[0].setup
    nominal = nominal_model(board_of(setup), FINE)
    generator = replace(generator_of(setup), nominal=nominal)
    found = fit_to_drawing(sessions, generator, options, progress)
    return _fit_as_scan(sessions, options, progress) if found is None else found


DRAWN = Engine(is_for_drawing, _fit_drawn)
"""Calibrates what leaves a free field open, with the drawn board as the prior."""
SCAN = Engine(lambda sessions, options: True, _fit_as_scan)
"""Calibrates any sessions: a scan of the volume, with or without a nominal model."""


@functools.cache
def all_engines() -> tuple[Engine, ...]:
    """Return what calibrates, in the order of asking; the last, a scan's, accepts everything."""
    return (*itertools.chain(*extensions.loaded('ENGINES')), DRAWN, SCAN)


def named_kinds() -> tuple[str, ...]:
    """Return the kinds of errors that are looked for only when they are named."""
    return (*EXTRA_KINDS, *(kind for engine in all_engines() for kind in engine.kinds))


def check_same_board(sessions: list[Session]) -> None:
    """Raise `FitError` when two sessions' setups have other emitters, or sensors of a body."""
    first, stated = sessions[0], dict[str, str]()
    for other in sessions:
        for body in (tool.body for tool in other.tools):
            own = other.setup.identity.bodies[body]
            if stated.setdefault(body, own) != own:
                raise FitError(f'{other.path} states other sensors of {body} than sessions before')
        mine, theirs = first.setup.emitter, other.setup.emitter
        if theirs != mine:
            pairs = zip(mine.coils, theirs.coils, strict=False)
            coils = (f'coil {a.name}: {a} and {b}' for a, b in pairs if a != b)
            counts = f'the number of coils, {len(mine.coils)} and {len(theirs.coils)}'
            alike = len(mine.coils) == len(theirs.coils)
            raise FitError(
                f'all sessions must be of one board: {first.path} and {other.path} differ in '
                f'{next(coils, "the geometry of the coils") if alike else counts}'
            )


def calibrate_sessions(
    sessions: Sequence[Session],
    options: Options,
    progress: Callable[[str, float], None] | None = None,
) -> Calibration:
    """Calibrate on all tool sensors of the sessions.

    Reference sensors are left out: their stated places are less accurate than the field model
    becomes; what they read is kept with the model, for baselines to be compared. The first
    session's setup states how accurate fluxes and poses are. A session of several mountings counts
    as several.
    """
    sessions = [part for session in sessions for part in session.mountings()]
    setup = sessions[0].setup
    for session in sessions:
        for name, often in silent(session.setup, session.tools).items():
            dead = f'{name} gives nothing but noise{often}: is it dead?'
            raise FitError(f'{session.path}: {dead} mend it, or leave it out, or that time')
    surveyed_m = setup.stated.get('tool_coil_position_m', options.surveyed_m)
    options = replace(options, accuracy=setup.accuracy, surveyed_m=surveyed_m)
    chosen = next(engine for engine in all_engines() if engine.accepts(sessions, options))
    for engine in () if chosen.is_joint else all_engines():
        if asked := [kind for kind in options.estimate if kind in engine.kinds]:
            raise FitError(f'{", ".join(asked)}: can be determined only from {engine.needs}')
    try:
        calibration = chosen.fit(sessions, options, progress)
    except FitError as error:
        usual = replace(options, layout=None, estimate=KINDS)
        if chosen is DRAWN or not DRAWN.accepts(sessions, usual):
            raise
        words = '; the drawn board, which such readings suffice for, is fitted without --dipoles'
        raise FitError(f'{error}{words} and --estimate none') from error
    model = calibration.model
    for session in sessions:
        model = made_for(model, session.setup)
    steady, _ = at_constant_strength(sessions, options)
    kept = next((r for r in map(readings_of, steady) if r is not None), None)
    doubts = (*calibration.contradictions, *_noise_words(calibration, setup))
    return replace(calibration, model=replace(model, references=kept), contradictions=doubts)


def _noise_words(calibration: Calibration, setup: Setup) -> list[str]:
    """Words where the noise, all that says in T how large fluxes are, is not what is stated, and
    where the poses jitter by what no tracker does.
    """
    words = list[str]()
    stated, least = setup.stated.get('flux_noise_t', 0.0), calibration.held_out.flux_noise_t
    found = max(least, min(calibration.fit.noise_t, stated))  # errors of poses are in the latter
    ratio = found / stated if stated else 1.0
    if not 1.0 / TOO_LARGE < ratio < TOO_LARGE:
        unit = unit_words(ratio, FLUX_UNITS) or 'another unit than T'
        words.append(
            f'fluxes: noise of {found:.2g} T is found, {ratio:.3g} times the stated '
            f'flux_noise_t: {unit}, or is that stated wrongly?'
        )
    fit, most_m = calibration.scan.sensor_fit, setup.accuracy.optical_position_m
    if fit is not None and fit.optical.position_m > JITTER * most_m:
        words.append(
            f'poses: errors of {1e3 * fit.optical.position_m:.2g} mm are found, where '
            f'{1e3 * most_m:.2g} are stated: some stand elsewhere than they say, by a frame or '
            'fixture, or something moved'
        )
    return words
