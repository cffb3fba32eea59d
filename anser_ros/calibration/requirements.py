"""What measurements must be for a field model to be determined by them."""

from collections.abc import Callable, Sequence

import numpy as np

from anser_ros.calibration.layout_fit import LayoutFit
from anser_ros.calibration.moments import MomentFit
from anser_ros.errors import FitError
from anser_ros.field.measurements import Measurements

FEWEST_FRAMES = 10
FLATTEST = 0.002
"""Thickness (rms) of the cloud of sensors that the fit needs, as a part of its extent."""
THINNEST_M = 2e-4
"""The same in metres: what the jitter of the poses alone would feign, thrice."""
DISAGREEMENT = 10.0
"""Sessions whose common fit leaves this many times what each alone leaves: different boards."""


def check_measurements(measurements: Sequence[Measurements], needed: int) -> int:
    """Refuse what can't determine a field model; returns the number of readings an emitter.

    Raises
    ------
    FitError
        With the number needed and the number found: frames with a pose, readings, thickness.
    """
    if not measurements:
        raise FitError(
            f'a calibration needs at least {FEWEST_FRAMES} frames of tool fluxes with poses, '
            'got 0: no session has tool fluxes'
        )
    for m in measurements:
        if not m.has_pose.any():
            raise FitError(
                f'{m.body}: a calibration needs at least {FEWEST_FRAMES} frames with a pose, '
                f'got 0 of {len(m.time)} (is /optical/{m.body}/pose recorded?)'
            )
    frames = sum(int(m.usable.any(axis=1).sum()) for m in measurements)
    if frames < FEWEST_FRAMES:
        raise FitError(
            f'a calibration needs at least {FEWEST_FRAMES} frames with poses and valid fluxes, '
            f'got {frames}'
        )
    readings = sum(int(m.usable.sum()) for m in measurements)
    if readings < needed:
        raise FitError(
            f'{needed} dipoles need at least {needed} readings an emitter, got {readings}'
        )
    _check_thickness(measurements)
    return readings


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
    joint: MomentFit,
    fit_part: Callable[[list[Measurements]], LayoutFit],
) -> None:
    """Refuse sessions that one field can't explain.

    Parameters
    ----------
    measurements, names
        One session's name for each set of measurements.
    joint : MomentFit
        Fit of all together.
    fit_part : callable
        Fits some of the measurements alone in the same way.

    Raises
    ------
    FitError
        When the common fit leaves `DISAGREEMENT` times what the sessions leave alone.
    """
    sessions = list(dict.fromkeys(names))
    if len(sessions) < 2:
        return
    alone = [
        fit_part([m for m, name in zip(measurements, names, strict=True) if name == session])
        for session in sessions
    ]
    worst = max(part.fit.noise_t for part in alone)
    if joint.noise_t > DISAGREEMENT * worst:
        raise FitError(
            f'the sessions are of different boards: one field leaves {joint.noise_t:.3g} T, '
            f'more than {DISAGREEMENT:g} times the {worst:.3g} T that each leaves alone'
        )
