"""What a session's reference sensors read without metal, from a recording of the same board."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import BagError
from anser_ros.physics.sensor import SensorTable
from anser_ros.sessions.session import Session

ComplexArray = NDArray[np.complex128]

SAME_PLACE_M = 0.005
"""Farthest that a reference sensor may be in the baseline from where the session has it, m.

A fresh survey of the same setup moves a coil by its own error, a millimetre or less; a coil that
is farther away belongs to another setup, whose readings would be taken for metal.
"""


@dataclass(frozen=True)
class Baseline:
    """Clean readings of a session's reference sensors.

    Attributes
    ----------
    path : str
        The recording that they are from.
    flux : ndarray, shape (R, K), complex
        Mean reading of each reference sensor, T; NaN where it has none.
    """

    path: str
    flux: ComplexArray


def baseline_of(recording: Session, sensors: SensorTable) -> Baseline:
    """Clean readings of reference sensors; raises as `baseline_flux`."""
    return Baseline(recording.path, baseline_flux(recording, sensors))


def baseline_flux(baseline: Session, sensors: SensorTable) -> ComplexArray:
    """Mean reading of each reference sensor in a recording without metal.

    Parameters
    ----------
    baseline : Session
        The recording.
    sensors : SensorTable
        The R reference sensors whose readings are wanted, in the wanted order.

    Returns
    -------
    ndarray, shape (R, K), complex
        T; NaN for a sensor without a good reading.

    Raises
    ------
    BagError
        When the recording has no reference fluxes, or lacks one of the sensors, or has it at
        another place.
    """
    reference = baseline.reference
    if reference is None:
        raise BagError(f'{baseline.path}: the baseline has no reference fluxes')
    mean = np.full((len(sensors), reference.flux.shape[2]), np.nan, dtype=complex)
    for row, (channel, name) in enumerate(
        zip(sensors.channel.tolist(), sensors.name, strict=True)
    ):
        found = np.flatnonzero(reference.sensors.channel == channel)
        if found.size == 0 or reference.sensors.name[found[0]] != name:
            raise BagError(f'{baseline.path}: the baseline lacks the reference sensor {name}')
        apart = np.linalg.norm(reference.sensors.position[found[0]] - sensors.position[row])
        if apart > SAME_PLACE_M:
            raise BagError(
                f'{baseline.path}: in the baseline the reference sensor {name} is '
                f'{1e3 * apart:.0f} mm from where the session has it; is it of another setup?'
            )
        good = reference.valid[:, found[0]]
        if good.any():
            mean[row] = reference.flux[good, found[0]].mean(axis=0)
    return mean
