"""Computes the simulated board's field by Biot and Savart's law over all tracks of its coils."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from anser_ros.sessions.drawing import board_of
from anser_ros.simulation.world import FieldSource
from anser_ros.wire.setup import Setup


def board_source(setup: Setup) -> FieldSource:
    """Return the field of a setup's board, without the dipoles that models express it by.

    Raises `SetupError` when the setup's geometry does not describe a board.
    """
    board = board_of(setup)

    def field(points: NDArray[np.float64]) -> NDArray[np.complex128]:
        return np.asarray(board.field(points).transpose(0, 2, 1), complex)

    return field
