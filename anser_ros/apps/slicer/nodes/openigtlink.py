"""Serves every pose, and the state of what has none, to 3D Slicer as OpenIGTLink.

Every TCP client is served the same messages by a thread of its own (`IgtlServer`), and what it
asks is answered.
"""

import contextlib
import math
import select
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from std_msgs.msg import String

from anser_ros.apps.slicer import igtl
from anser_ros.apps.slicer.extension import OPENIGTLINK
from anser_ros.errors import AnserError, ParameterError, PortError
from anser_ros.nodes.runtime import qos
from anser_ros.nodes.runtime.node import AnserNode, Level, Status
from anser_ros.nodes.runtime.parameters import STALE_AFTER_S, parameter
from anser_ros.nodes.runtime.process import main
from anser_ros.pose_states import OK, STALE
from anser_ros.stamps import NANO, stamp_of
from anser_ros.wire.recorded import pose_numbers
from anser_ros.wire.setup import Setup, parse_setup, topic_of
from anser_ros.wire.setup_values import tip_name

# A client that takes nothing for so long is dropped.
SEND_TIMEOUT_S = 2.0
POLL_S = 0.1
"""How often threads look whether the server was closed, s."""
QUEUE_LENGTH = 256
"""Messages that may wait for a slow client, a second's of ten sensors; then the oldest is
dropped."""
MOST_CLIENTS = 16
"""Clients that are served at once, each by a thread; more are closed as they come."""
READ_BYTES = 1 << 14
"""Bytes that are read of a client at a time."""
KEEP_ALIVE = {'TCP_KEEPIDLE': 10, 'TCP_KEEPINTVL': 5, 'TCP_KEEPCNT': 3}
"""A machine that is switched off is forgotten in half a minute."""
LONGEST_ASKED = 1024
"""Bytes of the longest request that is not skipped; what clients may ask has 60."""

Answer = Callable[[igtl.Header], bytes]
"""Gives the reply to a request of a client."""
ASKED = ('GET_CAPABIL', 'GET_STATUS', 'STT_TDATA', 'STP_TDATA')
"""Requests that are answered; all else is thrown away."""


class _Requests:
    """Finds requests in what a client sends; after bytes that are no message it ignores all."""

    def __init__(self) -> None:
        self._bytes, self._skip, self._is_broken = b'', 0, False

    def feed(self, data: bytes) -> Iterator[tuple[igtl.Header, bytes]]:
        self._bytes += data
        while not self._is_broken:
            skipped = min(self._skip, len(self._bytes))
            self._bytes, self._skip = self._bytes[skipped:], self._skip - skipped
            if self._skip or len(self._bytes) < igtl.HEADER_BYTES:
                return
            header = igtl.read_header(self._bytes)
            if header is None:
                self._is_broken = True
                break
            end = igtl.HEADER_BYTES + header.body_bytes
            if header.kind not in ASKED or header.body_bytes > LONGEST_ASKED:
                self._skip = end
                continue
            if len(self._bytes) < end:
                return
            body, self._bytes = self._bytes[igtl.HEADER_BYTES : end], self._bytes[end:]
            yield header, body
        self._bytes = b''


class _Client:
    """One connection with its queue and its thread."""

    def __init__(self, connection: socket.socket, answer: Answer) -> None:
        self._connection = connection
        self._answer = answer
        self._requests = _Requests()
        self.version = 1
        # Time between two TDATA, s, and when the next is due: never, where none are wanted.
        self.tracking_s, self.due_s = 0.0, math.inf
        self._queue: deque[bytes] = deque(maxlen=QUEUE_LENGTH)
        self._filled = threading.Condition()
        self._ending = False
        self.dropped = 0
        self.thread = threading.Thread(target=self._serve, name='igtl client', daemon=True)
        self.thread.start()

    def put(self, data: bytes) -> None:
        with self._filled:
            self.dropped += len(self._queue) == QUEUE_LENGTH  # the oldest makes room
            self._queue.append(data)
            self._filled.notify()

    def end(self) -> None:
        with self._filled:
            self._ending = True
            self._filled.notify()
        self.thread.join(2 * SEND_TIMEOUT_S)

    def _serve(self) -> None:
        with self._connection, contextlib.suppress(OSError):
            self._connection.settimeout(SEND_TIMEOUT_S)
            while not self._has_left():
                with self._filled:
                    if not self._queue and not self._ending:
                        self._filled.wait(POLL_S)
                    if self._ending:
                        return
                    waiting = b''.join(self._queue)
                    self._queue.clear()
                self._connection.sendall(waiting)

    def _has_left(self) -> bool:
        """Read some of what the client says, and answer what it asks."""
        if not select.select([self._connection], [], [], 0.0)[0]:
            return False
        data = self._connection.recv(READ_BYTES)
        for header, body in self._requests.feed(data):
            self.version = max(self.version, header.version)
            if header.kind == 'STT_TDATA':
                self.tracking_s, self.due_s = igtl.resolution_s(header, body), 0.0
            elif header.kind == 'STP_TDATA':
                self.due_s = math.inf
            self.put(self._answer(header))
        return not data


class IgtlServer:
    """Listens on one address and sends to all who connect.

    ``answer`` is called by the threads of clients; ``refused`` counts connections beyond
    `MOST_CLIENTS`. Port 0 stands for a free one. Raises `PortError`: the address can't be listened
    on.
    """

    def __init__(self, host: str, port: int, answer: Answer) -> None:
        self._answer = answer
        try:
            self._listener = socket.create_server((host, port))
        except OSError as error:
            raise PortError(f'cannot listen on {host}:{port}: {error.strerror}') from error
        self.port: int = self._listener.getsockname()[1]
        self._listener.settimeout(POLL_S)
        self._connections: list[_Client] = []
        self._lock = threading.Lock()
        self._ending = threading.Event()
        self._dropped_before = 0
        self.refused = 0
        self._thread = threading.Thread(target=self._accept, name='igtl server', daemon=True)
        self._thread.start()

    @property
    def n_clients(self) -> int:
        self._forget_the_gone()
        return len(self._connections)

    @property
    def dropped(self) -> int:
        """Return how many messages slow clients have missed."""
        with self._lock:
            return self._dropped_before + sum(client.dropped for client in self._connections)

    def send(self, data: bytes, newer: bytes = b'') -> None:
        """Queue a packed message for every client, ``newer`` instead for those that have asked in
        a header of version 2; never blocks.
        """
        with self._lock:
            for client in self._connections:
                client.put(newer if newer and client.version > 1 else data)

    def send_tracking(self, tracking: Callable[[], bytes], now_s: float) -> None:
        """Queue a TDATA for the clients that want one by now; none is made for nobody."""
        with self._lock:
            due = [client for client in self._connections if now_s >= client.due_s]
            data = tracking() if due else b''
            for client in due:
                client.due_s = now_s + client.tracking_s
                client.put(data)

    def close(self) -> None:
        self._ending.set()
        self._thread.join()
        self._listener.close()
        with self._lock:
            for client in self._connections:
                client.end()
            self._connections.clear()

    def _accept(self) -> None:
        while not self._ending.is_set():
            try:
                connection, _ = self._listener.accept()
            except TimeoutError:
                continue
            except OSError:  # the client was gone before it was accepted
                continue
            self._forget_the_gone()
            if len(self._connections) >= MOST_CLIENTS:
                self.refused += 1
                connection.close()
                continue
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # send at once
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            for name, value in KEEP_ALIVE.items():
                if hasattr(socket, name):
                    connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
            with self._lock:
                self._connections.append(_Client(connection, self._answer))

    def _forget_the_gone(self) -> None:
        with self._lock:
            for client in [one for one in self._connections if not one.thread.is_alive()]:
                self._dropped_before += client.dropped
                self._connections.remove(client)


WATCH_PERIOD_S = 0.05
"""How often sensors are looked at that have fallen silent, s."""


@dataclass(frozen=True)
class OpenIGTLinkParameters:
    host: str = parameter('127.0.0.1', 'address to listen on; 0.0.0.0 lets other machines in')
    port: int = parameter(OPENIGTLINK, 'TCP port, 0 for a free one', within=(0, 65535))
    stale_after_s: float = parameter(
        STALE_AFTER_S,
        'time without a pose after which a sensor is reported, s',
        within=(0.02, math.inf),
        live=True,
    )
    version: int = parameter(
        1,
        'version of the headers for a client that has sent nothing; 2 has TransformStatus, and '
        'is read by OpenIGTLink 3 only; a client that sends version 2 gets version 2',
        within=(1, 2),
    )
    body_name: str = parameter(
        '{body}', "name of a body's device, 20 characters; e.g. {body}ToTracker"
    )
    coil_name: str = parameter(
        '{name}', "name of a coil's device: of {name} and its {body} and {sensor}"
    )
    coils: bool = parameter(True, 'whether single coils are sent too, whose roll is arbitrary')


class OpenIGTLink(AnserNode):
    """Sends each pose as TRANSFORM (mm, frame of the board), each change of state as STATUS.

    The device is made of the sensor's or the body's name of the setup document by a template; for
    clients that know no STATUS, the state is also a STRING of that device with ``/state``.
    """

    NAME = 'openigtlink'
    # ROS reads a value as YAML, where a brace begins a mapping: inner quotes make it a text.
    EXAMPLE = """--ros-args -p host:=0.0.0.0 -p body_name:="'{body}ToTracker'\""""
    PARAMETERS = OpenIGTLinkParameters

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._devices: dict[str, str] = {}
        self._tracked: dict[str, igtl.Tracked] = {}
        self._refused = ''
        # Stamps are those of the poses, so what is said between them is on their clock.
        self._ahead_s: float | None = None
        check_templates(self.parameters)
        self._pose_subscriptions: dict[str, Any] = {}
        self._states: dict[str, str] = {}
        self._last_pose_s: dict[str, float] = {}
        self._n_clients = 0
        self._server = IgtlServer(self.parameters.host, self.parameters.port, self._answer)
        self.get_logger().info(f'listening on {self.parameters.host}:{self._server.port}')
        self.create_subscription(String, 'setup', self._on_setup, qos.LATCHED)
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, qos.EVENTS)
        self.create_timer(WATCH_PERIOD_S, self._watch, clock=self.steady_clock)

    def status(self) -> Status:
        values = {
            'address': f'{self.parameters.host}:{self._server.port}',
            'clients': self._server.n_clients,
            'clients_refused': self._server.refused,
            'messages_dropped': self._server.dropped,
            'sensors_ok': sum(state == OK for state in self._states.values()),
        }
        if not self._states:
            level = Level.ERROR if self._refused else Level.WARN
            return Status('', level, self._refused or 'no setup yet', values)
        return Status('', Level.OK, 'serving', values)

    def close(self) -> None:
        self._server.close()

    def _on_setup(self, message: String) -> None:
        try:
            named = named_in(parse_setup(message.data), self.parameters)
            self._devices, self._refused = igtl.device_names(named), ''
            for name, device in self._devices.items():
                if device != named[name]:
                    self.warn(f'{name}_cut', f'{name}: {named[name]!r} is cut to {device!r}')
        except AnserError as error:
            self._devices, self._refused = {}, str(error)
            self.warn('setups_refused', str(error))
        for name in set(self._pose_subscriptions) - set(self._devices):
            self.destroy_subscription(self._pose_subscriptions.pop(name))
            for known in (self._states, self._last_pose_s, self._tracked):
                known.pop(name, None)  # type: ignore[attr-defined]
        for name in self._devices:
            if name not in self._pose_subscriptions:
                self._set_state(name, 'no pose yet')
                self._pose_subscriptions[name] = self.create_subscription(
                    PoseStamped, f'{topic_of(name)}/pose', partial(self._on_pose, name), qos.OTHERS
                )

    def _on_pose(self, name: str, message: PoseStamped) -> None:
        numbers = pose_numbers(message.pose)
        position, quaternion = numbers[:3], numbers[3:]
        if not all(map(math.isfinite, numbers)) or not any(quaternion):
            self.warn('poses_refused', f'{name}: an invalid pose')
            return
        now_s = self._last_pose_s[name] = time.monotonic()
        stamp_s = stamp_of(message) * NANO
        self._ahead_s = stamp_s - now_s
        self._set_state(name, OK)
        if self._n_clients:
            device = self._devices[name]
            pose = (device, stamp_s, position, quaternion)
            newer = igtl.transform(*pose, version=2)
            older = newer if self.parameters.version > 1 else igtl.transform(*pose, version=1)
            self._server.send(older, newer)
            self.count('transforms')
            self._tracked[name] = igtl.Tracked(device, position, quaternion)
            self._server.send_tracking(partial(self._tracking, stamp_s), now_s)

    def _tracking(self, stamp_s: float) -> bytes:
        """What is tracked just now, for the clients that have asked for it."""
        good = [one for name, one in self._tracked.items() if self._states[name] == OK]
        return igtl.tracking(stamp_s, good)

    def _now_s(self) -> float:
        """The time on the clock of the poses, those of a bag included."""
        if self._ahead_s is None:
            return 1e-9 * self.get_clock().now().nanoseconds
        return time.monotonic() + self._ahead_s

    def _answer(self, header: igtl.Header) -> bytes:
        """The reply to what a client asks; runs on the client's thread."""
        if header.kind == 'GET_CAPABIL':
            return igtl.capability(self._now_s())
        if header.kind == 'GET_STATUS':
            status = self.status()
            code = igtl.OK if status.level == Level.OK else igtl.NOT_READY
            return igtl.status('', self._now_s(), code, status.level.name, status.message)
        return igtl.tracking_reply(self._now_s())

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        """Take the tracker's reasons for sensors that have no pose just now."""
        for status in message.status:
            node, _, part = status.name.partition(': ')
            if node.endswith('/tracker') and part in self._states and self._is_silent(part):
                self._set_state(part, status.message if status.message != OK else STALE)

    def _is_silent(self, name: str) -> bool:
        last_s = self._last_pose_s.get(name, -math.inf)
        return bool(time.monotonic() - last_s > self.parameters.stale_after_s)

    def _watch(self) -> None:
        for name, state in self._states.items():
            if state == OK and self._is_silent(name):
                self._set_state(name, STALE)
        before, self._n_clients = self._n_clients, self._server.n_clients
        if self._n_clients > before:  # whoever is new must know what has no pose
            for name, state in self._states.items():
                self._send_state(name, state)

    def _set_state(self, name: str, state: str) -> None:
        if self._states.get(name) != state:
            self._states[name] = state
            self._send_state(name, state)

    def _send_state(self, name: str, state: str) -> None:
        if self._n_clients:
            device, now_s = self._devices[name], self._now_s()
            code = igtl.OK if state == OK else igtl.NOT_READY
            self._server.send(igtl.status(device, now_s, code, state.split(':')[0], state))
            self._server.send(igtl.string(igtl.state_device(device), now_s, state))
            self.count('states')


def check_templates(table: OpenIGTLinkParameters) -> None:
    """Raise `ParameterError` where a template asks for what is not there."""
    for name, known in (('body_name', ('body',)), ('coil_name', ('name', 'body', 'sensor'))):
        try:
            getattr(table, name).format(**dict.fromkeys(known, ''))
        except (KeyError, IndexError, ValueError) as error:
            words = ', '.join(f'{{{word}}}' for word in known)
            raise ParameterError(
                f'{name} may have {words}, got {getattr(table, name)!r}'
            ) from error


def named_in(setup: Setup, table: OpenIGTLinkParameters) -> dict[str, str]:
    """Return what each body, its tip and, where they are wanted, each coil is to be called."""
    named = {}
    for coil in setup.tool_sensors if table.coils else ():
        own = coil.name.removeprefix(f'{coil.body}/')
        named[coil.name] = table.coil_name.format(name=coil.name, body=coil.body, sensor=own)
    bodies = (*setup.bodies, *map(tip_name, setup.tips))
    named |= {body: table.body_name.format(body=body) for body in bodies}
    return named


if __name__ == '__main__':
    sys.exit(main(OpenIGTLink))
