"""Calibrates recorded sessions of one board by the first engine that accepts them."""

from collections.abc import Callable, Sequence
from dataclasses import replace

from anser_ros.calibration.calibrate import Options
from anser_ros.calibration.result import Calibration
from anser_ros.calibration.sensor_parameters import EXTRA_KINDS
from anser_ros.errors import FitError
from anser_ros.sessions.baseline import readings_of
from anser_ros.sessions.calibration_engine import SCAN, Engine
from anser_ros.sessions.session import Session
from anser_ros.sessions.starting_model import made_for
from anser_ros.sessions.still_engines import ENGINES as STILL_ENGINES
from anser_ros.wire.setup import Setup

ENGINES: tuple[Engine, ...] = (*STILL_ENGINES, SCAN)
"""What calibrates, in the order of asking; the last accepts everything."""
NAMED_KINDS = (*EXTRA_KINDS, *(kind for engine in ENGINES for kind in engine.kinds))
"""Kinds of errors that are looked for only when they are named."""


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


def _engine_for(
    sessions: Sequence[Session], options: Options, engines: Sequence[Engine]
) -> Engine:
    return next(engine for engine in engines if engine.accepts(sessions, options))


def is_estimated_jointly(session: Session) -> bool:
    """Return whether a session has few poses, or one place, of a body of many sensors.

    Emitters that can be drawn are left to a model of their drawing, whatever the session.
    """
    options = Options(session.setup.accuracy, is_joint=True)
    return _engine_for([session], options, ENGINES).is_joint


def calibrate_sessions(
    sessions: Sequence[Session],
    options: Options,
    progress: Callable[[str, float], None] | None = None,
    engines: Sequence[Engine] = ENGINES,
) -> Calibration:
    """Calibrate on all tool sensors of the sessions.

    Reference sensors are left out: their stated places are less accurate than the field model
    becomes. The first session's setup states how accurate fluxes and poses are. What the
    references of the first session that has them read is kept with the model, for baselines to be
    compared.
    """
    options = replace(options, accuracy=sessions[0].setup.accuracy)
    chosen = _engine_for(sessions, options, engines)
    for engine in () if chosen.is_joint else engines:
        if asked := [kind for kind in options.estimate if kind in engine.kinds]:
            raise FitError(f'{", ".join(asked)}: can be determined only from {engine.needs}')
    calibration = chosen.fit(sessions, options, progress)
    model = calibration.model
    for session in sessions:
        model = made_for(model, session.setup)
    kept = next((r for r in map(readings_of, sessions) if r is not None), None)
    return replace(calibration, model=replace(model, references=kept))
