"""Lets the model follow a recorded session's references, all or chosen ones, as it does live."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.correction import Correction
from anser_ros.errors import BagError, FitError, ParameterError
from anser_ros.frames.faults import GOOD, reading_codes
from anser_ros.integrity.model_age import UNCHANGED_MODEL, FrameModel, ModelAge
from anser_ros.pose_states import OK, Withheld
from anser_ros.refit.frame import Pace, check_enough
from anser_ros.refit.live_refit import LiveRefit
from anser_ros.refit.model import RefitResult
from anser_ros.refit.witness import ToolReading
from anser_ros.sessions.baseline import Baseline
from anser_ros.sessions.nominal_board import stated_volume
from anser_ros.sessions.prepared import PreparedSession
from anser_ros.sessions.session import FrameReadings, Session, SessionFrame, tracking_noise
from anser_ros.tracking.estimate import PoseEstimate

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


ToolPose = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Position (3,), m, and rotation (3, 3) of a body in frame fg."""


def tool_readings(
    correction: Correction,
    channels: NDArray[np.int64],
    flux: NDArray[np.complex128],
    flags: NDArray[np.int64],
    poses: Mapping[str, ToolPose],
) -> list[ToolReading]:
    """Return what the usable coils of each body with a pose read.

    ``flux`` (S, K), T, is as measured; the correction is that of the tools' sensors, by the
    effects of the model. Bodies without a coil in the frame are left out.
    """
    if correction.changes_flux:
        # The time matters to a recorded drift alone, which references follow where there are any.
        flux = correction.flux(0.0, channels, flux)
    row_of = {channel: row for row, channel in enumerate(channels.tolist())}
    usable = reading_codes(flux, flags) == GOOD
    sensors, readings = correction.sensors(), []
    for body, (position, rotation) in poses.items():
        table = sensors.of_body(body)
        rows = [row_of.get(channel, -1) for channel in table.channel.tolist()]
        kept = [i for i, row in enumerate(rows) if row >= 0 and usable[row]]
        if kept:
            taken = flux[[rows[i] for i in kept]]
            readings.append(ToolReading(table.select(kept), taken, position, rotation))
    return readings


class FrameModels(Protocol):
    """Gives each frame of a session the model that it is tracked with."""

    summary: 'RefitSummary'

    def at(self, frame: SessionFrame) -> FrameModel:
        """Return what a frame is tracked with."""

    def witnessed(self, tools: FrameReadings, found: Sequence[PoseEstimate]) -> None:
        """Take in what a frame's tools read, and the poses that were found."""


@dataclass
class RefitSummary:
    """Counts in how many frames the refit was in which state, and left out which reference."""

    states: Counter[str] = field(default_factory=Counter)
    left_out: Counter[str] = field(default_factory=Counter)

    def add(self, result: RefitResult) -> None:
        """Count one frame's result."""
        self.states[result.state] += 1
        self.left_out.update(result.left_out)


class ModelFollower(FrameModels):
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
            raise BagError(
                'a refit needs --baseline, a distortion-free recording of the same board'
            )
        try:
            fewest = min(session.setup.refit.min_references, len(session.reference.sensors))
            check_enough(baseline.flux, fewest)
        except FitError as error:
            raise BagError(f'{baseline.path}: {error}') from error
        self._refit = _refit_of(prepared, baseline)
        self._prepared, self._uses_witnesses = prepared, witnesses
        if witnesses:
            if self._refit is None:
                raise BagError(
                    f'{session.path}: tools cannot be witnesses where there are no reference '
                    'sensors'
                )
            self._refit.enable_witnesses(tracking_noise(session.setup))
        self._pace = Pace()
        self._age = ModelAge(session.setup.refit.references_age_s, prepared.volume)
        self._result: RefitResult | None = None
        self.summary = RefitSummary()

    def at(self, frame: SessionFrame) -> FrameModel:
        """Return what a frame is tracked with: its references' model, or the last one, aged."""
        if self._refit is None:
            return UNCHANGED_MODEL  # as live: there is nothing to follow, the checks decide
        if frame.reference is not None:
            self._follow(frame.stamp_ns, frame.reference)
        result, withheld = self._result, None
        if frame.reference is not None and result is not None and result.withheld:
            withheld = Withheld(result.withheld, result.reason)
        return self._age.at(frame.stamp_ns, withheld)

    def witnessed(self, tools: FrameReadings, found: Sequence[PoseEstimate]) -> None:
        """Let a frame's tools show metal, at the poses that were found for their bodies."""
        if not self._uses_witnesses or self._refit is None:
            return
        poses = {
            one.name: (one.position, one.rotation)
            for one in found
            if one.state == OK and one.rotation is not None
        }
        correction = self._prepared.correction
        self._refit.witnessed(
            tool_readings(correction, tools.channels, tools.flux, tools.flags, poses)
        )

    def _follow(self, stamp_ns: int, reference: FrameReadings) -> None:
        """Take in one frame of the references."""
        assert self._refit is not None
        if self._pace.is_due(stamp_ns):
            self._result = self._refit.update(
                stamp_ns, reference.channels, reference.flux, reference.flags
            )
            self.summary.add(self._result)
        if self._result is not None and self._result.is_answer:
            self._age.answered(stamp_ns, self._result.model)


def _refit_of(prepared: PreparedSession, baseline: Baseline) -> LiveRefit | None:
    """The refit to a session's references; None where there are none."""
    session = prepared.session
    assert session.reference is not None
    if not len(session.reference.sensors):
        return None
    return LiveRefit(
        prepared.model,
        session.reference.sensors,
        baseline.flux,
        session.setup.refit,
        prepared.nominal.field,
        volume=stated_volume(session.setup),
    )
