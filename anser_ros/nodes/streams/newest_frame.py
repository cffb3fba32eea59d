"""Chooses which frame a node works on next: the one that came, or the newest of a backlog."""

import time
from collections.abc import Callable, Mapping
from typing import Any

from sensor_msgs.msg import PointCloud2

from anser_ros.nodes.runtime import qos
from anser_ros.nodes.runtime.handover import HandedFlux
from anser_ros.nodes.runtime.incoming import opened
from anser_ros.nodes.runtime.node import AnserNode
from anser_ros.nodes.streams.backlog import Backlog
from anser_ros.nodes.streams.one_source import OneSource
from anser_ros.stamps import SECOND_NS, is_live, stamp_of


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
        doubted: Callable[..., None] | None = None,
        works_later: bool = False,
    ) -> None:
        self._work, self._works_later, self.backlog = callback, works_later, Backlog()
        super().__init__(
            node, PointCloud2, topic, self._on_frame, qos.STREAM, doubted, informed=True
        )

    def _on_frame(self, message: PointCloud2 | HandedFlux, info: Mapping[str, Any]) -> None:
        newest = message
        if not isinstance(message, HandedFlux):  # what is handed over has no queue
            newest = self._newest(message, info)
        begin_s = time.perf_counter()
        if newest is not None:
            self._work(newest)
        if not self._works_later:
            self.backlog.worked(time.perf_counter() - begin_s)

    def _newest(self, message: PointCloud2, info: Mapping[str, Any]) -> PointCloud2 | None:
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
        return opened(waiting[-1][0], PointCloud2)


def take_waiting(subscription: Any) -> list[tuple[bytes, dict[str, int]]]:
    """Take the messages that wait in a queue, oldest first, as bytes with their information."""
    taken: list[tuple[bytes, dict[str, int]]] = []
    with subscription.handle:
        while True:
            item = subscription.handle.take_message(subscription.msg_type, subscription.raw)
            if item is None:
                return taken
            taken.append((item[0], item[1]))
