"""Who may ask the console for what: Host, Origin and token are checked before anything is answered.

Loopback alone: everything may be read without the token, and nothing be changed. Any other address: nothing but the
page itself, which holds no data, without the token. A name that another site's DNS points here is refused by the Host
header, a request of another site's page by the Origin header. Written against the ASGI specification alone.
"""

from __future__ import annotations

import hmac
import json
import secrets
from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import dataclass
from typing import Any

from lumidock.streams.localweb import is_known_host, is_loopback, is_own_origin

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
Application = Callable[[Message, Receive, Send], Awaitable[None]]

SUBPROTOCOL = "lumidock"  # of the live socket; the token is offered as a second one, as a browser can send no header
_TOKEN_PREFIX = "token."
_MOST_BODY = 1 << 16  # bytes of a request; settings of a dozen numbers need hundreds
_READING = ("GET", "HEAD")
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS = (
    (b"content-security-policy", _POLICY.encode()),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cache-control", b"no-store"),
)


def new_token() -> str:
    """A token that nobody can guess: 128 bits."""
    return secrets.token_urlsafe(16)


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a request is not answered: the HTTP status and a line."""

    status: int
    text: str


class Guard:
    """An ASGI application around another, which is reached by what passes the checks only."""

    def __init__(self, app: Application, host: str, token: str) -> None:
        """Guard `app`, which listens on the address `host`."""
        self._app, self._host, self._token, self._private = app, host, token, is_loopback(host)

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """Answer one request, or refuse it."""
        headers = dict(scope.get("headers", ()))
        refusal = self._why_not(scope, headers)
        if refusal is None:
            await self._app(scope, receive, _with_headers(send))
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008, "reason": refusal.text})
        else:
            await _refuse(_with_headers(send), refusal)

    def _why_not(self, scope: Message, headers: dict[bytes, bytes]) -> Refusal | None:
        if scope["type"] not in ("http", "websocket"):
            return Refusal(400, "neither HTTP nor a WebSocket")
        host = headers.get(b"host", b"").decode("latin-1")
        if not is_known_host(self._host, host):
            return Refusal(421, f"no console is known by the name {host[:80]!r}; open it by its address")
        origin = headers[b"origin"].decode("latin-1") if b"origin" in headers else None
        if not is_own_origin(host, origin):
            return Refusal(403, f"the page of {str(origin)[:80]!r} may not use this console")
        reading = scope["type"] == "websocket" or scope["method"] in _READING
        length = headers.get(b"content-length", b"0" if reading else b"")
        if not length.isdigit():
            return Refusal(411, "wanted a request with a Content-Length")
        if int(length) > _MOST_BODY:
            return Refusal(413, f"wanted at most {_MOST_BODY} bytes")
        free = reading and (self._private or not scope["path"].startswith("/api/"))
        if not free and not self._has_token(scope, headers):
            return Refusal(401, "wanted the token; open the address with #token= that the command printed")
        return None

    def _has_token(self, scope: Message, headers: dict[bytes, bytes]) -> bool:
        if scope["type"] == "websocket":
            offered = [name for name in scope.get("subprotocols", ()) if name.startswith(_TOKEN_PREFIX)]
            given = offered[0].removeprefix(_TOKEN_PREFIX) if offered else ""
        else:
            given = headers.get(b"authorization", b"").decode("latin-1").removeprefix("Bearer ")
        return hmac.compare_digest(given.encode(), self._token.encode())


def _with_headers(send: Send) -> Send:
    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            message["headers"] = [*message.get("headers", ()), *_HEADERS]
        await send(message)

    return sending


async def _refuse(send: Send, refusal: Refusal) -> None:
    body = json.dumps({"error": refusal.text}).encode()
    headers = [(b"content-type", b"application/json"), (b"content-length", str(len(body)).encode())]
    await send({"type": "http.response.start", "status": refusal.status, "headers": headers})
    await send({"type": "http.response.body", "body": body})
