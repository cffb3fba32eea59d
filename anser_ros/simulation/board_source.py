"""The field of the simulated board: Biot and Savart's law over all tracks of the setup's coils."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from anser_ros.physics.board import build_board
from anser_ros.simulation.world import FieldSource
from anser_ros.wire.setup import Setup


def board_source(setup: Setup) -> FieldSource:
    """Field of the setup's own board, without the dipoles that the tracker models it by.

    Raises
    ------
    SetupError
        When the setup's geometry makes no board.
    """
    emitter = setup.emitter
    board = build_board(
        emitter.kind,
        emitter.geometry,
        setup.emitter_names,
        np.array([coil.centre_m for coil in emitter.coils]),
        np.array([coil.rotation_deg for coil in emitter.coils]),
        setup.frequencies_hz,
    )

    def field(points: NDArray[np.float64]) -> NDArray[np.complex128]:
        return np.asarray(board.field(points).transpose(0, 2, 1), complex)

    return field
