"""Reference coils on patches that move: their clean reading follows from their pose.

Such a coil has no baseline of its own. What it should read without metal is the calibrated model's
flux where a tracker says that it is, and the tracker's error becomes noise of that reading, far
above a fixed coil's. It still tells of strong metal from where no fixed coil can be.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.fitting.model import FieldModel
from anser_ros.physics.dipole import flux_jacobian
from anser_ros.physics.sensor import SensorTable

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

MOVED_M = 3e-3
TURNED_RAD = 0.03
"""How far a coil may be from where the refit was worked out for before that is done again."""


@dataclass(frozen=True)
class PoseError:
    """Standard deviations of a patch's pose (m, rad per axis) and of its coils' gain."""

    position_m: float = 0.15e-3
    rotation_rad: float = 2e-3
    gain: float = 0.004


def clean_reading(
    model: FieldModel, coils: SensorTable, error: PoseError
) -> tuple[ComplexArray, Array]:
    """What placed coils read without metal, and how uncertain that is.

    Parameters
    ----------
    model : FieldModel
        Calibrated.
    coils : SensorTable
        Places and axes in fg.
    error : PoseError

    Returns
    -------
    flux : ndarray, shape (S, K), complex
        T.
    sigma : ndarray, shape (S,)
        Root mean square over the emitters of a component's standard deviation, T.
    """
    flux, d_position, d_axis = flux_jacobian(
        coils.position, coils.axis, coils.length, model.positions, model.directions, model.moments
    )
    power = (np.abs(error.gain * flux) ** 2).mean(axis=1)
    power += (np.abs(error.position_m * d_position) ** 2).sum(axis=1).mean(axis=1)
    # Turns across the axis only: a turn about it changes nothing.
    along = np.einsum('sa,sak->sk', coils.axis, d_axis)
    across = (np.abs(d_axis) ** 2).sum(axis=1) - np.abs(along) ** 2
    power += error.rotation_rad**2 * across.mean(axis=1)
    return flux, np.sqrt(power)


def has_moved(then: SensorTable, now: SensorTable) -> NDArray[np.bool_]:
    """Which coils are too far from where they were for what was worked out there, (S,)."""
    shift = np.linalg.norm(now.position - then.position, axis=1)
    turn = np.linalg.norm(np.cross(now.axis, then.axis), axis=1)
    opposite = (now.axis * then.axis).sum(axis=1) < 0.0
    return np.asarray((shift > MOVED_M) | (turn > TURNED_RAD) | opposite)
