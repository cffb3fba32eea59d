"""Watches whether the references locate the board where the served model has it."""

import time
from collections.abc import Callable

from anser_ros.errors import FitError
from anser_ros.field.model import FieldModel
from anser_ros.frames.intake import Frame
from anser_ros.integrity.board_place import BoardPlace
from anser_ros.physics.sensor import SensorTable
from anser_ros.refit.baseline import ReadingWindow
from anser_ros.sessions.baseline import board_place_of
from anser_ros.wire.setup import Setup

DISCOVERY_S = 1.0
"""Time, s, in which whoever sends the references is found in the graph; a chain without references
has its first pose as much later."""


def none_announced() -> int:
    """Return 0: no references are announced."""
    return 0


class PlaceWatch:
    """Asks with the first frame, and again while the model was found to lie aside.

    ``place`` is None where nothing can be compared; ``announced`` returns how many publishers of
    references the graph knows.

    Attributes
    ----------
    misplaced : str
        How the model lies aside; empty where it does not, or it is not known yet.
    """

    def __init__(
        self, place: BoardPlace | None = None, announced: Callable[[], int] = none_announced
    ) -> None:
        self._place, self._announced = place, announced
        self._has_frame = self._has_looked = False
        self._begin_s = time.monotonic()
        self.misplaced = ''

    @classmethod
    def of(
        cls,
        base: FieldModel | None,
        references: SensorTable | None,
        setup: Setup | None,
        announced: Callable[[], int],
    ) -> 'PlaceWatch':
        """Return what watches a model, given what is known yet."""
        if base is None or references is None or setup is None:
            return cls()
        return cls(board_place_of(base, references, setup), announced)

    @property
    def is_open(self) -> bool:
        """Return whether references could show it, and none has been received."""
        return self._place is not None and not self._has_frame

    @property
    def is_waiting(self) -> bool:
        """Return whether readings of announced references, or of ones still to be, may come."""
        is_early = time.monotonic() - self._begin_s < DISCOVERY_S
        return self.is_open and (is_early or self._announced() > 0)

    def look(self, frame: Frame, window: ReadingWindow) -> bool:
        """Return whether the verdict is another one after a frame, or the first.

        The first frame with enough readings decides; after that a model that was found to be
        displaced is checked again with every whole window.
        """
        is_first, self._has_frame = self.is_open, True
        if self._place is None or (self._has_looked and not (self.misplaced and window.full)):
            return False
        flux = window.mean() if self._has_looked else frame.readings
        before, self.misplaced = self.misplaced, ''
        try:
            self._has_looked |= self._place.check(flux)
        except FitError as error:
            self._has_looked, self.misplaced = True, str(error)
            window.clear()
        return is_first or bool(before) != bool(self.misplaced)
