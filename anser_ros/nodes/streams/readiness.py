"""Detects when all subscribers of a replay are ready, so that nothing of it is lost.

The graph shows who subscribes to the fluxes and to the poses that the setup promises, and which of
the nodes that work on fluxes are running. ``/diagnostics`` tells whether the tracker has the
setup, its model, and everybody connected who wants its poses (``ready_for``), how many those are
(``pose_listeners``: it may not know yet whom the replay knows), and that its model is the one that
``field_model`` serves. A subscriber that starts later than that cannot be waited for.
"""

import hashlib
import time
from collections.abc import Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray

from anser_ros import extensions
from anser_ros.errors import SetupError
from anser_ros.nodes.runtime import qos
from anser_ros.nodes.runtime.diagnostics import statuses_in
from anser_ros.nodes.runtime.node import AnserNode
from anser_ros.wire.setup import parse_setup, topic_of
from anser_ros.wire.setup_values import tip_name

TRACKER, FIELD_MODEL = 'tracker', 'field_model'
# They take what there is, and nobody waits for them alone.
PASSIVE = ('recorder', 'openigtlink', 'monitor', 'watcher', *extensions.entries('PASSIVE'))
LOOK_S = 3.3
"""Least time to look for others: nodes that are not ours announce themselves a few times at their
start and then every three seconds, and who joins in between does not know them before."""
SETTLE_S = 1.0
"""The graph must not have changed for so long: ours announce themselves twice as often, and a
recorder looks for new topics more often still."""
PATIENCE_S = 8.0
"""The same while somebody is missed who may still be starting."""


def digest_of(setup_text: str) -> str:
    """Return eight hexadecimal digits that distinguish setups."""
    return hashlib.blake2b(setup_text.encode(), digest_size=4).hexdigest()


class Readiness:
    """Watches the graph and ``/diagnostics`` from a node whose executor spins elsewhere.

    ``is_starting`` says whether `missing` found a node that has not reported anything yet: it may
    be compiling its kernels for the first time.
    """

    def __init__(self, node: AnserNode, fluxes: list[Any], setup_text: str) -> None:
        self._node, self._fluxes = node, fluxes
        self._namespace = node.get_namespace()
        self._digest = digest_of(setup_text)
        self._poses: list[str] = []
        try:
            setup = parse_setup(setup_text)
            names = [sensor.name for sensor in setup.tool_sensors]
            self._poses = [
                f'{topic_of(name)}/{kind}'
                for name in (*names, *setup.bodies, *map(tip_name, setup.tips))
                for kind in ('pose', 'pose_with_covariance')
            ]
        except SetupError:
            pass  # who listens may make more of it
        # When a node reported last, by the monotonic clock, and its figures.
        self._reports: dict[str, tuple[float, Mapping[str, str]]] = {}
        self._seen: object = None
        self._since_s = time.monotonic()
        self.is_starting = False
        self._subscription = node.create_subscription(
            DiagnosticArray, '/diagnostics', self._on_diagnostics, qos.EVENTS
        )

    def close(self) -> None:
        """Stop watching the listeners."""
        self._node.destroy_subscription(self._subscription)

    def missing(self) -> str:
        """Return what is waited for; empty when all who can be known are ready."""
        now_s = time.monotonic()
        listeners = {flux.topic_name: self._listeners(flux.topic_name) for flux in self._fluxes}
        matched = [flux.get_subscription_count() for flux in self._fluxes]
        wanted = [self._node.count_subscribers(topic) for topic in self._poses]
        given = [self._node.count_publishers(topic) for topic in self._poses]
        working = self._working_nodes()
        reached = self._pose_listeners()
        seen = (listeners, matched, wanted, given, working, reached)
        if seen != self._seen:
            self._seen, self._since_s = seen, now_s
        self.is_starting = any(name.strip('/') not in self._reports for name in working)
        quiet_s = now_s - self._since_s
        if not any(matched):
            return 'nobody subscribes to the fluxes'
        unready = [name for name in working if not self._is_ready(name, listeners)]
        if TRACKER in (name.rsplit('/', 1)[1] for name in working) and reached < sum(wanted):
            unready.append('a subscriber to poses')
        if unready:
            return f'{", ".join(unready)} not ready'
        if quiet_s < SETTLE_S or now_s - self._node.started_s < LOOK_S:
            return 'others may still be starting'
        if quiet_s < PATIENCE_S:
            return self._missed(listeners, matched, wanted, given)
        return ''

    # What is known ------------------------------------------------------------------------

    def _missed(
        self,
        listeners: dict[str, tuple[str, ...]],
        matched: list[int],
        wanted: list[int],
        given: list[int],
    ) -> str:
        """Return who should be there by what others are waiting for."""
        for (topic, names), count in zip(listeners.items(), matched, strict=True):
            if all(name.rsplit('/', 1)[1] in PASSIVE for name in names):
                return f'no node processes {topic}'
            if count < len(names):
                return f'not all subscribers to {topic} are connected'
        if any(want and not give for want, give in zip(wanted, given, strict=True)):
            return 'no node publishes the poses that somebody subscribes to'
        return ''

    def _listeners(self, topic: str) -> tuple[str, ...]:
        infos = self._node.get_subscriptions_info_by_topic(topic)
        return tuple(sorted(f'{i.node_namespace.rstrip("/")}/{i.node_name}' for i in infos))

    def _working_nodes(self) -> tuple[str, ...]:
        """Full names of the nodes of this namespace that work on fluxes."""
        found = self._node.get_node_names_and_namespaces()
        own = self._namespace.rstrip('/')
        return tuple(
            sorted(
                f'{own}/{name}'
                for name, namespace in found
                if namespace.rstrip('/') == own and name in (TRACKER, FIELD_MODEL)
            )
        )

    def _pose_listeners(self) -> int:
        """How many subscriptions the tracker reaches; it may not know all who are known here."""
        report = self._reports.get(f'{self._namespace}/{TRACKER}'.strip('/'))
        return 0 if report is None else int(report[1].get('pose_listeners') or 0)

    def _is_ready(self, name: str, listeners: dict[str, tuple[str, ...]]) -> bool:
        report = self._reports.get(name.strip('/'))
        # It must have looked at the graph as it is now.
        if report is None or report[0] < self._since_s:
            return False
        values = report[1]
        is_listening = any(name in names for names in listeners.values())
        if name.endswith(FIELD_MODEL):
            return is_listening and bool(values.get('stamp_ns'))
        if values.get('ready_for') != self._digest or not is_listening:
            return False
        server = self._reports.get(name.strip('/').removesuffix(TRACKER) + FIELD_MODEL)
        served = '' if server is None else server[1].get('stamp_ns', '')
        return not served or values.get('model_stamp_ns') == served

    @property
    def poses(self) -> list[str]:
        """Return topics of the poses that are made of the fluxes."""
        return [self._node.resolve_topic_name(topic) for topic in self._poses]

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        now_s = time.monotonic()
        for name, status in statuses_in(message).items():
            self._reports[name] = now_s, status.values
