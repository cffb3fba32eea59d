"""Gives the page what the graph shows: topics are polled, and become arrays and words.

Between two looks a message costs no Python: an executor would run Python for each, while a display
needs only the newest; the middleware keeps as many as the queue is deep.
"""

import copy
import math
import os
import struct
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import deserialize_message
from visualization_msgs.msg import Marker, MarkerArray

from anser_ros.apps.dashboard.nodes.live_view import LiveView, known
from anser_ros.errors import AnserError, LayoutError
from anser_ros.nodes.runtime import node, qos
from anser_ros.nodes.runtime.diagnostics import LastStatus, statuses_in
from anser_ros.nodes.streams.one_source import take_waiting
from anser_ros.wire.recorded import optical_topic
from anser_ros.wire.setup import parse_setup, topic_of

LEAST_S = 1.0
"""Least time, s, over which shares are taken: the system counts in ticks of 10 ms."""


class Processor:
    """Measures shares since the last look that was long enough ago."""

    def __init__(self) -> None:
        self._own_s, self._at_s = time.process_time(), time.monotonic()
        self._busy = _busy()
        self._shares = 0.0, 0.0

    def shares(self) -> tuple[float, float]:
        """Return this process's share of one processor, and how much of all is in use, 0 to 1."""
        now_s = time.monotonic()
        elapsed_s = now_s - self._at_s
        if elapsed_s >= LEAST_S:
            own_s, busy = time.process_time(), _busy()
            whole = max(busy[1] - self._busy[1], 1)
            self._shares = (own_s - self._own_s) / elapsed_s, (busy[0] - self._busy[0]) / whole
            self._own_s, self._at_s, self._busy = own_s, now_s, busy
        return self._shares


def _busy() -> tuple[int, int]:
    """Ticks in use and all ticks since the start of the system; zeros where it does not tell."""
    if not os.path.exists('/proc/stat'):
        return 0, 0
    with open('/proc/stat', encoding='ascii') as lines:
        ticks = [int(text) for text in lines.readline().split()[1:9]]
    # user, nice, system, idle, iowait, irq, softirq, steal
    return sum(ticks) - ticks[3] - ticks[4], sum(ticks)


STREAMS = '_streams'
"""What the name of the node that is polled has behind that of its process."""


def polling_node(owner: Any) -> Node:
    """Return a node beside another one, for no executor: its subscriptions are polled."""
    return Node(
        f'{owner.get_name()}{STREAMS}', namespace=owner.get_namespace(),
        start_parameter_services=False, enable_rosout=False, use_global_arguments=False,
        parameter_overrides=owner.qos_overrides,
    )  # fmt: skip


class Polled:
    """Subscribes to a topic whose messages are taken when asked for.

    The profile's depth is how many messages are kept. The node is that of `polling_node`.
    """

    def __init__(self, node: Node, message_type: type, topic: str, profile: QoSProfile) -> None:
        self._node, self._type = node, message_type
        self._subscription = node.create_subscription(
            message_type, topic, _never, copy.copy(profile), raw=True,
            qos_overriding_options=QoSOverridingOptions(qos.OVERRIDABLE),
        )  # fmt: skip

    def take(self) -> list[tuple[bytes, dict[str, int]]]:
        """Return what has come since the last time, serialised, the oldest first."""
        return take_waiting(self._subscription)

    def messages(self, refused: Callable[[str], None]) -> list[Any]:
        """Return what has come as messages; ``refused`` gets what is wrong with the others."""
        found = []
        for data, _ in self.take():
            try:
                found.append(node.opened(data, self._type))
            except LayoutError as error:
                refused(str(error))
        return found

    def close(self) -> None:
        self._node.destroy_subscription(self._subscription)


def _never(_message: Any) -> None:
    """Take what only an executor would give."""


NEWEST = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=32, reliability=ReliabilityPolicy.BEST_EFFORT
)
"""Poses as they come; the newest matters, and there is room for those of a tick at 200 Hz."""
SILENT_S = 3.5
"""Time, s, after which a node that says nothing counts as silent; it speaks once a second."""
SLOW = 0.5
"""Share of the setup's rate below which the header warns: half of the poses are missing."""
MOST_MARKS = 20
"""Moments that are marked in the curves: more words than these cover the curves."""
MOST_METAL = 400
"""Balls of metal that are drawn; all are sent to every page whenever they change."""
MOST_STATUSES = 4096
"""Names in diagnostics of which what was said is kept: several lines for each of 1000 sensors."""
COIL_M = 0.07
"""Side of an emitter coil, m, that is drawn where the setup does not state it."""


class ViewSource:
    """Shows the graph to the page; numbers that are not known are None.

    ``refused`` is called for what can't be read. ``setup_text`` is the setup document that came
    last, which another thread may put there; ``version`` changes with the view.
    """

    def __init__(
        self,
        node: Node,
        optical: str,
        refused: Callable[[str], None],
        is_there: Callable[[str], bool],
    ) -> None:
        self._node, self._optical_space = node, optical
        self._own = {node.get_fully_qualified_name().strip('/').removesuffix(STREAMS)}
        self._refused, self._is_there = refused, is_there
        self.namespace = node.get_namespace().strip('/')
        self.view: LiveView | None = None
        self.version = 0
        self.setup_text = self._shown_text = ''
        self._diagnostics = Polled(node, DiagnosticArray, '/diagnostics', qos.EVENTS)
        self._metals = Polled(node, MarkerArray, 'metal', qos.LATCHED)
        self._poses: list[Polled] = []
        self._optical: dict[str, Polled] = {}
        self._statuses: dict[str, LastStatus] = {}
        self._status_s: dict[str, float] = {}
        self.metal: list[list[float]] = []  # balls where metal seems to be: place and radius, m
        self._marks: deque[tuple[float, str]] = deque(maxlen=MOST_MARKS)
        self._processor = Processor()

    def mark(self, words: str) -> None:
        self._marks.append((time.time(), words))

    def figures(self, since_s: float) -> dict[str, float | None]:
        """Return how well it goes, not before a time (of ``time.time``)."""
        return {} if self.view is None else self.view.figures(since_s)

    # What comes in ------------------------------------------------------------------------

    def look(self) -> None:
        self._take_setup(self.setup_text)
        for message in self._diagnostics.messages(self._refused):
            self._take_statuses(message)
        if self.view is None:
            return
        for number, poses in enumerate(self._poses):
            self._read(self.view.take_pose, number, poses)
        for body, poses in self._optical.items():
            self._read(self.view.take_optical, body, poses)

    def _read(self, take: Callable[..., None], key: Any, polled: Polled) -> None:
        try:
            take(key, polled.take())
        except (ValueError, struct.error) as error:
            self._refused(str(error))

    def _take_setup(self, text: str) -> None:
        if text == self._shown_text:
            return
        self._shown_text = text
        try:
            setup = parse_setup(text)
        except AnserError as error:
            self._refused(str(error))
            return
        if self.view is not None and setup.has_same_board(self.view.setup):
            self.view.setup = setup  # another rate or noise: what is shown goes on
            return
        for polled in (*self._poses, *self._optical.values()):
            polled.close()
        view = LiveView(setup, self.namespace, self._statuses)
        self._poses = [
            Polled(self._node, PoseWithCovarianceStamped,
                   f'{topic_of(target.name)}/pose_with_covariance', NEWEST)
            for target in view.targets
        ]  # fmt: skip
        self._optical = {
            body: Polled(self._node, PoseStamped, optical_topic(body, self._optical_space), NEWEST)
            for body in sorted(view.bodies)
        }
        self.view, self.version = view, self.version + 1

    def _take_statuses(self, message: DiagnosticArray) -> None:
        for name, latest in statuses_in(message).items():
            is_known = name in self._statuses or len(self._statuses) < MOST_STATUSES
            if name.startswith(f'{self.namespace}/') and is_known:
                self._statuses[name], self._status_s[name] = latest, time.monotonic()

    def _is_silent(self, name: str) -> bool:
        return time.monotonic() - self._status_s[name] > SILENT_S

    def add_point(self) -> None:
        """Take the next point of the curves, and see where the metal is."""
        if self.view is not None:
            self.view.add_point()
        for data, _ in self._metals.take()[-1:]:
            self.metal = _balls(deserialize_message(data, MarkerArray))

    # What is shown ------------------------------------------------------------------------

    def world(self) -> dict[str, Any] | None:
        """Return what stands still, the targets, and the curves so far."""
        view = self.view
        if view is None:
            return None
        coils, side = view.setup.emitter.coils, view.setup.emitter.geometry.get('side_m', COIL_M)
        side = float(side) if isinstance(side, int | float) else COIL_M
        reach = [max(abs(c.centre_m[axis]) for c in coils) + 0.75 * side for axis in (0, 1)]
        # Numba, which it needs, is half of the start of a node that has none; a page comes later.
        from anser_ros.sessions.nominal_board import tracked_volume

        volume = tracked_volume(view.setup)
        return {
            'board_m': reach,
            'reach_m': max(reach),
            'coils': [[*c.centre_m, math.radians(c.rotation_deg), side] for c in coils],
            'references': [[*s.position_m, *s.axis] for s in view.setup.reference_sensors],
            'volume_m': [list(volume.low), list(volume.high)],
            'targets': [
                {'name': t.name, 'is_body': n >= len(view.setup.tool_sensors)}
                for n, t in enumerate(view.targets)
            ],
            'points': [_point(point) for point in view.points],
            'marks': self.marks(),
        }

    def frame(self) -> list[Any]:
        return [] if self.view is None else self.view.frame()

    def table(self) -> list[list[Any]]:
        """Return level, state, reason, sigma, error (mm), residual (pT), rate of every target."""
        view = self.view
        if view is None:
            return []
        statuses = [view.last_status(target.name) for target in view.targets]
        columns = zip(
            statuses, 1e3 * view.sigma_m(), 1e3 * view.error_m, 1e12 * view.residual_t(),
            view.rate_hz, strict=True,
        )  # fmt: skip
        return [
            [one.level, one.message, one.values.get('reason', ''), *map(known, figures)]
            for one, *figures in columns
        ]

    def point(self) -> list[Any]:
        view = self.view
        return [] if view is None or not view.points else _point(view.points[-1])

    def marks(self) -> list[list[Any]]:
        """Return the marked moments, each with its time and words."""
        return [list(mark) for mark in self._marks]

    def status(self) -> dict[str, Any]:
        view, space = self.view, self.namespace
        own, busy = self._processor.shares()
        status: dict[str, Any] = {
            'place': f'/{space}', 'tracked': 'waiting for a setup', 'level': 1, 'recording': '',
            'rate': '–', 'latency': '–', 'why': [], 'nodes': [], 'findings': [],
            'processor': f'{busy:.0%} of {os.cpu_count()} cores', 'own': f'{own:.1%} of one',
            'recorder': self._is_there('recorder/start'),
            'field_model': self._is_there('field_model/set_baseline'),
        }  # fmt: skip
        if view is None:
            return status
        tracker = self._statuses.get(f'{space}/tracker', LastStatus(1, 'no tracker', {}))
        good = sum(view.last_status(target.name).level == 0 for target in view.targets)
        rates = view.rate_hz[view.rate_hz > 0]
        rate_hz = sorted(rates)[len(rates) // 2] if len(rates) else 0.0
        is_slow = rate_hz < SLOW * view.setup.flux_rate_hz
        recorder, recording = self._statuses.get(f'{space}/recorder'), ''
        if recorder is not None and recorder.message == 'recording':
            name = recorder.values.get('bag', '').rpartition('/')[2]
            recording = f'{name} {float(recorder.values.get("duration_s", 0.0)):.0f} s'
        return status | {
            'tracked': f'{good} of {len(view.targets)} tracked',
            'level': max(tracker.level, int(is_slow or good < len(view.targets))),
            'rate': f'{rate_hz:.0f}',
            'latency': '–' if math.isnan(view.latency_s) else f'{1e3 * view.latency_s:.1f} ms',
            'why': view.reasons(),
            'nodes': self._nodes(),
            'findings': self._findings(),
            'recording': recording,
        }

    def _nodes(self) -> list[tuple[str, int, str]]:
        found = []
        for name, status in self._statuses.items():
            home, _, short = name.rpartition('/')
            if home == self.namespace and ':' not in name and name not in self._own:
                if self._is_silent(name):
                    status = LastStatus(3, 'silent', {})
                found.append((short, status.level, status.message))
        return sorted(found)

    def _findings(self) -> list[tuple[int, str]]:
        found = []
        for name in (f'{self.namespace}/grid', f'{self.namespace}/watcher'):
            if name in self._statuses and not self._is_silent(name):
                found.append((self._statuses[name].level, self._statuses[name].message))
                found += [
                    (status.level, f'{part.partition(": ")[2]}: {status.message}')
                    for part, status in self._statuses.items()
                    if part.startswith(f'{name}: ') and not self._is_silent(part)
                ]
        return found or [(1, 'no watcher runs')]


def _point(point: Any) -> list[Any]:
    """A point of the curves: time (s), errors (mm) and residuals (pT)."""
    time_s, error_m, residual_t, _ = point
    return [
        round(time_s, 3),
        [known(value, 4) for value in 1e3 * error_m],
        [known(value, 2) for value in 1e12 * residual_t],
    ]


def _balls(message: MarkerArray) -> list[list[float]]:
    balls = []
    for marker in message.markers:
        radius = 0.5 * marker.scale.x
        if marker.action == Marker.ADD and marker.type == Marker.SPHERE_LIST:
            balls += [[p.x, p.y, p.z, radius] for p in marker.points]
    return [[round(value, 4) for value in ball] for ball in balls[:MOST_METAL]]
