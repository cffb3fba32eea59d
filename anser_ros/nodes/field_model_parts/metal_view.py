"""Shows the metal that the refit sees, as a marker for the operator."""

import time

import numpy as np
from geometry_msgs.msg import Point, PointStamped, Pose
from rclpy.node import Node
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from anser_ros.nodes.runtime import qos
from anser_ros.refit.result import Metal, RefitResult
from anser_ros.stamps import set_stamp

LEAST_SHOWN_DENSITY = 0.15
"""Sources whose density is at least this part of the strongest one's are shown."""
MOST_SHOWN = 400
"""Sources that are shown at most, the strongest ones: as many as a viewer draws with ease."""
CENTROID_M = 0.03
"""Diameter of the ball that marks the centroid, m: large enough to be seen among the sources."""
VIEW_PERIOD_S = 0.2
"""Time, s, from one marker to the next: eyes follow it, and it costs a message of kilobytes."""


class MetalView:
    """Shows where the metal is, a few times a second: ``metal``, ``metal/centroid``."""

    def __init__(self, node: Node) -> None:
        self._markers = node.create_publisher(MarkerArray, 'metal', qos.LATCHED)
        self._centroid = node.create_publisher(PointStamped, 'metal/centroid', qos.STREAM)
        self._shown_s: float | None = None

    def show(self, result: RefitResult, frame_id: str, stamp_ns: int) -> None:
        """Show what a refit found, or take away what was shown when it found nothing."""
        now_s = time.monotonic()
        if result.find is None:
            if self._shown_s is not None:
                self._markers.publish(metal_markers(None, frame_id, stamp_ns))
                self._shown_s = None
            return
        is_due = self._shown_s is None or now_s - self._shown_s >= VIEW_PERIOD_S
        if not is_due or result.metal is None:
            return
        self._shown_s = now_s
        self._markers.publish(metal_markers(result.metal, frame_id, stamp_ns))
        self._centroid.publish(centroid_message(result.metal, frame_id, stamp_ns))


def centroid_message(metal: Metal, frame_id: str, stamp_ns: int) -> PointStamped:
    """Return where the metal's middle is, as far as the emitters reach it."""
    message = PointStamped()
    message.header.frame_id = frame_id
    set_stamp(message.header.stamp, stamp_ns)
    message.point = _point(metal.centroid)
    return message


def metal_markers(metal: Metal | None, frame_id: str, stamp_ns: int) -> MarkerArray:
    """Return spheres as large as the space they stand for, and one at the centroid.

    Without metal, the markers shown before are deleted.
    """
    if metal is None:
        gone = _marker(frame_id, stamp_ns, 0)
        gone.action = Marker.DELETEALL
        return MarkerArray(markers=[gone])
    density = np.abs(metal.polarisability) / metal.volumes
    rows = np.argsort(-density)[:MOST_SHOWN]
    rows = rows[density[rows] >= LEAST_SHOWN_DENSITY * density[rows[0]]]
    markers: list[Marker] = []
    for volume in np.unique(metal.volumes[rows]).tolist():
        here = rows[metal.volumes[rows] == volume]
        spheres = _marker(frame_id, stamp_ns, len(markers))
        spheres.type = Marker.SPHERE_LIST
        spheres.scale.x = spheres.scale.y = spheres.scale.z = 0.8 * float(volume) ** (1.0 / 3.0)
        spheres.color = ColorRGBA(r=0.8, g=0.4, b=0.1, a=1.0)
        spheres.points = [_point(metal.positions[row]) for row in here]
        strength = density[here] / density[rows[0]]
        spheres.colors = [
            ColorRGBA(r=0.8, g=0.4, b=0.1, a=float(0.1 + 0.5 * part)) for part in strength
        ]
        markers.append(spheres)
    centre = _marker(frame_id, stamp_ns, len(markers))
    centre.type = Marker.SPHERE
    centre.pose.position = _point(metal.centroid)
    centre.scale.x = centre.scale.y = centre.scale.z = CENTROID_M
    centre.color = ColorRGBA(r=0.9, g=0.1, b=0.1, a=0.9)
    # The number of lists changes; what is left of a longer array must not stay.
    clear = _marker(frame_id, stamp_ns, 0)
    clear.action = Marker.DELETEALL
    return MarkerArray(markers=[clear, *markers, centre])


def _marker(frame_id: str, stamp_ns: int, number: int) -> Marker:
    marker = Marker(ns='metal', id=number, action=Marker.ADD)
    marker.header.frame_id = frame_id
    set_stamp(marker.header.stamp, stamp_ns)
    marker.pose = Pose()
    marker.pose.orientation.w = 1.0
    return marker


def _point(values: np.ndarray) -> Point:
    x, y, z = (float(v) for v in values)
    return Point(x=x, y=y, z=z)
