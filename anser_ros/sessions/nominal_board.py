"""Makes a setup's nominal board, the emitters as drawn, and finds the tracked volume."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from anser_ros.errors import AnserError, FitError, SetupError
from anser_ros.field.model import FieldModel
from anser_ros.field.nominal import nominal_model
from anser_ros.physics.board import Board, build_board
from anser_ros.physics.volume import TrackedVolume
from anser_ros.refit.clouds import FieldFunction, region_of
from anser_ros.wire.setup import Setup


def board_of(setup: Setup) -> Board:
    """Return the emitters' geometry; `SetupError` when its kind is unknown or a key is missing."""
    emitter = setup.emitter
    return build_board(
        emitter.kind,
        emitter.geometry,
        setup.emitter_names,
        np.array([coil.centre_m for coil in emitter.coils]),
        np.array([coil.rotation_deg for coil in emitter.coils]),
        setup.frequencies_hz,
    )


@dataclass(frozen=True)
class NominalBoard:
    """Holds what a setup's geometry gives; all of it is None for no known kind of board."""

    board: Board | None

    @staticmethod
    def of(setup: Setup) -> 'NominalBoard':
        """Return the nominal board of a setup."""
        try:
            return NominalBoard(board_of(setup))
        except SetupError:
            return NominalBoard(None)

    @property
    def field(self) -> FieldFunction | None:
        """Return the field at nominal currents: points (P, 3), m, frame fg, to (P, K, 3), T."""
        return None if self.board is None else self.board.field

    @cached_property
    def model(self) -> FieldModel | None:
        """Return the nominal model, made at first use; None if dipoles are not accurate enough."""
        try:
            return None if self.board is None else nominal_model(self.board)
        except AnserError:
            return None


def stated_volume(setup: Setup) -> TrackedVolume | None:
    """Return the volume that the setup document states; None where it leaves it to the board."""
    return None if setup.volume is None else TrackedVolume(*setup.volume)


def tracked_volume(setup: Setup) -> TrackedVolume:
    """Return the stated volume, or else the default over the setup's board.

    A board that can't be drawn from the setup gets the box of an Anser board.
    """
    stated, field = stated_volume(setup), NominalBoard.of(setup).field
    if stated is not None:
        return stated
    if field is None:
        return TrackedVolume()
    try:
        return region_of(field).volume
    except FitError:  # a drawing without any field
        return TrackedVolume()
