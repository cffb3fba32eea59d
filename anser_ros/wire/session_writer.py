"""Writes sessions without ROS: setup, fluxes and poses, as the nodes would have published them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from anser_ros.wire import cdr
from anser_ros.wire.bag_metadata import qos_profile
from anser_ros.wire.bag_writer import BagWriter
from anser_ros.wire.points import STALE, FluxPoints, PointFieldTuple, encode_flux
from anser_ros.wire.setup import FIELD_GENERATOR, SensorRows, SensorSpec

SETUP_TOPIC, SETUP_TYPE = '/anser/setup', 'std_msgs/msg/String'
FLUX_TOPICS = {'/anser/tool/flux': False, '/anser/reference/flux': True}
"""Topics of a session's fluxes, and whether their sensors are fixed to the field generator."""


class SessionWriter(BagWriter):
    """Writes a session without ROS: setup, fluxes and poses of one frame, log time = stamp.

    Raises
    ------
    BagError
        The file exists already, or cannot be made.
    """

    def __init__(self, path: str | Path, frame_id: str = 'fg') -> None:
        super().__init__(path)
        self._frame_id = frame_id
        self._channels: dict[str, int] = {}

    def write_setup(self, text: str, stamp_ns: int) -> None:
        """Write the setup document."""
        channel = self.channel(SETUP_TOPIC, SETUP_TYPE)
        self.write(channel, stamp_ns, cdr.string_bytes(text))

    def write_readings(
        self, sensors: Sequence[SensorSpec], stamp_ns: int, flux: NDArray[np.complex128]
    ) -> None:
        """Write one window, stamped with its middle: a message of tools, and one of references.

        Fluxes are (S, K), T, of the S sensors that are given: NaN where there is no reading, and
        for emitters without current.
        """
        for topic, fixed in FLUX_TOPICS.items():
            rows = [i for i, s in enumerate(sensors) if (s.body == FIELD_GENERATOR) == fixed]
            if rows:
                points = _points([sensors[i] for i in rows], flux[rows])
                fields, step, data = encode_flux(points)
                self.write_flux(topic, stamp_ns, fields, step, len(rows), data)

    def write_flux(
        self,
        topic: str,
        stamp_ns: int,
        fields: Sequence[PointFieldTuple],
        point_step: int,
        width: int,
        data: bytes,
    ) -> None:
        """Write one window's cloud, as `anser_ros.wire.points.encode_flux` packs it."""
        channel = self.channel(topic, 'sensor_msgs/msg/PointCloud2')
        frame = self._frame_id
        message = cdr.cloud_bytes(stamp_ns, frame, fields, point_step, width, data)
        self.write(channel, stamp_ns, message)

    def write_pose(
        self,
        topic: str,
        stamp_ns: int,
        position: Sequence[float],
        quaternion_xyzw: Sequence[float],
    ) -> None:
        """Write one pose: position in m, unit quaternion."""
        channel = self.channel(topic, 'geometry_msgs/msg/PoseStamped')
        message = cdr.pose_bytes(stamp_ns, self._frame_id, position, quaternion_xyzw)
        self.write(channel, stamp_ns, message)

    def channel(self, topic: str, type_name: str, definition: str = '') -> int:
        """Return the channel of a topic, announced when it is first asked for; a setup is latched.

        The types of a session need no definition.
        """
        if topic not in self._channels:
            latched = topic.endswith('/setup')
            qos = [qos_profile(latched=latched, depth=1 if latched else 100)]
            text = cdr.DEFINITIONS.get(type_name, definition)
            self._channels[topic] = self.add_topic(topic, type_name, text, qos)
        return self._channels[topic]


def _points(sensors: Sequence[SensorSpec], flux: NDArray[np.complex128]) -> FluxPoints:
    """One window's cloud; a sensor lacks its reading where it has none of a driven emitter.

    The place of a sensor that moves is not known to its fluxes.
    """
    known, rows = np.isfinite(flux), SensorRows.of(sensors, fixed_only=True)
    lacks = (known != known.any(axis=0)).any(axis=1) | ~known.any()
    return FluxPoints(rows.channel, np.where(lacks, STALE, 0), flux, rows.position, rows.axis)
