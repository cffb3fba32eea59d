"""Gathers what tools witness of metal: their fluxes, and the poses that a tracker found with them.

The pose of a frame is published after the model of this frame, so it is used for the next one.
"""

from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import PointCloud2

from anser_ros.effects.correction import Correction
from anser_ros.errors import AnserError
from anser_ros.field.model import FieldModel
from anser_ros.nodes.field_model_parts.pose_messages import pose_in
from anser_ros.nodes.runtime import qos
from anser_ros.nodes.runtime.node import AnserNode
from anser_ros.nodes.streams.flux_reader import read_frame
from anser_ros.nodes.streams.one_source import OneSource
from anser_ros.refit.live_refit import LiveRefit
from anser_ros.sessions.session import sensor_table, tracking_noise
from anser_ros.sessions.tool_readings import Pose, tool_readings
from anser_ros.stamps import stamp_of
from anser_ros.wire.points import FluxPoints
from anser_ros.wire.setup import Setup, topic_of

MOST_FRAMES = 8
"""Frames whose fluxes and poses wait for the references of theirs and of the next: two, and some
for a busy machine. Fewer, and what comes late witnesses nothing; more only take memory."""


class ToolWitnesses:
    """Hands the readings of rigid tools to the active refit, once a frame.

    Nothing is subscribed to unless it ``is_wanted``. ``frame_id`` returns the frame of the board,
    and ``refuse`` gets a counter's name and the error of what is refused.

    Attributes
    ----------
    sources : list of OneSource
        Topics of which only one publisher is believed.
    """

    def __init__(
        self,
        node: AnserNode,
        is_wanted: bool,
        frame_id: Callable[[], str],
        refuse: Callable[[str, AnserError], None],
    ) -> None:
        self._node, self._frame_id, self._refuse = node, frame_id, refuse
        self._is_wanted, self._noise = is_wanted, 0.0
        self._correction: Correction | None = None
        self._frames: dict[int, FluxPoints] = {}
        self._poses: dict[int, dict[str, Pose]] = {}
        self._subscriptions: dict[str, Any] = {}
        self.sources: list[Any] = []
        if is_wanted:
            self.sources.append(
                OneSource(node, PointCloud2, 'tool/flux', self._on_flux, qos.STREAM)
            )

    def expect(self, setup: Setup, model: FieldModel) -> None:
        """Have to do with the tools of a setup, and with a model's effects, from now on."""
        self._correction = None
        if not self._is_wanted or not setup.tool_sensors:
            return
        sensors = sensor_table(setup.tool_sensors)
        self._correction = Correction.of(model.effects, sensors, model.frequencies_hz)
        self._noise = tracking_noise(setup)
        self._frames, self._poses = {}, {}
        for body in set(sensors.body) - set(self._subscriptions):
            self._subscriptions[body] = self._node.create_subscription(
                PoseStamped, f'{topic_of(body)}/pose', self._pose_taker(body), qos.STREAM
            )
        for body in set(self._subscriptions) - set(sensors.body):
            self._node.destroy_subscription(self._subscriptions.pop(body))

    @property
    def noise_t(self) -> float | None:
        """Return the noise of a component of what the tools read, T; None without witnesses."""
        return None if self._correction is None else self._noise

    def pass_on(self, refit: LiveRefit, stamp_ns: int) -> None:
        """Give the refit what the tools read in its last frame, of the stamp given, once."""
        points, poses = self._frames.pop(stamp_ns, None), self._poses.pop(stamp_ns, None)
        correction = self._correction
        if points is None or poses is None or correction is None:
            return
        poses = {body: pose for body, pose in poses.items() if self._has_one_source(body)}
        readings = tool_readings(correction, points.channel, points.flux, points.flags, poses)
        if readings:
            refit.witnessed(readings)
            self._node.count('witnessed_frames')

    def _has_one_source(self, body: str) -> bool:
        """Return whether one publisher gives a body's poses; whose is whose is not known else."""
        count = self._node.count_publishers(self._subscriptions[body].topic_name)
        if count > 1:
            text = f'{count} publishers of the pose of {body}: it witnesses nothing'
            self._node.warn('witnesses_of_two_sources', text)
        return count <= 1

    def _on_flux(self, message: PointCloud2) -> None:
        try:
            stamp_ns, points = read_frame(message, self._frame_id(), self._node.count)
            _keep(self._frames, stamp_ns, points)
        except AnserError as error:
            self._refuse('tool_fluxes_refused', error)

    def _pose_taker(self, body: str) -> Callable[[PoseStamped], None]:
        """Return what takes the poses of a body."""

        def take(message: PoseStamped) -> None:
            try:
                pose = pose_in(message, self._frame_id(), body)
                stamp_ns = stamp_of(message)
                _keep(self._poses, stamp_ns, {**self._poses.get(stamp_ns, {}), body: pose})
            except AnserError as error:
                self._refuse('tool_poses_refused', error)

        return take


def _keep(kept: dict[int, Any], stamp_ns: int, what: Any) -> None:
    """Keep something under its stamp, and the newest few of what is there."""
    kept[stamp_ns] = what
    while len(kept) > MOST_FRAMES:
        kept.pop(next(iter(kept)), None)
