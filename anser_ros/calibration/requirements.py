"""Checks requirements that measurements must meet to determine a field model."""

from collections.abc import Callable, Sequence

import numpy as np

from anser_ros.errors import FitError
from anser_ros.field.measurements import Measurements

FEWEST_SCAN_FRAMES = 10
"""Frames with poses below which no calibration is tried. It only catches recordings that are
empty or cut; how many readings a model needs depends on its dipoles."""
FEWEST_FRAMES_OF_MANY, MANY_SENSORS = 3, 30
"""Frames that do where a body has many sensors: each of them is another reading. With fewer poses
none could be held out and the others still tell how the field changes between them."""
FLATTEST = 0.002
"""Least thickness (rms) of the cloud of sensor positions, as a fraction of its extent (rms). In a
flatter cloud the field's change across it is not determined."""
THINNEST_M = 2e-4
"""Least thickness (rms), m: three times the jitter of the poses, which makes a flat cloud look
thick."""
DISAGREEMENT = 10.0
"""Ratio of the residual of a common fit to that of each session alone from which on the sessions
count as recorded with different boards. Sessions of one board have a ratio near one."""


def check_measurements(
    measurements: Sequence[Measurements], needed: int, field_alone: bool = False
) -> int:
    """Check that measurements determine a field model.

    ``needed``: number of readings per emitter that the dipoles need. ``field_alone``: whether
    nothing is estimated of the sensors, so that few poses of many sensors do.
    Returns the number of readings per emitter.
    Raises `FitError` when there are too few frames with a pose or too few readings, or all
    readings lie in one plane; the message has the number needed and the number found.
    """
    if not measurements:
        raise FitError(
            f'a calibration needs at least {FEWEST_SCAN_FRAMES} frames of tool fluxes with poses, '
            'got 0: no session has tool fluxes'
        )
    for m in measurements:
        if not m.has_pose.any():
            raise FitError(
                f'{m.body}: a calibration needs at least {FEWEST_SCAN_FRAMES} frames with a pose, '
                f'got 0 of {len(m.time)} (is /optical/{m.body}/pose recorded?)'
            )
    frames = usable_frames(measurements)
    many = all(len(m.sensors) >= MANY_SENSORS for m in measurements)
    fewest = FEWEST_FRAMES_OF_MANY if many and field_alone else FEWEST_SCAN_FRAMES
    if frames < fewest:
        hint = ''
        if many and frames >= FEWEST_FRAMES_OF_MANY:
            hint = '; --estimate none fits the field alone to so few poses of so many sensors'
        raise FitError(
            f'a calibration needs at least {fewest} frames with poses and valid fluxes, '
            f'got {frames}{hint}'
        )
    readings = sum(int(m.usable.sum()) for m in measurements)
    if readings < needed:
        raise FitError(
            f'{needed} dipoles need at least {needed} readings per emitter, got {readings}'
        )
    _check_thickness(measurements)
    return readings


def check_single_coils(measurements: Sequence[Measurements]) -> None:
    """Raise `FitError` when a sensor is a sum of windings: only a body at one place may have
    them.
    """
    for m in measurements:
        rows = np.flatnonzero(~m.sensors.is_single)
        if rows.size:
            raise FitError(
                f'{m.sensors.name[rows[0]]} has windings: such sensors are calibrated only on a '
                f'body of at least {MANY_SENSORS} sensors that rests at one place, over emitters '
                'without a drawing'
            )


def check_kept(
    measurements: Sequence[Measurements], kept: Sequence[Measurements], needed: int
) -> None:
    """Check that the frames that a fit of sensors kept still determine a field model.

    Raises `FitError` when too little is left; the message has how many frames were left out, and
    why.
    """
    try:
        check_measurements([m for m in kept if len(m.time)], needed)
    except FitError as error:
        before, after = usable_frames(measurements), usable_frames(kept)
        raise FitError(
            f'{before - after} of {before} frames were left out, because their poses contradict '
            f'their fluxes or something moved; of the others: {error}'
        ) from error


def usable_frames(measurements: Sequence[Measurements]) -> int:
    """Return the number of frames with a pose and a valid reading."""
    return sum(int(m.usable.any(axis=1).sum()) for m in measurements)


def _check_thickness(measurements: Sequence[Measurements]) -> None:
    points = np.concatenate([m.placed()[0][m.usable] for m in measurements])
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) / np.sqrt(len(points))
    need = max(FLATTEST * float(spread[0]), THINNEST_M)
    if spread[-1] < need:
        raise FitError(
            f'all readings lie in one plane: their spread across it must be at least '
            f'{1e3 * need:.2f} mm rms, got {1e3 * spread[-1]:.2f} mm'
        )


def check_agreement(
    measurements: Sequence[Measurements],
    names: Sequence[str],
    noise_t: float,
    noise_of: Callable[[list[Measurements]], float],
) -> None:
    """Check that one field explains all sessions.

    Raises `FitError` when the residual ``noise_t`` of the common fit is more than `DISAGREEMENT`
    times the largest one of the sessions alone, by ``noise_of``.
    """
    sessions = list(dict.fromkeys(names))
    if len(sessions) < 2:
        return
    worst = max(
        noise_of([m for m, name in zip(measurements, names, strict=True) if name == session])
        for session in sessions
    )
    if noise_t > DISAGREEMENT * worst:
        raise FitError(
            'the sessions are of different boards: the residual of one field for all is '
            f'{noise_t:.3g} T, more than {DISAGREEMENT:g} times the {worst:.3g} T of a '
            'field for each'
        )
