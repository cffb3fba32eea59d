"""Calibrates recorded sessions of one board by the first engine that accepts them."""

import functools
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from anser_ros import extensions
from anser_ros.calibration.calibrate import Options, correct_scan, fit_scan
from anser_ros.calibration.disturbances import (
    at_strength,
    emitter_strength,
    outside,
    spans_of,
    unsteady_references,
)
from anser_ros.calibration.layouts import Generator
from anser_ros.calibration.moments import Progress
from anser_ros.calibration.readings import check_single_coils
from anser_ros.calibration.result import Calibration, drift_records
from anser_ros.calibration.sensor_parameters import EXTRA_KINDS
from anser_ros.errors import FitError
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import EffectRecord
from anser_ros.sessions.baseline import readings_of
from anser_ros.sessions.nominal_board import NominalBoard
from anser_ros.sessions.scan_metal import without_resting_metal
from anser_ros.sessions.session import Session
from anser_ros.sessions.starting_model import made_for
from anser_ros.wire.setup import Setup

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
            strength = emitter_strength(reference)
            if (strength != 1.0).any():
                tools = tuple(at_strength(m, reference.time, strength) for m in session.tools)
                constant = at_strength(reference, reference.time, strength)
                session = replace(session, tools=tools, reference=constant)
                records += drift_records(strength)
        found.append(session)
    return found, records


def _fit_as_scan(
    sessions: Sessions, options: Options, progress: Progress | None = None
) -> Calibration:
    """Fit on all tool sensors of the sessions, and once more without metal that rested nearby."""
    sessions, drifts = at_constant_strength(sessions, options)
    measurements = [tool for session in sessions for tool in session.tools]
    check_single_coils(measurements)
    names = [Path(session.path).name for session in sessions for _ in session.tools]
    setup = sessions[0].setup
    generator = replace(generator_of(setup), nominal=NominalBoard.of(setup).model)
    steady = [_steady(session, tool) for session in sessions for tool in session.tools]
    scan = correct_scan(measurements, generator, options, progress, steady)
    calibration = fit_scan(scan, names, generator, options, progress)
    bare = without_resting_metal(sessions, calibration, progress)
    if bare is not None:
        same = replace(options, layout=calibration.layout)
        calibration = fit_scan(bare, names, generator, same, progress)
    scan = calibration.scan
    scan = replace(scan, reported_effects=(*scan.reported_effects, *drifts))
    return replace(calibration, scan=scan)


def _steady(session: Session, tool: Measurements) -> NDArray[np.bool_]:
    """Which frames of a tool lie outside the times in which the session's references changed."""
    if session.reference is None:
        return np.ones(tool.time.size, dtype=bool)
    changed = unsteady_references(session.reference)
    return outside(tool.time, spans_of(session.reference.time, changed))


SCAN = Engine(lambda sessions, options: True, _fit_as_scan)
"""Calibrates any sessions: a scan of the volume, with or without a nominal model."""


@functools.cache
def all_engines() -> tuple[Engine, ...]:
    """Return what calibrates, in the order of asking; the last, a scan's, accepts everything."""
    return (*itertools.chain(*extensions.loaded('ENGINES')), SCAN)


def named_kinds() -> tuple[str, ...]:
    """Return the kinds of errors that are looked for only when they are named."""
    return (*EXTRA_KINDS, *(kind for engine in all_engines() for kind in engine.kinds))


def check_same_board(sessions: list[Session]) -> None:
    """Raise `FitError` when two sessions' setups have different emitters."""
    first = sessions[0]
    for other in sessions[1:]:
        if other.setup.emitter != first.setup.emitter:
            raise FitError(
                f'all sessions must be of one board: {first.path} and {other.path} differ in '
                f'{_difference(first.setup, other.setup)}'
            )


def _difference(one: Setup, other: Setup) -> str:
    if len(one.emitter.coils) != len(other.emitter.coils):
        return f'the number of coils, {len(one.emitter.coils)} and {len(other.emitter.coils)}'
    for mine, theirs in zip(one.emitter.coils, other.emitter.coils, strict=True):
        if mine != theirs:
            return f'coil {mine.name}: {mine} and {theirs}'
    return 'the geometry of the coils'


def _engine_for(sessions: Sequence[Session], options: Options) -> Engine:
    return next(engine for engine in all_engines() if engine.accepts(sessions, options))


def is_estimated_jointly(session: Session) -> bool:
    """Return whether a session has few poses of a body of many sensors, and no drawn emitters."""
    options = Options(session.setup.accuracy, is_joint=True)
    return _engine_for([session], options).is_joint


def calibrate_sessions(
    sessions: Sequence[Session],
    options: Options,
    progress: Callable[[str, float], None] | None = None,
) -> Calibration:
    """Calibrate on all tool sensors of the sessions.

    Reference sensors are left out: their stated places are less accurate than the field model
    becomes. The first session's setup states how accurate fluxes and poses are. What the
    references of the first session that has them read is kept with the model, for baselines to be
    compared.
    """
    options = replace(options, accuracy=sessions[0].setup.accuracy)
    chosen = _engine_for(sessions, options)
    for engine in () if chosen.is_joint else all_engines():
        if asked := [kind for kind in options.estimate if kind in engine.kinds]:
            raise FitError(f'{", ".join(asked)}: can be determined only from {engine.needs}')
    calibration = chosen.fit(sessions, options, progress)
    model = calibration.model
    for session in sessions:
        model = made_for(model, session.setup)
    kept = next((r for r in map(readings_of, sessions) if r is not None), None)
    return replace(calibration, model=replace(model, references=kept))
