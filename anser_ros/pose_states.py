"""Names every state of a pose, why a frame has one or why it is withheld: the only list."""

from typing import NamedTuple

OK = 'ok'
"""The pose may be used; only then is it published."""
NO_MODEL = 'no_model'
"""No field model has arrived yet."""

NO_SIGNAL = 'no_signal'
"""The fluxes are absent, absurd or lost in noise."""
STALE = 'stale'
"""The channel is missing, or its reading repeats an earlier one."""
SATURATED = 'saturated'
"""A sample of the window was at an end of the converter's range."""
DROPPED = 'dropped'
"""Samples are missing inside the window."""

RESIDUAL = 'residual'
"""The measured and the modelled fluxes differ by more than the gate allows."""
OUTSIDE_VOLUME = 'outside_volume'
"""The solution lies outside the tracked volume."""
AMBIGUOUS = 'ambiguous'
"""Another pose is nearly as likely, the pose is too uncertain, or metal may be there."""

REFERENCES_LOST = 'references_lost'
"""The references were silent, or too few, for longer than a model holds without them."""
REFERENCES_DOUBTFUL = 'references_doubtful'
"""The references contradict each other, and it cannot be determined which of them are right."""
OTHER_MODEL = 'other_model'
"""The active model was made for another board, or is not the one whose effects are undone."""
UNCALIBRATED = 'uncalibrated'
"""The model is the nominal one, and its use has not been allowed."""
OTHER_PLACE = 'other_place'
"""The frame of the references, or the board, has moved: they are no longer where they were."""
TWO_SOURCES = 'two_sources'
"""More than one node publishes the fluxes, the setup or the model; the tracker finds this."""

INCONSISTENT = 'inconsistent'
"""The pose of a coil contradicts the rest of its body."""
UNCONFIRMED = 'unconfirmed'
"""The pose has yet to be confirmed by the frames after it."""
MODEL_DOUBTFUL = 'model_doubtful'
"""Nearly everything that is measured contradicts the field model."""

OF_MODEL = (REFERENCES_LOST, REFERENCES_DOUBTFUL, OTHER_MODEL, UNCALIBRATED, OTHER_PLACE)
"""States for which the model's server withholds all poses. Their places, from 1, are their codes
in `field_model_error`, so a new one is added at the end."""
STATES = (
    OK, NO_MODEL, NO_SIGNAL, RESIDUAL, OUTSIDE_VOLUME, AMBIGUOUS, STALE, SATURATED, DROPPED,
    *OF_MODEL, TWO_SOURCES, INCONSISTENT, UNCONFIRMED, MODEL_DOUBTFUL,
)  # fmt: skip
FRAMES_IN = 'frames_'
"""What the count of frames in a state is called in `/diagnostics`, followed by the state."""


class Withheld(NamedTuple):
    """Names one reason for which all poses of a frame are withheld."""

    state: str  # one of `OF_MODEL`, or `TWO_SOURCES`
    reason: str  # for `/diagnostics`, with figures


def code_of(state: str) -> int:
    """Return the code in `field_model_error` of a state of `OF_MODEL`; 0 for an empty one."""
    return 1 + OF_MODEL.index(state) if state else 0


def state_of(code: int) -> str:
    """Return the state of a code; a code of a later version counts as the last state known."""
    return '' if code == 0 else OF_MODEL[min(code, len(OF_MODEL)) - 1]
