"""Detects when all subscribers of a replay are ready, so that nothing of it is lost.

The graph shows who subscribes to fluxes and poses, and which nodes work on fluxes. The tracker's
``/diagnostics`` tell whether it has the setup, its model, and everybody connected who wants its
poses (``ready_for``), how many those are (``pose_listeners``), and that its model is the one that
``field_model`` serves.
"""

import contextlib
import math
import time
from collections.abc import Mapping
from itertools import chain
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray

from anser_ros import extensions
from anser_ros.errors import SetupError
from anser_ros.fingerprint import fingerprint_of
from anser_ros.nodes.runtime import qos
from anser_ros.nodes.runtime.diagnostics import statuses_in
from anser_ros.nodes.runtime.node import AnserNode
from anser_ros.wire.setup import parse_setup, topic_of
from anser_ros.wire.setup_values import tip_name

TRACKER, FIELD_MODEL = 'tracker', 'field_model'
# They take what there is, and nobody waits for them alone.
PASSIVE = ('recorder', *chain(*extensions.tables('PASSIVE')))
LOOK_S = 3.3
"""Least time to look for others, s: nodes that are not ours announce themselves every three."""
SETTLE_S = 1.0
"""Time, s, for which the graph must not have changed: ours announce themselves twice as often."""
PATIENCE_S = 8.0
"""The same while somebody is missed who may still be starting."""


class Readiness:
    """Watches the graph and ``/diagnostics`` from a node whose executor spins elsewhere.

    ``is_starting`` says whether `missing` found a node that has not reported anything yet: it may
    be compiling its kernels for the first time.
    """

    def __init__(self, node: AnserNode, fluxes: list[Any], setup_text: str) -> None:
        self._node, self._fluxes = node, fluxes
        self._home = node.get_namespace().rstrip('/')
        self._digest = fingerprint_of(setup_text)
        names: list[str] = []
        with contextlib.suppress(SetupError):  # who listens may make more of it
            setup = parse_setup(setup_text)
            sensors = (sensor.name for sensor in setup.tool_sensors)
            names = [*sensors, *setup.bodies, *map(tip_name, setup.tips)]
        kinds = 'pose', 'pose_with_covariance'
        # Topics of the poses that are made of the fluxes.
        self.poses = [
            node.resolve_topic_name(f'{topic_of(name)}/{kind}') for name in names for kind in kinds
        ]
        # When a node reported last, by the monotonic clock, and its figures.
        self._reports: dict[str, tuple[float, Mapping[str, str]]] = {}
        self._seen: object = None
        self._since_s = time.monotonic()
        self.is_starting = False
        self._subscription = node.create_subscription(
            DiagnosticArray, '/diagnostics', self._on_diagnostics, qos.EVENTS
        )

    def close(self) -> None:
        self._node.destroy_subscription(self._subscription)

    def missing(self) -> str:
        """Return what is waited for; empty when all who can be known are ready."""
        now_s = time.monotonic()
        listeners = {flux.topic_name: self._listeners(flux.topic_name) for flux in self._fluxes}
        matched = [flux.get_subscription_count() for flux in self._fluxes]
        wanted = [self._node.count_subscribers(topic) for topic in self.poses]
        given = [self._node.count_publishers(topic) for topic in self.poses]
        present = [f'{s.rstrip("/")}/{n}' for n, s in self._node.get_node_names_and_namespaces()]
        tracker, server = f'{self._home}/{TRACKER}', f'{self._home}/{FIELD_MODEL}'
        working = [name for name in (server, tracker) if name in present]
        # How many subscriptions the tracker reaches; it may not know all who are known here.
        reached = int(self._report(tracker)[1].get('pose_listeners') or 0)
        seen = (listeners, matched, wanted, given, working, reached)
        if seen != self._seen:
            self._seen, self._since_s = seen, now_s
        self.is_starting = any(name.strip('/') not in self._reports for name in working)
        quiet_s = now_s - self._since_s
        if not any(matched):
            return 'nobody subscribes to the fluxes'
        unready = [name for name in working if not self._is_ready(name, listeners)]
        if tracker in working and reached < sum(wanted):
            unready.append('a subscriber to poses')
        if unready:
            return f'{", ".join(unready)} not ready'
        if quiet_s < SETTLE_S or now_s - self._node.started_s < LOOK_S:
            return 'others may still be starting'
        if quiet_s >= PATIENCE_S:
            return ''
        # Who should be there by what others are waiting for.
        for (topic, names), count in zip(listeners.items(), matched, strict=True):
            if all(name.rsplit('/', 1)[1] in PASSIVE for name in names):
                return f'no node processes {topic}'
            if count < len(names):
                return f'not all subscribers to {topic} are connected'
        if any(want and not give for want, give in zip(wanted, given, strict=True)):
            return 'no node publishes the poses that somebody subscribes to'
        return ''

    # What is known ------------------------------------------------------------------------

    def _listeners(self, topic: str) -> list[str]:
        infos = self._node.get_subscriptions_info_by_topic(topic)
        return sorted(f'{i.node_namespace.rstrip("/")}/{i.node_name}' for i in infos)

    def _report(self, name: str) -> tuple[float, Mapping[str, str]]:
        return self._reports.get(name.strip('/'), (-math.inf, {}))

    def _is_ready(self, name: str, listeners: dict[str, list[str]]) -> bool:
        reported_s, values = self._report(name)
        is_server = name.endswith(FIELD_MODEL)
        takes = '/reference/flux' if is_server else '/tool/flux'
        # It listens to what of that is played, and has looked at the graph as it is now.
        is_listening = all(
            name in names for topic, names in listeners.items() if topic.endswith(takes)
        )
        if reported_s < self._since_s or not is_listening:
            return False
        if is_server:
            return bool(values.get('stamp_ns')) and values.get('awaits_refit') != str(True)
        served = self._report(f'{self._home}/{FIELD_MODEL}')[1].get('stamp_ns', '')
        has_model = not served or values.get('model_stamp_ns') == served
        return values.get('ready_for') == self._digest and has_model

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        now_s = time.monotonic()
        for name, status in statuses_in(message).items():
            self._reports[name] = now_s, status.values
