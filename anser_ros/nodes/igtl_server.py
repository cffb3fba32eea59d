"""A TCP server that sends every client the same OpenIGTLink messages.

Messages are packed by pyigtl. Its own server is not used: it takes the process's signals, serves
one client, and does not notice one that has left.
"""

import contextlib
import select
import socket
import threading
from collections import deque
from collections.abc import Sequence

import numpy as np
import pyigtl
from scipy.spatial.transform import Rotation

from anser_ros.errors import PortError

# A client that takes nothing for so long is dropped.
SEND_TIMEOUT_S = 2.0
POLL_S = 0.1
"""How often threads look whether the server was closed, s."""
QUEUE_LENGTH = 256
"""Messages that may wait for a slow client; then the oldest is dropped. A second's or so, for ten
sensors at 25 Hz: older poses are of no use to it."""
MOST_CLIENTS = 16
"""Clients that are served at once; each has a thread and a queue. A room has a few screens; more
connections than this are a mistake or an attack, and are closed as they come."""
HEARD_BYTES = 1 << 14
"""Bytes that are read of a client at a time, and thrown away, since nothing is asked of clients. A
client that sends without end is slowed down by the system, and takes no time from the others."""
IDLE_S, PROBE_S, PROBES = 10, 5, 3
"""Time, s, after which a silent connection is probed, time between probes, and how many go
unanswered before it counts as gone: a machine that is switched off is forgotten in half a
minute."""
DEVICE_NAME_LENGTH = 20
"""Bytes that the header of an OpenIGTLink message has for the device's name."""
MM_PER_M = 1e3
"""OpenIGTLink has millimetres."""


def device_name(name: str, ending: str = '') -> str:
    """Return a name that fits the protocol's 20 characters; a longer one loses its beginning."""
    return (name + ending)[-DEVICE_NAME_LENGTH:]


def transform_bytes(
    name: str, stamp_s: float, position_m: Sequence[float], quaternion_xyzw: Sequence[float]
) -> bytes:
    """Pack a TRANSFORM message; OpenIGTLink and 3D Slicer work in millimetres."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(quaternion_xyzw).as_matrix()
    matrix[:3, 3] = MM_PER_M * np.asarray(position_m)
    message = pyigtl.TransformMessage(matrix, timestamp=stamp_s, device_name=device_name(name))
    packed: bytes = message.pack()
    return packed


def state_bytes(name: str, stamp_s: float, state: str) -> bytes:
    """Pack a STRING message with the state of a sensor that has no pose."""
    text = state.encode('ascii', 'replace').decode()
    message = pyigtl.StringMessage(
        text, timestamp=stamp_s, device_name=device_name(name, '/state')
    )
    packed: bytes = message.pack()
    return packed


class _Client:
    """One connection with its queue and its thread."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._queue: deque[bytes] = deque(maxlen=QUEUE_LENGTH)
        self._filled = threading.Condition()
        self._ending = False
        self.dropped = 0
        self._thread = threading.Thread(target=self._serve, name='igtl client', daemon=True)
        self._thread.start()

    @property
    def is_connected(self) -> bool:
        return self._thread.is_alive()

    def put(self, data: bytes) -> None:
        with self._filled:
            self.dropped += len(self._queue) == QUEUE_LENGTH  # the oldest makes room
            self._queue.append(data)
            self._filled.notify()

    def end(self) -> None:
        with self._filled:
            self._ending = True
            self._filled.notify()
        self._thread.join(2 * SEND_TIMEOUT_S)

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
        """Read some of what the client says, all of which is ignored."""
        if select.select([self._connection], [], [], 0.0)[0]:
            return not self._connection.recv(HEARD_BYTES)
        return False


def _set_options(connection: socket.socket) -> None:
    """Send at once, and find out when the other end is no longer there."""
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in (
        ('TCP_KEEPIDLE', IDLE_S), ('TCP_KEEPINTVL', PROBE_S), ('TCP_KEEPCNT', PROBES),
    ):  # fmt: skip
        if hasattr(socket, name):
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


class IgtlServer:
    """Listens on one address and sends to all who connect.

    Parameters
    ----------
    host : str
        Address to listen on.
    port : int
        TCP port; 0 for a free one.

    Attributes
    ----------
    refused : int
        Connections closed because there were `MOST_CLIENTS` already.

    Raises
    ------
    PortError
        The address can't be listened on.
    """

    def __init__(self, host: str, port: int) -> None:
        try:
            self._listener = socket.create_server((host, port))
        except OSError as error:
            raise PortError(f'can not listen on {host}:{port}: {error.strerror}') from error
        self.port: int = self._listener.getsockname()[1]
        self._listener.settimeout(POLL_S)
        self._clients: list[_Client] = []
        self._lock = threading.Lock()
        self._ending = threading.Event()
        self._dropped_before = 0
        self.refused = 0
        self._thread = threading.Thread(target=self._accept, name='igtl server', daemon=True)
        self._thread.start()

    @property
    def n_clients(self) -> int:
        """Number of connected clients."""
        self._forget_the_gone()
        return len(self._clients)

    @property
    def dropped(self) -> int:
        """Messages that slow clients have missed."""
        with self._lock:
            return self._dropped_before + sum(client.dropped for client in self._clients)

    def send(self, data: bytes) -> None:
        """Queue a packed message for every client; never blocks."""
        with self._lock:
            for client in self._clients:
                client.put(data)

    def close(self) -> None:
        """End the connections of all clients."""
        self._ending.set()
        self._thread.join()
        self._listener.close()
        with self._lock:
            for client in self._clients:
                client.end()
            self._clients.clear()

    def _accept(self) -> None:
        while not self._ending.is_set():
            try:
                connection, _ = self._listener.accept()
            except TimeoutError:
                continue
            except OSError:  # the client was gone before it was accepted
                continue
            self._forget_the_gone()
            if len(self._clients) >= MOST_CLIENTS:
                self.refused += 1
                connection.close()
                continue
            _set_options(connection)
            with self._lock:
                self._clients.append(_Client(connection))

    def _forget_the_gone(self) -> None:
        with self._lock:
            gone = [client for client in self._clients if not client.is_connected]
            self._dropped_before += sum(client.dropped for client in gone)
            self._clients = [client for client in self._clients if client.is_connected]
