"""Watches whether the references have the board where the served model has it."""

from anser_ros.errors import FitError
from anser_ros.frames.intake import Frame
from anser_ros.integrity.board_place import BoardPlace
from anser_ros.refit.baseline import ReadingWindow


class PlaceWatch:
    """Asks with the first frame, and again while the model was found to lie aside.

    Parameters
    ----------
    place : BoardPlace or None
        None where nothing can be compared.

    Attributes
    ----------
    misplaced : str
        How the model lies aside; empty where it does not, or nobody can tell yet.
    """

    def __init__(self, place: BoardPlace | None = None) -> None:
        self._place = place
        self._has_looked = False
        self.misplaced = ''

    def look(self, frame: Frame, window: ReadingWindow) -> bool:
        """Return whether the verdict is another one after a frame.

        The first frame with enough readings tells; after that a model that was found to lie aside
        is asked again with every whole window.
        """
        if self._place is None or (self._has_looked and not (self.misplaced and window.full)):
            return False
        flux = window.mean() if self._has_looked else frame.readings
        before, self.misplaced = self.misplaced, ''
        try:
            self._has_looked |= self._place.check(flux)
        except FitError as error:
            self._has_looked, self.misplaced = True, str(error)
            window.clear()
        return bool(before) != bool(self.misplaced)
