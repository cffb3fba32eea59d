"""Detects when the subscribers have caught up, for a replay without a clock of its own.

DDS confirms the messages that a listener's queue has taken, not those that its callbacks have
processed. But every node answers parameter requests from the same executor that runs its
callbacks, and runs those first: an answer to a request that was sent after a message says that the
message was handled. If several messages wait on one topic it may have handled only the first, so
the publisher asks after each of them.
"""

import threading
import time
from typing import Any

from rcl_interfaces.srv import GetParameterTypes
from rclpy.node import Node

REPLY_TIMEOUT_S = 2.0
"""Time, s, that a listener has for an answer before it is asked again."""
# A listener may be compiling its kernels.
ATTEMPTS = 30
POLL_S = 0.1
"""How often a wait looks whether it was given up, s: a Ctrl-C takes so long."""
# How often the graph is asked for new listeners, in messages.
REFRESH_EVERY = 50


class Consumers:
    """Finds the nodes that subscribe to topics.

    Parameters
    ----------
    node : Node
        Asks them; its executor must be spinning in another thread.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._clients: dict[str, Any] = {}
        self._listeners: dict[tuple[str, ...], set[str]] = {}
        self._silent: set[str] = set()
        self._calls = 0
        self._given_up = threading.Event()

    def wait(self, *topics: str, attempts: int = ATTEMPTS) -> None:
        """Wait until all listeners of the topics have handled what was published.

        Parameters
        ----------
        topics : fully qualified names
        attempts : how often one who is silent is asked, before the next is gone on without it
        """
        if self._calls % REFRESH_EVERY == 0:
            self._listeners.clear()
        self._calls += 1
        if topics not in self._listeners:
            self._listeners[topics] = set().union(*map(self._find, topics))
        waiting = {name: self._ask(name) for name in self._listeners[topics]}
        for name, answered in waiting.items():
            if not self._answers(name, answered, attempts):
                self._silent.add(name)
                self._listeners[topics].discard(name)

    def give_up(self) -> None:
        """End every wait that is going on."""
        self._given_up.set()

    def _find(self, topic: str) -> set[str]:
        """Return the listeners that can be asked."""
        own = self._node.get_fully_qualified_name()
        found = set()
        for info in self._node.get_subscriptions_info_by_topic(topic):
            name = f'{info.node_namespace.rstrip("/")}/{info.node_name}'
            if name == own or name in self._silent:
                continue
            if name not in self._clients:
                service = f'{name}/get_parameter_types'
                self._clients[name] = self._node.create_client(GetParameterTypes, service)
            if self._clients[name].wait_for_service(REPLY_TIMEOUT_S):
                found.add(name)
            else:  # a listener without parameters can't be asked
                self._silent.add(name)
        return found

    def _ask(self, name: str) -> threading.Event:
        answered = threading.Event()
        future = self._clients[name].call_async(GetParameterTypes.Request())
        future.add_done_callback(lambda _future: answered.set())
        return answered

    def _answers(self, name: str, answered: threading.Event, attempts: int) -> bool:
        """Wait for a listener's answer; it is asked again, for an answer can miss a new client."""
        for _ in range(attempts):
            end_s = time.monotonic() + REPLY_TIMEOUT_S
            while time.monotonic() < end_s:
                if answered.wait(POLL_S):
                    return True
                if self._given_up.is_set() or not self._clients[name].service_is_ready():
                    return False
            answered = self._ask(name)
        self._node.get_logger().warning(f'{name} does not answer; going on without it')
        return False
