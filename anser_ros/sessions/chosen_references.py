"""Leaves some reference sensors out of a session, as if they had never been there."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from anser_ros.errors import BagError, ParameterError
from anser_ros.sessions.session import Session

NONE = 'none'
"""The word for no reference sensor at all."""


def parse_references(text: str) -> tuple[int, ...]:
    """Return the channels of a list ``CHANNEL,...``, none for the word ``none``.

    Raises
    ------
    ParameterError
        When an entry is no channel or appears twice.
    """
    if text.strip() == NONE:
        return ()
    entries = [entry.strip() for entry in text.split(',')]
    if not all(entry.isascii() and entry.isdigit() for entry in entries):
        raise ParameterError(f"references must be CHANNEL,... or '{NONE}', got {text!r}")
    channels = tuple(int(entry) for entry in entries)
    if len(set(channels)) != len(channels):
        raise ParameterError(f'references: a channel appears twice in {text!r}')
    return channels


def with_references(session: Session, channels: Sequence[int]) -> Session:
    """Return a session that has only the reference sensors on some channels, in its own order.

    Raises
    ------
    BagError
        When it has no reference fluxes, or none on one of the channels.
    """
    reference = session.reference
    if reference is None:
        raise BagError(f'{session.path}: the session has no reference fluxes to choose from')
    there = reference.sensors.channel
    missing = sorted(set(channels) - set(there.tolist()))
    if missing:
        raise BagError(
            f'{session.path}: no reference sensor on channel '
            f'{", ".join(map(str, missing))}; there are {", ".join(map(str, there.tolist()))}'
        )
    kept = np.flatnonzero(np.isin(there, np.asarray(channels, dtype=np.int64)))
    return replace(session, reference=reference.sensors_only(kept))
