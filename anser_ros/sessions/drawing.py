"""Takes the emitters of a setup as it draws them: their field, and the nominal model of it."""

from dataclasses import dataclass
from functools import cached_property

from anser_ros.errors import AnserError, SetupError
from anser_ros.field.model import FieldModel
from anser_ros.field.nominal import nominal_model
from anser_ros.physics.board import Board
from anser_ros.refit.excitation import FieldFunction
from anser_ros.sessions.starting_model import board_of
from anser_ros.wire.setup import Setup


@dataclass(frozen=True)
class Drawing:
    """Holds what a setup's geometry gives; all of it is None for no known kind of board."""

    board: Board | None

    @staticmethod
    def of(setup: Setup) -> 'Drawing':
        """Return the drawing of a setup's emitters."""
        try:
            return Drawing(board_of(setup))
        except SetupError:
            return Drawing(None)

    @property
    def field(self) -> FieldFunction | None:
        """Return the field at the nominal currents: points (P, 3) in m, frame fg, to (P, K, 3) in
        T.
        """
        return None if self.board is None else self.board.field

    @cached_property
    def model(self) -> FieldModel | None:
        """Return the nominal model, made when it is first asked for, which takes about a second.

        None also if dipoles do not reach the required accuracy.
        """
        try:
            return None if self.board is None else nominal_model(self.board)
        except AnserError:
            return None
