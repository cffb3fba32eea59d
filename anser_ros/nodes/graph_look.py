"""Print what is on the graph as one JSON line, for programs that may not load ROS."""

import json
import sys
import time

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor

from anser_ros.nodes.runtime import qos

NAME = 'anser_doctor'
SLICE_S = 0.1
"""Longest time that one message is waited for, s: the look ends that much late at most."""


def main(seconds: float) -> None:
    """Listen for so long, then print nodes, topics and the complaints in `/diagnostics`."""
    rclpy.init()
    node = rclpy.create_node(NAME)
    complaints: dict[str, str] = {}

    def take(message: DiagnosticArray) -> None:
        for status in message.status:
            complaints.pop(status.name, None)
            if status.level[0]:
                complaints[status.name] = status.message

    node.create_subscription(DiagnosticArray, '/diagnostics', take, qos.EVENTS)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        executor.spin_once(timeout_sec=SLICE_S)
    names = [
        f'{space.rstrip("/")}/{name}'
        for name, space in node.get_node_names_and_namespaces()
        if name != NAME
    ]
    found = {
        'middleware': rclpy.get_rmw_implementation_identifier(),
        'nodes': sorted(names),
        'twice': sorted({name for name in names if names.count(name) > 1}),
        'topics': len(node.get_topic_names_and_types()),
        'complaints': dict(sorted(complaints.items())),
    }
    print(json.dumps(found))
    sys.stdout.flush()
    executor.shutdown()
    node.destroy_node()
    rclpy.try_shutdown()
