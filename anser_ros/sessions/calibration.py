"""Calibrates recorded sessions: boards checked, tools gathered, the drawing as a prior."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.calibrate import Options, fit_scan, survey
from anser_ros.calibration.disturbances import outside, spans_of, unsteady_references
from anser_ros.calibration.emitter_drift import at_strength, emitter_strength
from anser_ros.calibration.layouts import Generator
from anser_ros.calibration.one_place import calibrate_at_one_place, is_at_one_place
from anser_ros.calibration.requirements import (
    FEWEST_FRAMES_OF_MANY,
    FEWEST_SCAN_FRAMES,
    MANY_SENSORS,
    check_single_coils,
)
from anser_ros.calibration.result import Calibration, Scan
from anser_ros.calibration.still import STILL_ONLY, calibrate_still, is_still
from anser_ros.calibration.survey_records import drift_records
from anser_ros.errors import FitError
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import EffectRecord
from anser_ros.sessions.baseline import readings_of
from anser_ros.sessions.drawing import NominalBoard
from anser_ros.sessions.scan_metal import without_resting_metal
from anser_ros.sessions.session import Session
from anser_ros.sessions.starting_model import made_for
from anser_ros.wire.setup import Setup


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


def generator_of(setup: Setup) -> Generator:
    """Return where the setup's coils are; their side from the geometry, or from their spacing."""
    centres = np.array([coil.centre_m for coil in setup.emitter.coils])
    turns = np.array([coil.rotation_deg for coil in setup.emitter.coils])
    side = setup.emitter.geometry.get('side_m')
    if not isinstance(side, int | float) or not side > 0:
        gaps = np.linalg.norm(centres[:, None] - centres[None], axis=2)
        gaps = gaps[gaps > 0.0]
        side = float(gaps.min()) if gaps.size else 0.1
    return Generator(centres, turns, float(side))


def is_estimated_jointly(session: Session) -> bool:
    """Return whether a session has few poses, or one place, of a body of many sensors.

    Emitters that can be drawn are left to a model of their drawing, whatever the session.
    """
    if NominalBoard.of(session.setup).model is not None:
        return False
    tools = session.tools
    return is_still(tools) or is_at_one_place(tools, session.setup.accuracy)


def calibrate_sessions(
    sessions: list[Session],
    options: Options,
    progress: Callable[[str, float], None] | None = None,
    is_joint: bool = False,
) -> Calibration:
    """Calibrate on all tool sensors of the sessions.

    Reference sensors are left out: their survey is less accurate than the field model becomes. The
    first session's setup states how accurate fluxes and poses are. What the references of the
    first session that has them read is kept with the model, for baselines to be compared. With
    ``is_joint``, few poses of many sensors are fitted jointly (`still`) though nothing is looked
    for.
    """
    setup, drifts = sessions[0].setup, []
    if options.estimate:
        constant = [_at_constant_strength(session) for session in sessions]
        sessions = [session for session, _ in constant]
        drifts = [record for _, records in constant for record in records]
    measurements = [tool for session in sessions for tool in session.tools]
    names = [Path(session.path).name for session in sessions for _ in session.tools]
    options = replace(options, accuracy=setup.accuracy)
    generator, nominal = generator_of(setup), NominalBoard.of(setup).model
    alone = options.layout is None and nominal is None
    if alone and is_at_one_place(measurements, options.accuracy):
        found = calibrate_at_one_place(
            measurements[0], names[0], setup.emitter_names, setup.frequencies_hz,
            options.estimate, options.accuracy, progress,
        )  # fmt: skip
        return _for_sessions(found, sessions)
    check_single_coils(measurements)
    if (options.estimate or is_joint) and alone and is_still(measurements):
        if options.damping is not None:
            raise FitError(
                'damping: few poses of many sensors are fitted with sizes of moments that the '
                'readings give; only --estimate none takes a damping'
            )
        still = calibrate_still(
            measurements[0], names[0], generator, setup.emitter_names, setup.frequencies_hz,
            options.estimate, options.accuracy, progress,
        )  # fmt: skip
        return _for_sessions(still, sessions)
    if asked := [kind for kind in options.estimate if kind in STILL_ONLY]:
        raise FitError(
            f'{", ".join(asked)}: can be determined only from {FEWEST_FRAMES_OF_MANY} to '
            f'{FEWEST_SCAN_FRAMES - 1} poses of one body with at least {MANY_SENSORS} sensors, '
            'over emitters without a drawing, and with no layout of dipoles stated'
        )
    steady = [_steady(session, tool) for session in sessions for tool in session.tools]
    scan = survey(measurements, generator, options, nominal, progress, steady)
    scan = replace(scan, reported_effects=(*scan.reported_effects, *drifts))

    def fitted(scan: Scan, options: Options) -> Calibration:
        return fit_scan(
            scan, names, generator, setup.emitter_names, setup.frequencies_hz, options, nominal,
            progress,
        )  # fmt: skip

    calibration = fitted(scan, options)
    bare = without_resting_metal(sessions, calibration, progress)
    if bare is not None:
        calibration = fitted(bare, replace(options, layout=calibration.layout))
    return _for_sessions(calibration, sessions)


def _for_sessions(calibration: Calibration, sessions: list[Session]) -> Calibration:
    """A calibration whose model knows its sessions' setups, and what the references read."""
    model = calibration.model
    for session in sessions:
        model = made_for(model, session.setup)
    kept = next((r for r in map(readings_of, sessions) if r is not None), None)
    return replace(calibration, model=replace(model, references=kept))


def _at_constant_strength(session: Session) -> tuple[Session, tuple[EffectRecord, ...]]:
    """A session as emitters that do not drift would have given it, and which of them do."""
    reference = session.reference
    if reference is None:
        return session, ()
    strength = emitter_strength(reference)
    if (strength == 1.0).all():
        return session, ()
    tools = tuple(at_strength(tool, reference.time, strength) for tool in session.tools)
    constant = at_strength(reference, reference.time, strength)
    return replace(session, tools=tools, reference=constant), drift_records(strength)


def _steady(session: Session, tool: Measurements) -> NDArray[np.bool_]:
    """Which frames of a tool lie outside the times in which the session's references changed."""
    if session.reference is None:
        return np.ones(tool.time.size, dtype=bool)
    changed = unsteady_references(session.reference)
    return outside(tool.time, spans_of(session.reference.time, changed))
