"""Calibrates recorded sessions of one board by the first engine that accepts them."""

import functools
import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace

from anser_ros import extensions
from anser_ros.calibration.calibrate import Options
from anser_ros.calibration.result import Calibration
from anser_ros.calibration.sensor_parameters import EXTRA_KINDS
from anser_ros.errors import FitError
from anser_ros.sessions.baseline import readings_of
from anser_ros.sessions.calibration_engine import SCAN, Engine
from anser_ros.sessions.session import Session
from anser_ros.sessions.starting_model import made_for
from anser_ros.wire.setup import Setup


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
    """Return whether a session has few poses, or one place, of a body of many sensors.

    Emitters that can be drawn are left to a model of their drawing, whatever the session.
    """
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
