"""Subscribes to a topic, uses a single publisher of it, and reports when there are more."""

import time
from collections.abc import Callable, Hashable, Mapping
from types import MappingProxyType
from typing import Any

from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String

from anser_ros.integrity.senders import Senders
from anser_ros.nodes.runtime import qos
from anser_ros.nodes.runtime.node import AnserNode
from anser_ros.nodes.streams.measured_keys import without_measured

LOOK_S = 0.1
"""How often the graph is asked at most, s, while messages go on as before: it takes 15 us.
Smaller costs more; larger, and who only begins to publish is noticed later."""
SETTLED_S = 0.3
"""Time, s, after the first refused message in which the graph has to go on knowing one publisher
before it is asked again what holds. Smaller, and a second publisher is believed whose message came
before the graph knew it, which takes about 0.1 s; larger, and a successor is believed later."""
NO_INFORMATION: Mapping[str, Any] = MappingProxyType({})
"""What is known of a message that was handed over within the process: its sender is ours, and a
second one is known to the graph alone."""
NUMBER = 'publication_sequence_number'
"""Key of a message's information: which of its publisher's messages it is."""


class OneSource:
    """Subscribes to a topic; what comes while it has several senders is not passed on.

    The callback takes the message alone, or its information too where ``informed``; ``doubted``
    takes messages that are not believed. ``lasting`` returns what a message says if that holds
    until its sender says otherwise, else None; if that ``is_constant``, who says otherwise is
    another sender. The ``subscription`` to a latched topic is made again once it has a single
    sender again.
    """

    def __init__(
        self,
        node: AnserNode,
        message_type: type,
        topic: str,
        callback: Callable[..., None],
        profile: QoSProfile,
        doubted: Callable[..., None] | None = None,
        lasting: Callable[[Any], Hashable] | None = None,
        is_constant: bool = False,
        informed: bool = False,
    ) -> None:
        self._node, self._topic = node, topic
        self._name = node.resolve_topic_name(topic)
        self._callback, self._doubted, self._lasting = callback, doubted, lasting
        self._informed = informed
        self._arguments = message_type, profile
        self._sources = Senders(topic, is_constant)
        self._publishers, self._looked_s = 0, 0.0
        self._refused_s: float | None = None
        self.subscription = self._subscribed()

    @property
    def complaint(self) -> str:
        """Return why the topic can't be believed now; empty while it has one sender."""
        now_s = time.monotonic()
        complaint = self._sources.look(self._count(now_s), now_s)
        latched = self._arguments[1].durability == DurabilityPolicy.TRANSIENT_LOCAL
        if self._publishers > 1 and self._refused_s is not None:
            self._refused_s = now_s
        if latched and self._refused_s is not None and now_s - self._refused_s > SETTLED_S:
            # Who is left says again what holds.
            self._refused_s = None
            self._sources.forget()
            self._node.destroy_subscription(self.subscription)
            self.subscription = self._subscribed()
        return complaint

    def publishers(self) -> int:
        """Return how many publishers the graph knows, idle ones included."""
        return self._count(time.monotonic())

    def sender(self) -> str:
        """Return what identifies the only publisher in the graph; empty where there is another
        number of them.
        """
        known = self._node.get_publishers_info_by_topic(self._name)
        return bytes(known[0].endpoint_gid).hex() if len(known) == 1 else ''

    def accepts(self, info: Mapping[str, Any], lasting: Hashable = None) -> bool:
        """Take a message's information; return whether the message may be used."""
        now_s, number = time.monotonic(), info.get(NUMBER)
        if number is not None and not self._sources.continues(number):
            self._looked_s = 0.0  # the graph as it is at this moment is needed
        is_good = self._sources.take(number, self._count(now_s), now_s, lasting)
        if not is_good:
            # A successor that goes on publishing is refused again and again: the first counts.
            if self._refused_s is None or self._publishers > 1:
                self._refused_s = now_s
            self._node.warn('messages_of_two_sources', self._sources.complaint)
        return is_good

    def _subscribed(self) -> Any:
        message_type, profile = self._arguments
        return self._node.create_subscription(
            message_type, self._topic, self._take, profile, handed=self._take_handed
        )

    def _take_handed(self, what: Any) -> None:
        self._take(what, NO_INFORMATION)

    def _take(self, message: Any, info: Mapping[str, Any]) -> None:
        lasting = None if self._lasting is None else self._lasting(message)
        callback = self._callback if self.accepts(info, lasting) else self._doubted
        if callback is not None:
            callback(message, *([info] if self._informed else []))

    def _count(self, now_s: float) -> int:
        """How many publishers the graph knows."""
        if now_s - self._looked_s > LOOK_S:
            self._publishers, self._looked_s = self._node.count_publishers(self._name), now_s
        return self._publishers


def setup_source(node: AnserNode, callback: Callable[[Any], None]) -> OneSource:
    """Subscribe to the setup document, which is one sender's for good but for what it measures."""
    return OneSource(
        node, String, 'setup', callback, qos.LATCHED,
        lasting=lambda text: without_measured(text.data), is_constant=True,
    )  # fmt: skip


def sender_words(sources: list[OneSource]) -> str:
    """Return the topics with several senders, in words; empty if each has one."""
    return '; '.join(filter(None, [source.complaint for source in sources]))
