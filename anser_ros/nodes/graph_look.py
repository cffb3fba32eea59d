"""Print what is on the graph as one JSON line, for programs that may not load ROS."""

import contextlib
import json
import sys
import time
from collections.abc import Callable, Iterator

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from anser_ros.nodes.runtime import qos
from anser_ros.nodes.runtime.diagnostics import LastStatus, statuses_in

NAME = 'anser_doctor'
SLICE_S = 0.1
"""Longest time that one message is waited for, s: the look ends that much late at most."""


@contextlib.contextmanager
def looking(name: str) -> Iterator[tuple[Node, Callable[[], None]]]:
    """Give a node that only looks, and what waits for its next message for `SLICE_S`."""
    rclpy.init()
    node, executor = rclpy.create_node(name), SingleThreadedExecutor()
    executor.add_node(node)
    yield node, lambda: executor.spin_once(timeout_sec=SLICE_S)
    sys.stdout.flush()
    executor.shutdown()
    node.destroy_node()
    rclpy.try_shutdown()


def main(seconds: float) -> None:
    """Listen for so long, then print nodes, topics and the complaints in `/diagnostics`."""
    statuses: dict[str, LastStatus] = {}

    def take(message: DiagnosticArray) -> None:
        statuses.update(statuses_in(message))

    with looking(NAME) as (node, wait):
        node.create_subscription(DiagnosticArray, '/diagnostics', take, qos.EVENTS)
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            wait()
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
            'complaints': {n: one.message for n, one in sorted(statuses.items()) if one.level},
        }
        print(json.dumps(found))
