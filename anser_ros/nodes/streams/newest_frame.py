"""Chooses which frame a node works on next: the one that came, or the newest of a backlog."""

import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from sensor_msgs.msg import PointCloud2

from anser_ros.nodes.runtime import qos
from anser_ros.nodes.runtime.handover import HandedFlux
from anser_ros.nodes.runtime.incoming import opened
from anser_ros.nodes.streams.backlog import Backlog
from anser_ros.nodes.streams.one_source import OneSource
from anser_ros.stamps import SECOND_NS, is_live, stamp_of

if TYPE_CHECKING:
    from anser_ros.nodes.runtime.node import AnserNode


class NewestSource(OneSource):
    """Subscribes to a topic of fluxes; a frame that is late beyond hope gives way to the newest.

    Parameters
    ----------
    node : AnserNode
    topic : str
    callback : callable
        Works on a frame at once; how long that takes tells what can be caught up with.
    """

    def __init__(self, node: 'AnserNode', topic: str, callback: Callable[[Any], None]) -> None:
        self._work, self._backlog = callback, Backlog()
        super().__init__(node, PointCloud2, topic, self._on_frame, qos.STREAM, informed=True)

    def _on_frame(self, message: PointCloud2 | HandedFlux, info: Mapping[str, Any]) -> None:
        newest = message
        if not isinstance(message, HandedFlux):  # what is handed over has no queue
            newest = newest_of(message, info, self._backlog, self, self._node.count)
        begin_s = time.perf_counter()
        if newest is not None:
            self._work(newest)
        self._backlog.worked(time.perf_counter() - begin_s)


def newest_of(
    message: PointCloud2,
    info: Mapping[str, Any],
    backlog: Backlog,
    source: OneSource,
    count: Callable[[str, int], None],
) -> PointCloud2 | None:
    """Return a message, or the newest that waits where it is late beyond hope.

    Parameters
    ----------
    message : PointCloud2
        A frame, just taken.
    info : mapping
        What the middleware tells of it.
    backlog : Backlog
        Of its topic.
    source : OneSource
        Where it came from.
    count : callable
        Counts the frames that gave way as ``frames_skipped``.

    Returns
    -------
    PointCloud2 or None
        None where frames that wait are another sender's.
    """
    received_ns = info.get('received_timestamp') or info.get('source_timestamp') or 0
    now_ns, stamp_ns = time.time_ns(), stamp_of(message)
    backlog.arrived(received_ns, stamp_ns)
    # Nobody steers by a recording that is played: it is worked off whole.
    live = is_live(stamp_ns, now_ns)
    if not (live and received_ns and backlog.is_hopeless((now_ns - received_ns) / SECOND_NS)):
        return message
    waiting = take_waiting(source.subscription)
    believed = [source.accepts(about) for _, about in waiting]
    if not all(believed):
        return None
    if not waiting:
        return message
    count('frames_skipped', len(waiting))
    return opened(waiting[-1][0], PointCloud2)


def take_waiting(subscription: Any) -> list[Any]:
    """Return messages, as bytes and with their information, that wait in a queue, oldest first.

    This removes them from the queue.
    """
    taken: list[Any] = []
    with subscription.handle:
        while True:
            item = subscription.handle.take_message(subscription.msg_type, subscription.raw)
            if item is None:
                return taken
            taken.append((item[0], item[1]))
