"""Poses as bytes: what a reader of the messages gets."""

import numpy as np
import pytest
from geometry_msgs import msg
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2

from anser_ros.nodes.pose_output import PackedMessage
from anser_ros.nodes.streams.clouds import FluxCloud
from anser_ros.wire.points import FluxPoints


@pytest.mark.parametrize('frame_id', ['', 'fg', 'left_fg', 'boards/left/fg'])
@pytest.mark.parametrize('kind', ['PoseStamped', 'PoseWithCovarianceStamped'])
def test_a_packed_message_is_the_message(ros, kind, frame_id):
    """Whatever the length of the frame's name, which moves all that comes after it."""
    message_type = getattr(msg, kind)
    count = 7 if kind == 'PoseStamped' else 43
    told = message_type()
    told.header.frame_id = frame_id
    packer = PackedMessage(told, count)
    for seed, stamp_ns in ((0, 5), (1, 1_795_419_147_667_697_521)):
        numbers = np.random.default_rng(seed).normal(size=count).tolist()
        told.header.stamp.sec, told.header.stamp.nanosec = divmod(stamp_ns, 10**9)
        pose = told.pose if count == 7 else told.pose.pose
        place, turn = pose.position, pose.orientation
        place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w = numbers[:7]
        if count > 7:
            told.pose.covariance = np.array(numbers[7:])
        assert deserialize_message(packer.packed(stamp_ns, *numbers), message_type) == told


@pytest.mark.parametrize('frame_id', ['', 'fg', 'boards/left/fg'])
def test_packed_fluxes_are_the_message(ros, frame_id):
    """Whichever topic a window is of, and whether its sensors move."""
    cloud = FluxCloud(frame_id)
    rng = np.random.default_rng(0)
    for seed, (sensors, emitters) in enumerate([(9, 8), (32, 8), (9, 8), (1, 3)]):
        flux = rng.normal(size=(sensors, emitters)) + 1j * rng.normal(size=(sensors, emitters))
        place = rng.normal(size=(sensors, 3)) * (np.nan if seed == 2 else 1.0)
        channel = np.arange(sensors)
        points = FluxPoints(channel, channel % 5, 1e-7 * flux, place, place)
        told = cloud.message(points, 1_795_419_147_667_697_521 + seed)
        packed = cloud.packed(points, 1_795_419_147_667_697_521 + seed)
        assert deserialize_message(packed, PointCloud2) == told
