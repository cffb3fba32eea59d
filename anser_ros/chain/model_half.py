"""References to a model: the half of the chain that refits."""

from collections.abc import Mapping, Sequence

from anser_ros.arrays import Array
from anser_ros.chain.frame import Answer, ChainFrame, FrameReadings
from anser_ros.effects.correction import Correction
from anser_ros.field.model import FieldModel
from anser_ros.frames.intake import GOOD, Frame, Intake, reading_codes
from anser_ros.pose_states import OK, Withheld
from anser_ros.refit.frame import Pace
from anser_ros.refit.live_refit import LiveRefit
from anser_ros.refit.model import RefitResult
from anser_ros.refit.witness import ToolReading
from anser_ros.tracking.estimate import PoseEstimate

ToolPose = tuple[Array, Array]
"""Position (3,), m, and rotation (3, 3) of a body in frame fg."""


class ModelHalf:
    """Lets a model follow references, at most as often as the ``pace`` says.

    ``current`` is the refit, None before there is one; ``result`` is that of the newest frame
    since it began or was reset, and ``answered`` the last model that the references gave.
    ``witnesses`` is the correction of tools whose contradictions show metal, too; None for none.
    """

    current: LiveRefit | None
    result: RefitResult | None
    answered: FieldModel | None

    def __init__(self, pace: Pace) -> None:
        self.pace = pace
        self.witnesses: Correction | None = None
        self.follow_by(None)

    def follow_by(self, refit: LiveRefit | None) -> None:
        """Follow by another refit from now on, or by none."""
        self.current, self.result, self.answered = refit, None, None
        self._intake = None if refit is None else Intake(refit.references.channel)

    def reset(self) -> None:
        """Let the refit forget all frames, and what it gave."""
        if self.current is not None:
            self.current.reset()
        self.follow_by(self.current)

    def step(self, frame: ChainFrame) -> Answer | None:
        """Answer a frame's references; None where there are none, or no refit to them."""
        readings, intake = frame.reference, self._intake
        if readings is None or intake is None:
            return None
        self.follow(intake.judge(frame.stamp_ns, readings.channels, readings.flux, readings.flags))
        result, withheld = self.result, None
        if result is not None and result.withheld:
            withheld = Withheld(result.withheld, result.reason)
        return Answer(frame.stamp_ns, self.answered, True, withheld)

    def witnessed(self, frame: ChainFrame, found: Sequence[PoseEstimate]) -> None:
        """Let a frame's tools show metal, at the poses that were found for their bodies."""
        if self.current is None or self.witnesses is None or frame.tools is None:
            return
        self.current.witnessed(tool_readings(self.witnesses, frame.tools, poses_of(found)))

    def follow(self, frame: Frame) -> RefitResult | None:
        """Return the result of a judged frame; None where the last was less than the pace ago."""
        if self.current is None or not self.pace.is_due(frame.stamp_ns):
            return None
        self.result = self.refitted(self.current, frame)
        if self.result.is_answer:
            self.answered = self.result.model
        return self.result

    def refitted(self, refit: LiveRefit, frame: Frame) -> RefitResult:
        """Return what the refit makes of a frame that is due; for who counts or times it."""
        return refit.follow(frame)


def tool_readings(
    correction: Correction, tools: FrameReadings, poses: Mapping[str, ToolPose]
) -> list[ToolReading]:
    """Return what the usable coils of each body with a pose read.

    The tools' fluxes are as measured; the correction is that of their sensors, by the effects of
    the model. Bodies without a coil in the frame are left out.
    """
    flux, channels = tools.flux, tools.channels
    if correction.changes_flux:
        # The time matters to a recorded drift alone, which references follow where there are any.
        flux = correction.flux(0.0, channels, flux)
    row_of = {channel: row for row, channel in enumerate(channels.tolist())}
    usable = reading_codes(flux, tools.flags) == GOOD
    sensors, readings = correction.sensors(), []
    for body, (position, rotation) in poses.items():
        table = sensors.of_body(body)
        rows = [row_of.get(channel, -1) for channel in table.channel.tolist()]
        kept = [i for i, row in enumerate(rows) if row >= 0 and usable[row]]
        if kept:
            taken = flux[[rows[i] for i in kept]]
            readings.append(ToolReading(table.select(kept), taken, position, rotation))
    return readings


def poses_of(found: Sequence[PoseEstimate]) -> dict[str, ToolPose]:
    """Return the good poses of bodies among estimates, by body."""
    return {
        one.name: (one.position, one.rotation)
        for one in found
        if one.state == OK and one.rotation is not None
    }
