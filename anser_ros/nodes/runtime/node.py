"""Gives every node its base: parameters, diagnostics, guarded callbacks, start and end.

Callbacks given to ``create_subscription``, ``create_timer`` and ``create_service`` are guarded:
an error is logged, counted and shown in ``/diagnostics``, and the node lives on.
"""

import argparse
import copy
import functools
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String

from anser_ros.errors import AnserError, LayoutError, ParameterError
from anser_ros.nodes.runtime import parameters, qos
from anser_ros.nodes.runtime.diagnostics import Level, Status, Throttle, Trouble, diagnostic_array
from anser_ros.wire.cdr import read_cloud

MOST_BYTES = {String: 1_000_000, DiagnosticArray: 1_000_000, PointCloud2: 16_000_000}
"""Largest message of a type, bytes: a setup of a thousand sensors has 0.2 MB, the uncertainty of a
model of 4000 dipoles 6 MB."""


def opened(data: bytes, message_type: type) -> Any:
    """Return the message that serialised bytes hold, a cloud as a `PointCloud`.

    Raises `LayoutError` when there are more bytes, points or fields than a sensible message has.
    """
    most = MOST_BYTES[message_type]
    if len(data) > most:
        raise LayoutError(f'a message of {len(data)} bytes is refused, the most is {most}')
    if message_type is PointCloud2:
        return read_cloud(data)
    return deserialize_message(data, message_type)


Callback = Callable[..., Any]

NAMESPACE = 'anser'
DIAGNOSTICS_PERIOD_S = 1.0
"""Time between two messages in /diagnostics, s, as other ROS nodes have it."""
WARNING_PERIOD_S = 10.0
"""Least time between two warnings of one kind in the log, s."""
OVERRIDES_S = 10.0
"""Time, s, after which a node has the topics that parameters may override."""
LONGEST_TURN_S = 0.05
"""Time, s, that a timer waits while another thread works in its node, before it is left out until
the next time: other nodes of the process wait meanwhile."""
GIVEN = 'tool/flux', 'reference/flux', 'field_model', 'field_model_error'
"""Topics that nodes of one process pass on as objects: these are published for others only, as who
subscribed would process everything twice."""
LONGEST_END_S = 0.2
"""Time, s, that the end of a process waits for what its nodes work on aside: longer than a frame
takes, less than the start of a refit."""


@dataclass(frozen=True)
class NoParameters:
    """Stands for the table of a node without parameters."""


class AnserNode(Node):
    """Gives all nodes their parameters, diagnostics and guarded callbacks.

    ``beside`` are all nodes of a process of several: values that are given to all of them may be
    meant for one. ``parameters`` is a frozen instance of ``PARAMETERS``; an allowed change swaps
    it. ``counters`` are shown in ``/diagnostics``. The process ends with ``exit_code`` once that
    is not None.
    """

    NAME: ClassVar[str]
    EXAMPLE: ClassVar[str] = ''
    """What may stand behind the name on a command line, for its help."""
    PARAMETERS: ClassVar[type] = NoParameters
    HAS_KERNELS: ClassVar[bool] = False
    """Whether the node calculates with compiled kernels, and waits until all are there."""
    PAUSE_S: ClassVar[float] = 0.0
    """Time, s, in which messages gather before they are looked at, where nobody waits for it."""

    def __init__(self, beside: Sequence[type['AnserNode']] = (), **options: Any) -> None:
        # The base class already creates services, so what guards them must be there first.
        self._beside = tuple(beside)
        self._turn = threading.RLock()
        self.counters: Counter[str] = Counter()
        self.exit_code: int | None = None
        self._throttle, self._trouble = Throttle(WARNING_PERIOD_S), Trouble()
        self._fault: str | None = None
        self._faults_reported = 0
        self._has_checked = False
        self.started_s = time.monotonic()
        self.streams: Node = self
        options.setdefault('namespace', NAMESPACE)
        super().__init__(self.NAME, **options)
        self.parameters = self._declare_table()
        self.add_on_set_parameters_callback(self._on_set_parameters)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', qos.EVENTS)
        self.steady_clock = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(DIAGNOSTICS_PERIOD_S, self.publish_diagnostics, clock=self.steady_clock)
        if self.HAS_KERNELS:
            # Numba is half of the start of a node that has none.
            from anser_ros.kernel_cache import compile_kernels

            try:
                compile_kernels(self._say_starting, interval_s=DIAGNOSTICS_PERIOD_S)
            except ParameterError as error:
                self.warn('kernels_not_compiled', str(error))

    # What a node may override -------------------------------------------------------------

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        """Add the node's own command line; each argument goes to ``__init__`` by name."""

    def status(self) -> Status:
        """Return the state of the node itself."""
        return Status('', Level.OK, 'running')

    def part_statuses(self) -> Sequence[Status]:
        """Return the states of what the node looks after: sensors, emitters, a port."""
        return ()

    def on_parameters(self, old: Any, new: Any) -> None:
        """Act on changed parameters; ``self.parameters`` already holds the new ones."""

    def close(self) -> None:
        """Release what the node holds; called once at the end, signals already ignored."""

    def on_abandon(self) -> None:
        """Inform devices that it is over where the process is given up; in a thread of its own."""

    # What a node uses ---------------------------------------------------------------------

    def given(self, callback: Callback, longest_s: float = -1.0) -> Callback:
        """Return a callback as another thread of the process may call it: guarded, in turn, and
        left out where that would take longer.
        """
        return self._guard(self._in_turn(callback, longest_s))

    def count(self, name: str, by: int = 1) -> None:
        """Count an event for ``/diagnostics``."""
        self.counters[name] += by

    def warn(self, kind: str, text: str) -> None:
        """Count an event and log it: the first of a kind whole, then one in ten seconds."""
        self.counters[kind] += 1
        admitted = self._throttle.admit(kind, text, time.monotonic())
        if admitted is not None:
            self.get_logger().warning(admitted)

    def refuse(self, counter: str, error: AnserError) -> None:
        """Count and log an input that is refused; why is the node's latest trouble."""
        self._trouble.say(str(error), time.monotonic())
        self.warn(counter, str(error))

    def stop(self, code: int = 0) -> None:
        """End the process after the running callback."""
        self.exit_code = code

    def publish_diagnostics(self) -> None:
        """Publish all statuses now."""
        self._check_overrides()
        self._send_statuses(self._status_with_counters(), *self.part_statuses())

    def publish_end(self) -> None:
        """Publish that the node has ended, so that its last state is not taken for a live one."""
        last = replace(self._status_with_counters(), level=Level.STALE, message='ended')
        self._send_statuses(last)

    def _say_starting(self, text: str) -> None:
        """State what the start waits for, in the log once and in ``/diagnostics``."""
        if self._throttle.admit('start', text, time.monotonic()) is not None:
            self.get_logger().info(text)
        self._send_statuses(Status('', Level.WARN, text))

    def _status_with_counters(self) -> Status:
        own, uptime_s = self.status(), time.monotonic() - self.started_s
        own = replace(own, values={**own.values, **self.counters, 'uptime_s': uptime_s})
        if self.counters['callback_faults'] == self._faults_reported:
            return own
        self._faults_reported = self.counters['callback_faults']
        return replace(own, level=Level.ERROR, message=f'callback failed: {self._fault}')

    def _send_statuses(self, *statuses: Status) -> None:
        name = self.get_fully_qualified_name().strip('/')
        stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(diagnostic_array(name, statuses, stamp))

    # Guarded callbacks --------------------------------------------------------------------

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callback, qos_profile: Any, **options: Any
    ) -> Any:
        """Subscribe as rclpy does, with the callback guarded, and what is too large refused.

        Return None for what nodes of this process give each other as objects.
        """
        if self._beside and topic in GIVEN:
            return None
        bounded = msg_type in MOST_BYTES and not options.get('raw', False)

        @functools.wraps(callback)
        def unpacked(*args: Any) -> Any:
            # The events executor gives message and its information as one pair.
            message, *info = args[0] if isinstance(args[0], tuple) else args
            return callback(opened(message, msg_type) if bounded else message, *info)

        if bounded:
            options['raw'] = True
        guarded = self._guard(self._in_turn(unpacked))
        profile, own = self.overridable(qos_profile)
        return super().create_subscription(msg_type, topic, guarded, profile, **own, **options)

    def create_publisher(self, msg_type: Any, topic: str, qos_profile: Any, **options: Any) -> Any:
        """Publish as rclpy does; parameters ``qos_overrides`` are honoured."""
        profile, own = self.overridable(qos_profile)
        return super().create_publisher(msg_type, topic, profile, **own, **options)

    @property
    def qos_overrides(self) -> list[Parameter]:
        """Return the parameters that override a quality of service."""
        given = self._parameter_overrides.items()
        return [value for name, value in given if name.startswith(parameters.QOS)]

    def overridable(self, profile: Any) -> tuple[Any, dict[str, Any]]:
        """Return a profile of a topic's own, and what lets parameters change it."""
        if not self.qos_overrides:
            return profile, {}
        return copy.copy(profile), {
            'qos_overriding_options': QoSOverridingOptions(qos.OVERRIDABLE)
        }

    def _check_overrides(self) -> None:
        """State once, some time after the start, which overrides are of topics of no use here."""
        if time.monotonic() - self.started_s < OVERRIDES_S or self._has_checked:
            return
        self._has_checked = True
        for one in self.qos_overrides:
            if not (self.has_parameter(one.name) or self.streams.has_parameter(one.name)):
                self.get_logger().info(f'{one.name}: this node has no such topic so far')

    def create_timer(
        self, timer_period_sec: float, callback: Callback, *args: Any, **options: Any
    ) -> Any:
        """Make a timer as rclpy does, with the callback guarded."""
        guarded = self._guard(self._in_turn(callback, LONGEST_TURN_S))
        return super().create_timer(timer_period_sec, guarded, *args, **options)

    def create_service(
        self, srv_type: Any, srv_name: str, callback: Callback, **options: Any
    ) -> Any:
        """Serve as rclpy does; an error becomes ``success = False`` with its message."""
        guarded = self._guard(self._in_turn(callback), is_service=True)
        return super().create_service(srv_type, srv_name, guarded, **options)

    def stop_working(self) -> bool:
        """End what is worked on aside; False where that still goes on after a while."""
        return True

    def destroy_node(self) -> None:
        """Destroy the node as rclpy does; nothing is worked on aside for it afterwards."""
        self.stop_working()
        super().destroy_node()

    def _in_turn(self, callback: Callback, longest_s: float = -1.0) -> Callback:
        """A callback that waits for another one of this node in another thread.

        One that comes again does not hold up other nodes for long, and is left out.
        """

        @functools.wraps(callback)
        def in_turn(*args: Any) -> Any:
            if not self._turn.acquire(timeout=longest_s):
                return None
            try:
                return callback(*args)
            finally:
                self._turn.release()

        return in_turn

    def _guard(self, callback: Callback, is_service: bool = False) -> Callback:
        @functools.wraps(callback)
        def guarded(*args: Any) -> Any:
            reason = ''
            try:
                return callback(*args)
            except AnserError as error:
                reason = ' '.join(str(error).split())
                self.warn(f'refused_{type(error).__name__}', reason)
            except Exception as error:  # noqa: BLE001 - the node must outlive any callback
                if self.context.ok():
                    reason = f'{type(error).__name__}: {error}'
                    self._report_fault(reason)
            response: Any = args[1] if is_service else None
            if hasattr(response, 'success'):
                response.success, response.message = False, reason
            return response

        return guarded

    def _report_fault(self, reason: str) -> None:
        self._fault = reason
        self.counters['callback_faults'] += 1
        text = f'callback failed\n{traceback.format_exc()}'
        admitted = self._throttle.admit(f'fault {reason}', text, time.monotonic())
        if admitted is not None:
            self.get_logger().error(admitted)

    # Parameters ---------------------------------------------------------------------------

    def _declare_table(self) -> Any:
        table = self.PARAMETERS
        values: dict[str, Any] = {}
        # rclpy drops overrides that are not declared; a misspelt name must not pass silently.
        others = {name for node in self._beside for name in parameters.types(node.PARAMETERS)}
        given = [name for name in self._parameter_overrides if name not in others]
        unknown = [name for name in given if not parameters.is_known(table, name)]
        if unknown:
            parameters.build(table, dict.fromkeys(sorted(unknown)))
        for one in self.qos_overrides:
            qos.check_override(one.name, one.value)
        for name, rule in parameters.rules(table).items():
            default = getattr(table, name)
            ros_default = list(default) if isinstance(default, tuple) else default
            descriptor = ParameterDescriptor(
                description=rule.description,
                additional_constraints=', '.join(rule.choices),
                read_only=not rule.live,
                dynamic_typing=True,  # so that a whole number will do for a float
            )
            given = self.declare_parameter(name, ros_default, descriptor).value
            values[name] = default if given is None else given
        return parameters.build(table, values)

    def _on_set_parameters(self, changed: Sequence[Parameter]) -> SetParametersResult:
        own = {p.name: p.value for p in changed if not parameters.is_foreign(p.name)}
        old = self.parameters
        try:
            if own:
                new = parameters.build(self.PARAMETERS, {**vars(old), **own})
                with self._turn:
                    self.parameters = new
                    self.on_parameters(old, new)
        except AnserError as error:
            self.parameters = old
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)


__all__ = ['AnserNode', 'Level', 'Status']
