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
    """Holds the estimates of one sensor or body, one a frame, and their errors where known."""

    name: str
    estimates: tuple[PoseEstimate, ...]
    position_error: Array
    orientation_error: Array

    @property
    def ok(self) -> NDArray[np.bool_]:
        """Return the mask (F,) of the frames in which a pose was given."""
        return np.array([estimate.state == OK for estimate in self.estimates], dtype=bool)


def pose_series(
    name: str, estimates: Sequence[PoseEstimate], position: Array, orientation: Array
) -> PoseSeries:
    """Compare F poses of a sensor or body with where it truly was, m, frame fg; NaN if unknown."""
    of_body = orientation.ndim == 3
    distance, angle = np.full(len(estimates), np.nan), np.full(len(estimates), np.nan)
    for i, estimate in enumerate(estimates):
        if estimate.state != OK or (of_body and estimate.rotation is None):
            continue
        distance[i] = np.linalg.norm(estimate.position - position[i])
        if of_body:
            assert estimate.rotation is not None
            angle[i] = rotation_angles(estimate.rotation.T @ orientation[i])
        else:
            angle[i] = axis_angles(estimate.axis, orientation[i])
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
