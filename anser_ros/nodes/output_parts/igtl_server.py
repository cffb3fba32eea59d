"""Serves every TCP client the same OpenIGTLink messages, and answers what it asks."""

import contextlib
import select
import socket
import threading
from collections import deque
from collections.abc import Callable

from anser_ros.errors import PortError
from anser_ros.wire import igtl

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
READ_BYTES = 1 << 14
"""Bytes that are read of a client at a time. A client that sends without end is slowed down by the
system, and takes no time from the others."""
IDLE_S, PROBE_S, PROBES = 10, 5, 3
"""Time, s, after which a silent connection is probed, time between probes, and how many go
unanswered before it counts as gone: a machine that is switched off is forgotten in half a
minute."""
LONGEST_ASKED = 1024
"""Bytes of the longest request that is read whole; what clients may ask has 60. Longer ones are
skipped."""

Answer = Callable[[igtl.Header], bytes]
"""Gives the reply to a request of a client."""
ASKED = ('GET_CAPABIL', 'GET_STATUS', 'STT_TDATA', 'STP_TDATA')
"""Requests that are answered; all else is thrown away."""


class _Requests:
    """Finds requests in what a client says; after bytes that are no message it hears no more."""

    def __init__(self) -> None:
        self._bytes = b''
        self._skip = 0
        self._deaf = False

    def feed(self, data: bytes) -> list[tuple[igtl.Header, bytes]]:
        found: list[tuple[igtl.Header, bytes]] = []
        if self._deaf:
            return found
        self._bytes += data
        while True:
            skipped = min(self._skip, len(self._bytes))
            self._bytes, self._skip = self._bytes[skipped:], self._skip - skipped
            if self._skip or len(self._bytes) < igtl.HEADER_BYTES:
                return found
            header = igtl.read_header(self._bytes)
            if header is None:
                self._deaf, self._bytes = True, b''
                return found
            end = igtl.HEADER_BYTES + header.body_bytes
            if header.kind not in ASKED or header.body_bytes > LONGEST_ASKED:
                self._skip = end
                continue
            if len(self._bytes) < end:
                return found
            found.append((header, self._bytes[igtl.HEADER_BYTES : end]))
            self._bytes = self._bytes[end:]


class _Client:
    """One connection with its queue and its thread."""

    def __init__(self, connection: socket.socket, answer: Answer) -> None:
        self._connection = connection
        self._answer = answer
        self._requests = _Requests()
        # Time between two TDATA, s, where they are wanted, and when the next is due.
        self._tracking_s: float | None = None
        self.version = 1
        self._due_s = 0.0
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

    def is_due(self, now_s: float) -> bool:
        """Return whether a TDATA message is due."""
        return self._tracking_s is not None and now_s >= self._due_s

    def put_tracking(self, data: bytes, now_s: float) -> None:
        self._due_s = now_s + (self._tracking_s or 0.0)
        self.put(data)

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
        """Read some of what the client says, and answer what it asks."""
        if not select.select([self._connection], [], [], 0.0)[0]:
            return False
        data = self._connection.recv(READ_BYTES)
        for header, body in self._requests.feed(data):
            self.version = max(self.version, header.version)
            if header.kind == 'STT_TDATA':
                self._tracking_s = igtl.resolution_s(header, body)
            elif header.kind == 'STP_TDATA':
                self._tracking_s = None
            self.put(self._answer(header))
        return not data


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

    ``answer`` is called by the threads of clients; ``refused`` counts connections that were closed
    because there were `MOST_CLIENTS` already. Port 0 stands for a free one. Raises `PortError`:
    the address can't be listened on.
    """

    def __init__(self, host: str, port: int, answer: Answer) -> None:
        self._answer = answer
        try:
            self._listener = socket.create_server((host, port))
        except OSError as error:
            raise PortError(f'cannot listen on {host}:{port}: {error.strerror}') from error
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
        """Return the number of connected clients."""
        self._forget_the_gone()
        return len(self._clients)

    @property
    def dropped(self) -> int:
        """Return how many messages slow clients have missed."""
        with self._lock:
            return self._dropped_before + sum(client.dropped for client in self._clients)

    def send(self, data: bytes, newer: bytes = b'') -> None:
        """Queue a packed message for every client; never blocks.

        ``newer`` goes instead to clients that have asked in a header of version 2.
        """
        with self._lock:
            for client in self._clients:
                client.put(newer if newer and client.version > 1 else data)

    def send_tracking(self, tracking: Callable[[], bytes], now_s: float) -> None:
        """Queue a TDATA for the clients that want one by now; none is made for nobody."""
        with self._lock:
            due = [client for client in self._clients if client.is_due(now_s)]
            data = tracking() if due else b''
            for client in due:
                client.put_tracking(data, now_s)

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
                self._clients.append(_Client(connection, self._answer))

    def _forget_the_gone(self) -> None:
        with self._lock:
            gone = [client for client in self._clients if not client.is_connected]
            self._dropped_before += sum(client.dropped for client in gone)
            self._clients = [client for client in self._clients if client.is_connected]
