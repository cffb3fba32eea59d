"""Hands frames and models from node to node in one process: as objects, without the middleware.

A message that is handed over is also published, for the recorder and all other subscribers. A node
that receives a topic in this way has no subscription to it: it would process everything twice.
"""

import threading
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from anser_ros.wire.points import FluxPoints

Taker = Callable[[Any], object]


@dataclass(frozen=True)
class HandedFlux:
    """Holds the fluxes of a window, as a reader of their message has them."""

    stamp_ns: int
    frame_id: str
    points: FluxPoints


@dataclass(frozen=True, eq=False)
class DirectSubscription:
    """Replaces a subscription where messages are passed directly to a node."""

    topic_name: str
    taker: Taker


class NewestWorker:
    """Processes the newest object handed over in a thread, so that the sender need not wait.

    ``skipped`` is called for each object that a newer one of its topic has replaced.
    """

    def __init__(self, skipped: Callable[[], object]) -> None:
        self._skipped, self._is_ending = skipped, False
        self._waiting: dict[str, tuple[Taker, Any]] = {}
        self._news = threading.Condition()
        self._thread = threading.Thread(target=self._run, name='aside', daemon=True)
        self._thread.start()

    def put(self, topic: str, taker: Taker, what: Any) -> None:
        """Have a taker work on something as soon as the thread can."""
        with self._news:
            if topic in self._waiting:
                self._skipped()
            self._waiting[topic] = taker, what
            self._news.notify()

    def end(self, timeout_s: float) -> bool:
        """End the thread after what it works on now; whether that was soon enough over."""
        with self._news:
            self._is_ending = True
            self._news.notify()
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            with self._news:
                self._news.wait_for(lambda: self._waiting or self._is_ending)
                if self._is_ending:
                    return
                taker, what = self._waiting.pop(next(iter(self._waiting)))
            taker(what)


class Handover:
    """Keeps the topics that nodes of this process offer each other, by their full names."""

    def __init__(self) -> None:
        self._takings: defaultdict[str, list[DirectSubscription]] = defaultdict(list)
        self._offered: dict[str, bool] = {}
        self._last: dict[str, Any] = {}

    def offer(self, topic: str, *, lasts: bool = False) -> None:
        """Declare that the messages of a topic will be passed to receivers directly, the last one
        to a later receiver too if it ``lasts``.
        """
        self._offered[topic] = lasts

    def offers(self, topic: str) -> bool:
        """Return whether the messages of a topic are passed to its receivers directly."""
        return topic in self._offered

    def take(self, topic: str, taker: Taker) -> DirectSubscription:
        """Have all that is given on a topic go to a callable, in the thread of who gives it."""
        taking = DirectSubscription(topic, taker)
        self._takings[topic].append(taking)
        if topic in self._last:
            taker(self._last[topic])
        return taking

    def drop(self, taking: DirectSubscription) -> None:
        """End what `take` began."""
        self._takings[taking.topic_name].remove(taking)

    def give(self, topic: str, what: Any) -> None:
        """Give something to all who take a topic."""
        if self._offered[topic]:
            self._last[topic] = what
        for taking in tuple(self._takings[topic]):
            taking.taker(what)
