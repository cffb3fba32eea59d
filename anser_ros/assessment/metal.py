"""Measures the shift of a resting sensor's pose that metal near it causes."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.spatial.transform import Rotation

from anser_ros.assessment.intervals import LEVEL, IntervalEstimate, independent_for_mean
from anser_ros.assessment.stillness import point_of
from anser_ros.errors import FitError
from anser_ros.poses.sequence import PoseSequence

Array = NDArray[np.float64]

FEWEST_REST_POSES = 10  # poses of a rest, without which its mean has no uncertainty


def metal_shifts(
    base: PoseSequence, others: Sequence[tuple[str, PoseSequence]]
) -> dict[str, IntervalEstimate]:
    """Return distance (m) and angle (rad) of each recording's mean pose from that without metal.

    The interval is of the distance: the shift's own uncertainty along it (errors that are alike in
    time count once), and never below zero.

    Raises
    ------
    FitError
        When a recording has too few poses.
    """
    found = {}
    first = _mean(base)
    for name, poses in others:
        second = _mean(poses)
        for k, unit in ((0, 'm'), (1, 'rad')):
            if k == 0:
                shift = second[0] - first[0]
            else:
                turn = Rotation.from_matrix(first[1]).inv() * Rotation.from_matrix(second[1])
                shift = turn.as_rotvec()
            sigma = float(np.sqrt(np.max(first[2 + k] + second[2 + k])))
            size = float(np.linalg.norm(shift))
            wide = float(stats.norm.ppf(0.5 + LEVEL / 2)) * sigma
            what = 'position' if k == 0 else 'orientation'
            found[f'{what}_shift_{name}_{unit}'] = IntervalEstimate(
                size, max(size - wide, 0), size + wide
            )
    return found


def _mean(poses: PoseSequence) -> tuple[Array, Array, Array, Array]:
    """Mean position and rotation, and the variances of both by axis."""
    if poses.size < FEWEST_REST_POSES:
        raise FitError(
            f'{poses.name}: a tool at rest needs at least {FEWEST_REST_POSES} poses, '
            f'got {poses.size}'
        )
    point = point_of(poses)
    turns = Rotation.from_quat(poses.quaternion)
    angles = (Rotation.from_matrix(point.rotation).inv() * turns).as_rotvec()
    variances = [
        np.array([np.var(v[:, k]) / independent_for_mean(v[:, k]) for k in range(3)])
        for v in (poses.position, angles)
    ]
    return point.position, point.rotation, variances[0], variances[1]
