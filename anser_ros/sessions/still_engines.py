"""Calibrates bodies of many sensors that hardly move, and magnets, beside the usual scans."""

from collections.abc import Callable, Sequence
from pathlib import Path

from anser_ros.calibration.calibrate import Options
from anser_ros.calibration.moments import Progress
from anser_ros.calibration.one_place import calibrate_at_one_place, is_at_one_place
from anser_ros.calibration.requirements import (
    FEWEST_FRAMES_OF_MANY,
    FEWEST_SCAN_FRAMES,
    MANY_SENSORS,
    check_single_coils,
)
from anser_ros.calibration.result import Calibration
from anser_ros.calibration.source_size import with_source_sizes
from anser_ros.calibration.still import STILL_ONLY, calibrate_still, is_still
from anser_ros.errors import FitError
from anser_ros.field.measurements import Measurements
from anser_ros.sessions.calibration_engine import SCAN, Engine, at_constant_strength, generator_of
from anser_ros.sessions.drawing import NominalBoard
from anser_ros.sessions.session import Session


def _tools(sessions: Sequence[Session]) -> list[Measurements]:
    return [tool for session in sessions for tool in session.tools]


def _is_free(sessions: Sequence[Session], options: Options) -> bool:
    """Whether nothing says where the emitters' field comes from."""
    return options.layout is None and NominalBoard.of(sessions[0].setup).model is None


def _accepts_one_place(sessions: Sequence[Session], options: Options) -> bool:
    return is_at_one_place(_tools(sessions), options.accuracy) and _is_free(sessions, options)


def _accepts_still(sessions: Sequence[Session], options: Options) -> bool:
    is_asked = bool(options.estimate) or options.is_joint
    return is_asked and is_still(_tools(sessions)) and _is_free(sessions, options)


def _fitted(
    calibrate: Callable[..., Calibration],
    sessions: Sequence[Session],
    options: Options,
    progress: Progress | None,
) -> Calibration:
    sessions, _ = at_constant_strength(sessions, options)
    (tool,) = _tools(sessions)
    session = next(one for one in sessions if one.tools)
    return calibrate(
        tool, Path(session.path).name, generator_of(sessions[0].setup), options.estimate,
        options.accuracy, progress,
    )  # fmt: skip


def _fit_one_place(
    sessions: Sequence[Session], options: Options, progress: Progress | None = None
) -> Calibration:
    return _fitted(calibrate_at_one_place, sessions, options, progress)


def _fit_still(
    sessions: Sequence[Session], options: Options, progress: Progress | None = None
) -> Calibration:
    check_single_coils(_tools(sessions))
    if options.damping is not None:
        raise FitError(
            'damping: few poses of many sensors are fitted with sizes of moments that the '
            'readings give; only --estimate none takes a damping'
        )
    return _fitted(calibrate_still, sessions, options, progress)


def _fit_with_sizes(
    sessions: Sequence[Session], options: Options, progress: Progress | None = None
) -> Calibration:
    return with_source_sizes(SCAN.fit(sessions, options, progress))


ENGINES = (
    Engine(_accepts_one_place, _fit_one_place, is_joint=True),
    Engine(
        _accepts_still,
        _fit_still,
        True,
        STILL_ONLY,
        f'{FEWEST_FRAMES_OF_MANY} to {FEWEST_SCAN_FRAMES - 1} poses of one body with at least '
        f'{MANY_SENSORS} sensors, over emitters without a drawing, and with no layout of dipoles '
        'stated',
    ),
    Engine(SCAN.accepts, _fit_with_sizes),
)
"""In their order: a body of many sensors at one place, at a few poses, and any scan, with the
sizes of emitters without a drawing."""
