"""Lets the model follow a recorded session's references, all or chosen ones, as it does live."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from anser_ros.chain.model_half import ModelHalf
from anser_ros.errors import BagError, FitError, ParameterError
from anser_ros.frames.intake import Frame
from anser_ros.refit.frame import Pace, check_enough
from anser_ros.refit.live_refit import LiveRefit
from anser_ros.refit.model import RefitResult
from anser_ros.sessions.nominal_board import stated_volume
from anser_ros.sessions.prepared import PreparedSession
from anser_ros.sessions.session import Session, tracking_noise

NONE = 'none'
"""The word for no reference sensor at all."""


def parse_references(text: str) -> tuple[int, ...]:
    """Return the channels of ``CHANNEL,...`` or ``none``; raises `ParameterError`."""
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

    Raises `BagError` when it has no reference fluxes, or none on one of the channels.
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


@dataclass
class RefitSummary:
    """Counts in how many frames the refit was in which state, and left out which reference."""

    states: Counter[str] = field(default_factory=Counter)
    left_out: Counter[str] = field(default_factory=Counter)

    def add(self, result: RefitResult) -> None:
        """Count one frame's result."""
        self.states[result.state] += 1
        self.left_out.update(result.left_out)


class ModelFollower(ModelHalf):
    """Refits the model to the reference sensors frame by frame, at the pace of the live node.

    The session must have references and a baseline. With ``witnesses``, contradictions of the
    tools' coils show metal, too. Raises `BagError` when the session has no reference fluxes, or
    there is no baseline or one of too few sensors.
    """

    def __init__(self, prepared: PreparedSession, witnesses: bool = False) -> None:
        session, baseline = prepared.session, prepared.baseline
        if session.reference is None:
            raise BagError(f'{session.path}: a refit needs reference fluxes, the session has none')
        if baseline is None:
            raise BagError('a refit needs a baseline: a distortion-free recording of the board')
        try:
            fewest = min(session.setup.refit.min_references, len(session.reference.sensors))
            check_enough(baseline.flux, fewest)
        except FitError as error:
            raise BagError(f'{baseline.path}: {error}') from error
        super().__init__(Pace())
        self.summary = RefitSummary()
        if len(session.reference.sensors):
            drawing, volume = prepared.nominal.field, stated_volume(session.setup)
            self.follow_by(LiveRefit(
                prepared.model, session.reference.sensors, baseline.flux, session.setup.refit,
                drawing, volume=volume,
            ))  # fmt: skip
        if witnesses:
            if self.current is None:
                raise BagError(
                    f'{session.path}: tools cannot be witnesses where there are no reference '
                    'sensors'
                )
            self.current.enable_witnesses(tracking_noise(session.setup))
            self.witnesses = prepared.correction

    def refitted(self, refit: LiveRefit, frame: Frame) -> RefitResult:
        """Return what the refit makes of a frame, and count it."""
        result = super().refitted(refit, frame)
        self.summary.add(result)
        return result
