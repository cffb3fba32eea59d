"""Compares tracked poses with the optical ones, and makes the figures that are quoted of that."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from anser_ros.physics.angles import axis_angles, rotation_angles
from anser_ros.pose_states import OK
from anser_ros.tracking.estimate import PoseEstimate

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PoseSeries:
    """Holds every estimate of one sensor or body, with its error where the truth is known.

    Attributes
    ----------
    name : str
        Of the sensor or body.
    estimates : tuple of PoseEstimate, length F
        One a frame.
    position_error : ndarray, shape (F,)
        Distance from the optical pose, m; NaN where there is no pose or no optical one.
    orientation_error : ndarray, shape (F,)
        Angle to the optical pose, rad: of a sensor between the axes, of a body the whole turn;
        NaN as above.
    """

    name: str
    estimates: tuple[PoseEstimate, ...]
    position_error: Array
    orientation_error: Array

    @property
    def ok(self) -> NDArray[np.bool_]:
        """Return the mask (F,) of the frames in which a pose was given."""
        return np.array([estimate.state == OK for estimate in self.estimates], dtype=bool)


def sensor_series(
    name: str, estimates: Sequence[PoseEstimate], centres: Array, axes: Array
) -> PoseSeries:
    """Compare a sensor's F poses with where it truly was, frame fg; NaN where that is not
    known.
    """
    distance, angle = np.full(len(estimates), np.nan), np.full(len(estimates), np.nan)
    for i, estimate in enumerate(estimates):
        if estimate.state == OK:
            distance[i] = np.linalg.norm(estimate.position - centres[i])
            angle[i] = axis_angles(estimate.axis, axes[i])
    return PoseSeries(name, tuple(estimates), distance, angle)


def body_series(
    name: str, estimates: Sequence[PoseEstimate], position: Array, rotation: Array
) -> PoseSeries:
    """Compare a body's F poses with the true ones, frame fg; NaN where they are not known."""
    distance, angle = np.full(len(estimates), np.nan), np.full(len(estimates), np.nan)
    for i, estimate in enumerate(estimates):
        if estimate.state == OK and estimate.rotation is not None:
            distance[i] = np.linalg.norm(estimate.position - position[i])
            angle[i] = rotation_angles(estimate.rotation.T @ rotation[i])
    return PoseSeries(name, tuple(estimates), distance, angle)


def metrics(series: PoseSeries) -> dict[str, Any]:
    """Return the figures of one sensor or body as the evaluation document has them.

    These are the number of compared poses, the share of frames with a pose, and the RMSE, mean
    error, 50th and 95th percentile (equation 7 of the article) of position and orientation; None
    where nothing could be compared.
    """
    result: dict[str, Any] = {
        'n': int(np.isfinite(series.position_error).sum()),
        'tracked_fraction': float(series.ok.mean()) if series.ok.size else 0.0,
    }
    for key, unit, errors in (
        ('position', 'm', series.position_error),
        ('orientation', 'rad', series.orientation_error),
    ):
        for statistic, value in _statistics(errors[np.isfinite(errors)]).items():
            result[f'{key}_{statistic}_{unit}'] = value
    return result


def _statistics(errors: Array) -> dict[str, float | None]:
    if not errors.size:
        return dict.fromkeys(('rmse', 'me', 'prc50', 'prc95'))
    return {
        'rmse': float(np.sqrt(np.mean(errors**2))),
        'me': float(errors.mean()),
        'prc50': float(np.percentile(errors, 50)),
        'prc95': float(np.percentile(errors, 95)),
    }
