"""Serves the page: uvicorn in a thread of its own, behind the guard."""

import contextlib
import secrets
import socket
import threading
from pathlib import Path

import uvicorn
from fastapi import FastAPI, HTTPException
from fastapi.responses import FileResponse
from nicegui import ui

from anser_ros.errors import ParameterError
from anser_ros.web.folder import RecordingFolder
from anser_ros.web.guard import Guard, is_local

EVERYWHERE = ('0.0.0.0', '::')
"""Addresses that stand for all networks of a machine."""
LEAST_TOKEN = 16
"""Characters of a token: a hundred bits where they are drawn by chance."""
MOST_BYTES = 262_144
"""Largest message that a page may send, bytes: a click is a few hundred."""
MOST_CONNECTIONS = 64
"""Connections at a time, those of a page's files among them."""
PATIENCE_S = 20.0
"""Time that a page may be silent, s, before it is taken for gone; it is reloaded when it comes
back. Shorter, and a browser that is busy drawing loses its page."""
END_S = 2.0
"""Time that open connections have at the end, s: a page that hangs must not hold the node."""
SANDBOX = "sandbox; default-src 'none'; img-src data:; style-src 'unsafe-inline'"
"""What a report may do: show its own pictures."""


def token_for(host: str, token_file: str) -> str:
    """Return the token that pages need: none on this machine alone, else the file's or a new one.

    Raises `ParameterError` when the file holds none, or a short one.
    """
    if not token_file:
        return '' if is_local(host) else secrets.token_urlsafe(LEAST_TOKEN)
    try:
        token = Path(token_file).expanduser().read_text(encoding='utf-8').strip()
    except (OSError, UnicodeDecodeError) as error:
        raise ParameterError(f'token_file {token_file}: {error}') from error
    if len(token) < LEAST_TOKEN or not token.isascii() or not token.isprintable():
        raise ParameterError(f'token_file {token_file}: needs at least {LEAST_TOKEN} characters')
    return token


class PageServer:
    """Serves the pages that are registered with NiceGUI, and the results of the folder.

    Port 0 stands for any that is free, an empty token for none. Raises `ParameterError` when the
    address can't be used.
    """

    def __init__(self, host: str, port: int, token: str, folder: RecordingFolder) -> None:
        self._host, self._token = host, token
        try:
            family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
            self._socket = socket.socket(family, socket.SOCK_STREAM)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._socket.bind((host, port))
            self._socket.listen()  # who comes before the server is up waits for it
        except OSError as error:
            if hasattr(self, '_socket'):
                self._socket.close()
            raise ParameterError(f'{host}:{port}: {error.strerror or error}') from error
        self.port = self._socket.getsockname()[1]
        inner = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)

        @inner.get('/results/{result}/{name}')
        def _result(result: str, name: str) -> FileResponse:
            path = folder.shown(result, name)
            if path is None:
                raise HTTPException(404)
            return FileResponse(path, headers={'Content-Security-Policy': SANDBOX})

        ui.run_with(
            inner, title='anser_ros', tailwind=False, message_history_length=0,
            binding_refresh_interval=None, show_welcome_message=False,
            reconnect_timeout=PATIENCE_S,
        )  # fmt: skip
        self.guard = Guard(inner, token)
        config = uvicorn.Config(
            self.guard, log_level='warning', access_log=False, ws_max_size=MOST_BYTES,
            limit_concurrency=MOST_CONNECTIONS, timeout_graceful_shutdown=int(END_S),
            ws='websockets-sansio',
        )  # fmt: skip
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(
            target=self._server.run, kwargs={'sockets': [self._socket]}, name='page', daemon=True
        )

    @property
    def url(self) -> str:
        """Return the address for a browser, the token included."""
        # A browser elsewhere needs this machine's name, not the address for all of its networks.
        host = socket.gethostname() if self._host in EVERYWHERE else self._host
        host = f'[{host}]' if ':' in host else host
        return f'http://{host}:{self.port}/' + (f'?token={self._token}' if self._token else '')

    def start(self) -> None:
        """Begin to serve pages to browsers."""
        self._thread.start()

    def end(self) -> None:
        """End it, and the connections with it."""
        self._server.should_exit = True
        if self._thread.is_alive():
            self._thread.join(2 * END_S)
        with contextlib.suppress(OSError):
            self._socket.close()
