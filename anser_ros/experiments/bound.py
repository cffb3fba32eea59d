"""Computes the Cramer-Rao bound: the smallest error of a pose that the flux noise allows."""

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.factors import as_real
from anser_ros.calibration.readings import with_pose
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import FieldModel
from anser_ros.physics.dipole import flux_jacobian

Array = NDArray[np.float64]


def position_bound(measurements: Measurements, model: FieldModel, noise_t: float) -> Array:
    """Return the least root mean square position error of unbiased estimates.

    The Fisher information of position and axis is ``J^T J / sigma^2`` (Kay, Estimation Theory,
    1993, section 3.7); the axis, a unit vector, counts in its tangent plane.

    Parameters
    ----------
    measurements : Measurements
        The poses at which the bound is wanted.
    model : FieldModel
        The field.
    noise_t : float
        Flux noise of a phasor component, T.

    Returns
    -------
    ndarray, shape (S,)
        Error of each sensor over the frames, m.
    """
    posed = with_pose(measurements)
    points, axes = posed.placed()
    frames, sensors = points.shape[:2]
    lengths = np.tile(posed.sensors.length, frames)
    _, by_place, by_axis = flux_jacobian(
        points.reshape(-1, 3), axes.reshape(-1, 3), lengths,
        model.positions, model.directions, model.moments,
    )  # fmt: skip
    across = np.linalg.svd(axes.reshape(-1, 1, 3))[2][:, 1:]
    tilt = np.einsum('pti,pik->ptk', across, by_axis)
    slope = as_real(np.concatenate([by_place, tilt], axis=1)) / noise_t
    covariance = np.linalg.inv(slope @ slope.transpose(0, 2, 1))
    variance = np.trace(covariance[:, :3, :3], axis1=1, axis2=2).reshape(frames, sensors)
    return np.asarray(np.sqrt(variance.mean(axis=0)))
