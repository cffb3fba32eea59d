"""Subscribes to a topic: a single publisher is believed, and late frames give way to the newest. A
node that is slower than its input discards the waiting messages, takes the newest and reports so;
one that only paused may catch up, and loses nothing.
"""

import os
import time
from collections import deque
from collections.abc import Callable, Hashable, Mapping
from functools import partial
from statistics import median
from typing import Any

from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String

from anser_ros.integrity.streams import Senders
from anser_ros.nodes.runtime import qos
from anser_ros.nodes.runtime.node import AnserNode, opened
from anser_ros.nodes.streams.clouds import without_measured
from anser_ros.stamps import NANO, SECOND_NS, is_live, stamp_of
from anser_ros.wire.cdr import PointCloud


def too_slow(skipped: int, worked: int) -> str:
    """Return what part of the windows since the last look gave way to newer ones, with the
    system's load; empty for none.
    """
    if not skipped:
        return ''
    share = 100 * skipped / (skipped + worked)
    load, cores = os.getloadavg()[0], os.cpu_count() or 1
    percent = f'{share:.0f} %' if share >= 1 else 'less than 1 %'
    return f'computer too slow: {percent} of windows skipped, load {load:.1f} on {cores} cores'


LATE_WINDOWS = 3.0
"""Age, in spacings of messages, from which one may be late, more than a busy machine's jitter."""
SHORTEST_LATE_S = 0.05
"""Age, s, below which no message is late, however fast messages come: the executor has delays."""
CATCH_UP_S = 1.0
"""A backlog that will be gone within this time is worked off."""
MEMORY = 25
"""Messages that typical figures are taken of, so that a few slow ones say nothing."""
FEWEST_MESSAGES = 10
"""Messages that must have been worked on before a backlog is judged: the first ones are slow."""

MOST_LEFT_OUT = 2
"""Frames in a row that may be left out: no model may be older than metal in a hand allows."""


class Backlog:
    """Estimates the typical spacing of messages, and the time that each takes."""

    def __init__(self, spacing_s: float | None = None) -> None:
        known = () if spacing_s is None else (spacing_s,)
        self._spacing_s: deque[float] = deque(known, maxlen=MEMORY)
        self._work_s: deque[float] = deque(maxlen=MEMORY)
        self._last = (0, 0)
        self._left_out = 0

    def arrived(self, received_ns: int, stamp_ns: int) -> None:
        """Note when the middleware received the message that is worked on next, and its stamp.

        A burst of messages does not count as faster than its stamps.
        """
        last, self._last = self._last, (received_ns, stamp_ns)
        if last[0]:
            self._spacing_s.append(max(received_ns - last[0], stamp_ns - last[1], 0) * NANO)

    def worked(self, seconds: float) -> None:
        """Note how long a message took."""
        self._work_s.append(seconds)

    def is_hopeless(self, age_s: float) -> bool:
        """Return whether a message of this age shows a backlog that will not be gone soon."""
        if age_s < SHORTEST_LATE_S or len(self._work_s) < FEWEST_MESSAGES:
            return False
        spacing_s, work_s = median(self._spacing_s), median(self._work_s)
        if age_s < LATE_WINDOWS * spacing_s:
            return False
        share = work_s / max(spacing_s, 1e-9)
        return share >= 1.0 or age_s * share / (1.0 - share) > CATCH_UP_S

    def gives_way(self, age_s: float) -> bool:
        """Return whether to leave out, of a frame so old, work that can wait for newer ones: once
        half of the time until the next one is over.
        """
        behind = bool(self._spacing_s) and age_s > 0.5 * median(self._spacing_s)
        is_left_out = behind and self._left_out < MOST_LEFT_OUT
        self._left_out = self._left_out + 1 if is_left_out else 0
        return is_left_out


LOOK_S = 0.1
"""How often the graph is asked at most, s, while messages go on as before."""
SETTLED_S = 0.3
"""Time, s, after the first refused message in which the graph has to go on knowing one publisher
before it is asked again what holds: it takes 0.1 s to know one whose message came already."""
NUMBER = 'publication_sequence_number'
"""Key of a message's information: which of its publisher's messages it is."""


class OneSource:
    """Subscribes to a topic; what comes while it has several senders is not passed on.

    ``doubted`` takes messages that are not believed. ``lasting`` returns what a message says if
    that holds until its sender says otherwise, else None; if that ``is_constant``, who says
    otherwise is another sender. The ``subscription`` to a latched topic is made again once it has
    a single sender again.
    """

    def __init__(
        self,
        node: AnserNode,
        message_type: type,
        topic: str,
        callback: Callable[[Any], None],
        profile: QoSProfile,
        doubted: Callable[[Any], None] | None = None,
        lasting: Callable[[Any], Hashable] | None = None,
        is_constant: bool = False,
    ) -> None:
        self._node, self._topic = node, topic
        self._name = node.resolve_topic_name(topic)
        self._callback, self._doubted, self._lasting = callback, doubted, lasting
        self._arguments = message_type, profile
        self._sources = Senders(topic, is_constant)
        self._publishers, self._looked_s = 0, 0.0
        self._refused_s: float | None = None
        self.subscription = self._subscribed()
        if self.subscription is None:  # nodes of this process give it as objects, without numbers
            self._sources.take(None, 0, 0.0)

    @property
    def complaint(self) -> str:
        """Return why the topic can't be believed now; empty while it has one sender."""
        now_s = time.monotonic()
        complaint = self._sources.look(self.publishers(), now_s)
        latched = self._arguments[1].durability == DurabilityPolicy.TRANSIENT_LOCAL
        if self._refused_s is not None and self._publishers > 1:
            self._refused_s = now_s
        elif latched and self._refused_s is not None and now_s - self._refused_s > SETTLED_S:
            # Who is left says again what holds.
            self._refused_s = None
            self._sources.forget()
            self._node.destroy_subscription(self.subscription)
            self.subscription = self._subscribed()
        return complaint

    def publishers(self) -> int:
        """Return how many publishers the graph knows, idle ones included."""
        now_s = time.monotonic()
        if now_s - self._looked_s > LOOK_S:
            self._publishers, self._looked_s = self._node.count_publishers(self._name), now_s
        return self._publishers

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
        is_good = self._sources.take(number, self.publishers(), now_s, lasting)
        if not is_good:
            # A successor that goes on publishing is refused again and again: the first counts.
            if self._refused_s is None or self._publishers > 1:
                self._refused_s = now_s
            self._node.warn('messages_of_two_sources', self._sources.complaint)
        return is_good

    def _subscribed(self) -> Any:
        message_type, profile = self._arguments
        return self._node.create_subscription(message_type, self._topic, self._take, profile)

    def _take(self, message: Any, info: Mapping[str, Any]) -> None:
        lasting = None if self._lasting is None else self._lasting(message)
        if self.accepts(info, lasting):
            self._deliver(message, info)
        elif self._doubted is not None:
            self._doubted(message)

    def _deliver(self, message: Any, _info: Mapping[str, Any]) -> None:
        self._callback(message)


def setup_source(node: AnserNode, callback: Callable[[Any], None]) -> OneSource:
    """Subscribe to the setup document, which is one sender's for good but for what it measures."""
    return OneSource(
        node, String, 'setup', callback, qos.LATCHED,
        lasting=lambda text: without_measured(text.data), is_constant=True,
    )  # fmt: skip


def sender_words(sources: list[OneSource]) -> str:
    """Return the topics with several senders, in words; empty if each has one."""
    return '; '.join(filter(None, [source.complaint for source in sources]))


class NewestSource(OneSource):
    """Subscribes to fluxes; a frame that is late beyond hope gives way to the newest.

    What can be caught up with shows how long frames take: the callback's time, or what a caller
    that works on frames later reports to the ``backlog``.
    """

    def __init__(
        self,
        node: AnserNode,
        topic: str,
        callback: Callable[[Any], None],
        doubted: Callable[[Any], None] | None = None,
        works_later: bool = False,
    ) -> None:
        self._works_later, self.backlog = works_later, Backlog()
        super().__init__(node, PointCloud2, topic, callback, qos.STREAM, doubted)

    def _deliver(self, message: PointCloud, info: Mapping[str, Any]) -> None:
        newest = self._newest(message, info)
        begin_s = time.perf_counter()
        if newest is not None:
            self._callback(newest)
        if not self._works_later:
            self.backlog.worked(time.perf_counter() - begin_s)

    def _newest(self, message: PointCloud, info: Mapping[str, Any]) -> PointCloud | None:
        """The message, or the newest that waits; None where those that wait are another's."""
        received_ns = info.get('received_timestamp') or info.get('source_timestamp') or 0
        now_ns, stamp_ns = time.time_ns(), stamp_of(message)
        self.backlog.arrived(received_ns, stamp_ns)
        # Nobody steers by a recording that is played: it is worked off whole.
        live = is_live(stamp_ns, now_ns)
        age_s = (now_ns - received_ns) / SECOND_NS
        if not (live and received_ns and self.backlog.is_hopeless(age_s)):
            return message
        waiting = take_waiting(self.subscription)
        believed = [self.accepts(about) for _, about in waiting]
        if not all(believed):
            return None
        if not waiting:
            return message
        self._node.count('frames_skipped', len(waiting))
        newest: PointCloud = opened(waiting[-1][0], PointCloud2)
        return newest


def take_waiting(subscription: Any) -> list[tuple[bytes, dict[str, int]]]:
    """Take the messages that wait in a queue, oldest first, as bytes with their information."""
    with subscription.handle:
        take = partial(subscription.handle.take_message, subscription.msg_type, subscription.raw)
        return [(data, info) for data, info, *_ in iter(take, None)]
