"""Print the poses of a topic for some seconds, a JSON line each, for programs without ROS."""

import json
import sys
import time

import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import qos_profile_sensor_data

from anser_ros.nodes.graph_look import SLICE_S
from anser_ros.stamps import SECOND_NS

NAME = 'anser_pose_look'
FIRST_S = 10.0
"""Least time, s, that the first pose is waited for: a graph takes seconds to be discovered."""


def main(topic: str, seconds: float) -> None:
    """Listen for so long from the first pose on; print the poses."""
    rclpy.init()
    node = rclpy.create_node(NAME)
    end = time.monotonic() + max(seconds, FIRST_S)
    received = 0

    def take(message: PoseStamped) -> None:
        nonlocal received, end
        if not received:
            end = time.monotonic() + seconds
        received += 1
        stamp, p, q = message.header.stamp, message.pose.position, message.pose.orientation
        values = [p.x, p.y, p.z, q.x, q.y, q.z, q.w]
        print(json.dumps([stamp.sec * SECOND_NS + stamp.nanosec, *values]), flush=True)

    # Best effort is compatible with every publisher.
    node.create_subscription(PoseStamped, topic, take, qos_profile_sensor_data)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while time.monotonic() < end:
        executor.spin_once(timeout_sec=SLICE_S)
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
    executor.shutdown()
    node.destroy_node()
    rclpy.try_shutdown()
