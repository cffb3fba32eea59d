"""Print the poses of a topic for some seconds, a JSON line each, for programs without ROS."""

import json
import sys
import time

from geometry_msgs.msg import PoseStamped
from rclpy.qos import qos_profile_sensor_data

from anser_ros.nodes.graph_look import looking
from anser_ros.stamps import stamp_of
from anser_ros.wire.recorded import pose_numbers

NAME = 'anser_pose_look'
FIRST_S = 10.0
"""Least time, s, that the first pose is waited for: a graph takes seconds to be discovered."""


def main(topic: str, seconds: float) -> None:
    """Listen for so long from the first pose on; print the poses."""
    end = time.monotonic() + max(seconds, FIRST_S)
    received = 0

    def take(message: PoseStamped) -> None:
        nonlocal received, end
        if not received:
            end = time.monotonic() + seconds
        received += 1
        print(json.dumps([stamp_of(message), *pose_numbers(message.pose)]), flush=True)

    with looking(NAME) as (node, wait):
        # Best effort is compatible with every publisher.
        node.create_subscription(PoseStamped, topic, take, qos_profile_sensor_data)
        while time.monotonic() < end:
            wait()
        if not received:
            known = [
                name for name, types in node.get_topic_names_and_types()
                if 'geometry_msgs/msg/PoseStamped' in types and node.count_publishers(name)
            ]  # fmt: skip
            words = ', '.join(sorted(known)) or 'none'
            print(
                f'no pose on {topic} within {max(seconds, FIRST_S):g} s; topics of poses: {words}',
                file=sys.stderr,
            )
