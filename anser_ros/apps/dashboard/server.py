"""Serves the page: uvicorn in a thread of its own, behind a guard.

The guard decides who may look, only this machine or who knows the token, and how many at a time.
"""

import contextlib
import hmac
import secrets
import socket
import threading
from collections.abc import Awaitable, Callable, MutableMapping
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import uvicorn
from fastapi import FastAPI, HTTPException
from fastapi.requests import HTTPConnection
from fastapi.responses import FileResponse, PlainTextResponse, RedirectResponse
from nicegui import ui

from anser_ros.apps.dashboard.loop import RecordingFolder
from anser_ros.errors import ParameterError

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
Application = Callable[[Scope, Receive, Send], Awaitable[None]]

MOST_PAGES = 8
"""Pages that may be open at a time: each gets all poses, which takes a share of a processor."""
COOKIE = 'anser_token'
LOOPBACK = ('127.0.0.1', 'localhost', '::1')
"""Names of this machine for itself."""
POLICY = (1008, 'not allowed')
"""Code and reason of closing a web socket (RFC 6455) whose page may not be there."""
FULL = (1013, 'too many pages')
"""The same where as many pages are open as may be."""


class Guard:
    """Stands before another ASGI application, and refuses who may not come in.

    Without a token, only this machine can reach the address. Then names of other machines in a
    request are refused: a page from elsewhere, open in the same browser, could reach it by a name
    of its own that leads here. ``pages`` counts open connections.
    """

    def __init__(self, inner: Application, token: str) -> None:
        self._inner, self._token = inner, token
        self.pages = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope['type'] not in ('http', 'websocket'):
            await self._inner(scope, receive, send)
            return
        request = HTTPConnection(scope)
        given = request.query_params.get('token', '')
        refused = self._refusal(request, given)
        if refused:
            await _refuse(scope, receive, send, *refused)
        elif scope['type'] == 'websocket':
            self.pages += 1
            try:
                await self._inner(scope, receive, send)
            finally:
                self.pages -= 1
        elif given and self._token:
            # The browser keeps the token, and takes it out of the address line.
            answer = RedirectResponse(scope['path'], 303)
            answer.set_cookie(COOKIE, given, httponly=True, samesite='strict')
            await answer(scope, receive, send)
        else:
            await self._inner(scope, receive, send)

    def _refusal(self, request: HTTPConnection, given: str) -> tuple[int, str] | None:
        host, origin = request.headers.get('host', ''), request.headers.get('origin', '')
        if not self._token and urlsplit(f'//{host}').hostname not in LOOPBACK:
            return 403, 'The live view answers to localhost only.'
        if origin and urlsplit(origin).netloc != host:
            return 403, 'The request comes from another page.'
        token = given or request.cookies.get(COOKIE, '')
        if self._token and not hmac.compare_digest(token.encode(), self._token.encode()):
            return 401, 'Open the address with ?token=..., as the live view has printed it.'
        # A page that is connected can be counted; one that asks over and over can not.
        if request.query_params.get('transport') == 'polling':
            return 403, 'WebSockets are needed.'
        is_new = request.scope['type'] == 'websocket' or request.scope['path'] == '/'
        if is_new and self.pages >= MOST_PAGES:
            return 503, f'{MOST_PAGES} pages are open, which is the most; close one of them.'
        return None


async def _refuse(scope: Scope, receive: Receive, send: Send, code: int, words: str) -> None:
    if scope['type'] == 'http':
        await PlainTextResponse(f'{words}\n', code)(scope, receive, send)
        return
    await receive()
    number, reason = FULL if code == 503 else POLICY
    await send({'type': 'websocket.close', 'code': number, 'reason': reason})


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
        return '' if host in LOOPBACK else secrets.token_urlsafe(LEAST_TOKEN)
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
        self._thread.start()

    def end(self) -> None:
        self._server.should_exit = True
        if self._thread.is_alive():
            self._thread.join(2 * END_S)
        with contextlib.suppress(OSError):
            self._socket.close()
