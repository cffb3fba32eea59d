"""Gathers what a field_model receives about reference coils on moving bodies: poses and fluxes."""

from collections.abc import Callable, Mapping
from typing import Any

from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import PointCloud2

from anser_ros.errors import AnserError
from anser_ros.nodes.field_model_parts.patches import Patches
from anser_ros.nodes.runtime import qos
from anser_ros.nodes.runtime.node import AnserNode
from anser_ros.nodes.streams.flux_reader import read_frame
from anser_ros.nodes.streams.one_source import OneSource


class MovingCoils:
    """Hands poses and fluxes to the patches of the refit in force, once there is one.

    Parameters
    ----------
    node : AnserNode
    topics : mapping
        Topic of the poses of each body.
    frame_id : callable
        The frame of the board.
    refuse : callable
        Gets a counter's name and the error of what is refused.

    Attributes
    ----------
    patches : Patches or None
        Of the refit in force.
    sources : list of OneSource
        Topics of which only one publisher is believed.
    """

    def __init__(
        self,
        node: AnserNode,
        topics: Mapping[str, str],
        frame_id: Callable[[], str],
        refuse: Callable[[str, AnserError], None],
    ) -> None:
        self._node, self._frame_id, self._refuse = node, frame_id, refuse
        self.bodies = tuple(topics)
        self.patches: Patches | None = None
        self.sources: list[Any] = []
        for body, topic in topics.items():
            node.create_subscription(PoseStamped, topic, self.pose_taker(body), qos.STREAM)
        if topics:
            self.sources.append(
                OneSource(node, PointCloud2, 'tool/flux', self.on_flux, qos.STREAM)
            )

    def pose_taker(self, body: str) -> Callable[[PoseStamped], None]:
        """Return what takes the poses of a body."""

        def take(message: PoseStamped) -> None:
            if self.patches is None:
                return
            try:
                self.patches.take_pose(body, message)
            except AnserError as error:
                self._refuse('patch_poses_refused', error)

        return take

    def on_flux(self, message: PointCloud2) -> None:
        """Take the fluxes of the tools, among which are those of the patches."""
        if self.patches is None:
            return
        try:
            stamp_ns, points = read_frame(message, self._frame_id(), self._node.count)
            self.patches.take_flux(stamp_ns, points.channel, points.flux, points.flags)
        except AnserError as error:
            self._refuse('patch_fluxes_refused', error)
