"""Says why no pose is given though one could be solved: a state, and the reason in words."""

from typing import NamedTuple

REFERENCES_LOST = 'references_lost'
"""The references were silent, or too few, for longer than a model holds without them."""
REFERENCES_DOUBTFUL = 'references_doubtful'
"""The references contradict each other, and which of them are right cannot be told."""
OTHER_MODEL = 'other_model'
"""The model in force was made for another board, or is not the one whose effects are undone."""
UNCALIBRATED = 'uncalibrated'
"""The model is the drawing of the board, and nobody has said that this will do."""
TWO_SOURCES = 'two_sources'
"""More than one publisher of what poses are made from; said by the tracker itself."""
STATES = (REFERENCES_LOST, REFERENCES_DOUBTFUL, OTHER_MODEL, UNCALIBRATED)
"""States in which the model's server lets no pose be given; their places are their codes,
from 1."""


def code_of(state: str) -> int:
    """Return the code of a state on the wire; 0 for an empty one."""
    return 1 + STATES.index(state) if state else 0


def state_of(code: int) -> str:
    """Return the state of a code; a code of a later version counts as the last state known."""
    return '' if code == 0 else STATES[min(code, len(STATES)) - 1]


class Withheld(NamedTuple):
    """Names one reason for which all poses of a frame are withheld.

    Attributes
    ----------
    state : str
        One of `STATES`, or `TWO_SOURCES`.
    reason : str
        What `/diagnostics` says of it, with figures.
    """

    state: str
    reason: str
