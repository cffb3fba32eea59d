"""Poses as bytes: what a reader of the messages gets."""

import numpy as np
import pytest
from geometry_msgs import msg
from rclpy.serialization import deserialize_message

from anser_ros.nodes.pose_output import PackedMessage


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
