"""The field of the simulated board."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from anser_ros.physics.dipole import field_basis
from anser_ros.simulation.world import FieldSource
from anser_ros.wire.setup import Setup

_TURNS_AREA_M2 = 25 * 0.0615**2


def board_source(setup: Setup) -> FieldSource:
    """One vertical dipole an emitter, of the moment of its turns at nominal current."""
    centres = np.array([coil.centre_m for coil in setup.emitter.coils])
    up = np.broadcast_to([0.0, 0.0, 1.0], centres.shape)
    moment = _TURNS_AREA_M2 * float(setup.emitter.geometry.get('current_a', 0.25))

    def field(points: NDArray[np.float64]) -> NDArray[np.complex128]:
        return np.asarray(moment * field_basis(points, centres, up).transpose(0, 2, 1), complex)

    return field
