"""Looks at topics now and then: between two looks a message costs no Python.

An executor runs Python for each message. A display that is updated a few times a second needs only
the newest one: the middleware keeps as many as the queue is deep, and they are taken together.
"""

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile

from anser_ros.errors import LayoutError
from anser_ros.nodes.runtime import incoming
from anser_ros.nodes.streams.newest_frame import take_waiting

STREAMS = '_streams'
"""What the name of the node that is polled has behind that of its process."""


def polling_node(name: str, namespace: str) -> Node:
    """Return a node beside another one, for no executor: its subscriptions are polled."""
    return Node(
        f'{name}{STREAMS}', namespace=namespace, start_parameter_services=False,
        enable_rosout=False, use_global_arguments=False,
    )  # fmt: skip


class Polled:
    """Subscribes to a topic whose messages are taken when asked for.

    The profile's depth is how many messages are kept. The node is that of `polling_node`.
    """

    def __init__(self, node: Node, message_type: type, topic: str, profile: QoSProfile) -> None:
        self._node, self._type = node, message_type
        self._subscription = node.create_subscription(
            message_type, topic, _never, profile, raw=True
        )

    def take(self) -> list[tuple[bytes, dict[str, int]]]:
        """Return what has come since the last time, serialised, the oldest first."""
        return take_waiting(self._subscription)

    def messages(self, refused: Callable[[str], None]) -> list[Any]:
        """Return what has come as messages; ``refused`` gets what is wrong with the others."""
        found = []
        for data, _ in self.take():
            try:
                found.append(incoming.opened(data, self._type))
            except LayoutError as error:
                refused(str(error))
        return found

    def close(self) -> None:
        """End the subscription and forget what came by it."""
        self._node.destroy_subscription(self._subscription)


def _never(_message: Any) -> None:
    """Take what only an executor would give."""
