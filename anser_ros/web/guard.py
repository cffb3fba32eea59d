"""Decides who may look: only this machine, or who knows the token; and how many at a time."""

import hmac
from collections.abc import Awaitable, Callable, MutableMapping
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

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


def is_local(host: str) -> bool:
    """Return whether an address can be reached from this machine alone."""
    return host in LOOPBACK


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
        """Pass a request on, or refuse it."""
        if scope['type'] not in ('http', 'websocket'):
            await self._inner(scope, receive, send)
            return
        headers = {name.decode('latin-1'): value.decode('latin-1')
                   for name, value in scope['headers']}  # fmt: skip
        query = parse_qs(scope['query_string'].decode('latin-1'))
        given = query.get('token', [''])[0]
        refused = self._refusal(scope, headers, query, given)
        if refused:
            await _refuse(scope, receive, send, *refused)
        elif scope['type'] == 'websocket':
            await self._connect(scope, receive, send)
        elif given and self._token:
            await _keep_token(scope, send, given)
        else:
            await self._inner(scope, receive, send)

    def _refusal(
        self, scope: Scope, headers: dict[str, str], query: dict[str, list[str]], given: str
    ) -> tuple[int, str] | None:
        host, origin = headers.get('host', ''), headers.get('origin', '')
        if not self._token and not is_local(urlsplit(f'//{host}').hostname or ''):
            return 403, 'The live view answers to localhost only.'
        if origin and urlsplit(origin).netloc != host:
            return 403, 'The request comes from another page.'
        if self._token and not hmac.compare_digest(
            (given or _token_of(headers)).encode(), self._token.encode()
        ):
            return 401, 'Open the address with ?token=..., as the live view has printed it.'
        # A page that is connected can be counted; one that asks over and over can not.
        if query.get('transport') == ['polling']:
            return 403, 'WebSockets are needed.'
        is_new = scope['type'] == 'websocket' or scope['path'] == '/'
        if is_new and self.pages >= MOST_PAGES:
            return 503, f'{MOST_PAGES} pages are open, which is the most; close one of them.'
        return None

    async def _connect(self, scope: Scope, receive: Receive, send: Send) -> None:
        self.pages += 1
        try:
            await self._inner(scope, receive, send)
        finally:
            self.pages -= 1


def _token_of(headers: dict[str, str]) -> str:
    try:
        cookies = SimpleCookie(headers.get('cookie', ''))
    except CookieError:
        return ''
    return cookies[COOKIE].value if COOKIE in cookies else ''


async def _keep_token(scope: Scope, send: Send, token: str) -> None:
    """Let the browser keep the token, and take it out of the address line."""
    cookie = f'{COOKIE}={token}; HttpOnly; SameSite=Strict; Path=/'
    headers = [('location', scope['path']), ('set-cookie', cookie)]
    await _answer(send, 303, headers, '')


async def _refuse(scope: Scope, receive: Receive, send: Send, code: int, words: str) -> None:
    if scope['type'] == 'http':
        await _answer(send, code, [('content-type', 'text/plain')], words + '\n')
        return
    await receive()
    number, reason = FULL if code == 503 else POLICY
    await send({'type': 'websocket.close', 'code': number, 'reason': reason})


async def _answer(send: Send, code: int, headers: list[tuple[str, str]], text: str) -> None:
    coded = [(name.encode(), value.encode('latin-1')) for name, value in headers]
    await send({'type': 'http.response.start', 'status': code, 'headers': coded})
    await send({'type': 'http.response.body', 'body': text.encode()})
