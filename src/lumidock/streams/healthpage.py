"""The health of a running server as a page and as JSON."""

from __future__ import annotations

import html
import json
import socket
import threading
from collections.abc import Callable
from functools import partial
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

from lumidock.streams.localweb import is_answered

_TIMEOUT_S = 2.0  # a client may take over one request
_STYLE = "body{font:15px/1.5 monospace;margin:2em;max-width:60em}td{padding:0 1.5em 0 0;vertical-align:top}"


class HealthPage:
    """Answers GET / with a page that renews itself and GET /health.json with JSON, one client after the other."""

    def __init__(self, host: str, port: int, health: Callable[[], dict[str, Any]]) -> None:
        """Listen on `host`, `port` (0: any that is free). Raises: OSError when that cannot be."""
        self._server = _Server((host, port), partial(_Handler, health, host))
        self._thread = threading.Thread(target=self._server.serve_forever, name="health", daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        """The port that is listened on."""
        return int(self._server.server_address[1])

    def close(self) -> None:
        """Stop answering."""
        self._server.shutdown()
        self._server.server_close()


class _Server(HTTPServer):
    def handle_error(self, *_: object) -> None:
        """Say nothing of clients that went away or talk nonsense."""


class _Handler(BaseHTTPRequestHandler):
    server_version, sys_version = "lumidock", ""

    def __init__(self, health: Callable[[], dict[str, Any]], host: str, *connection: Any) -> None:  # noqa: ANN401
        self._health, self._listening = health, host
        # over all of it: one byte a second would keep the next client waiting
        limit = threading.Timer(_TIMEOUT_S, lambda: connection[0].shutdown(socket.SHUT_RDWR))
        limit.daemon = True
        limit.start()
        try:
            super().__init__(*connection)
        finally:
            limit.cancel()

    def do_GET(self) -> None:  # the name that http.server calls
        if not is_answered(self._listening, self.headers.get("Host"), self.headers.get("Origin")):
            self.send_error(403)
            return
        health = self._health()
        if self.path == "/health.json":
            self._answer("application/json", json.dumps(health))
        elif self.path == "/":
            self._answer("text/html; charset=utf-8", _page(health))
        else:
            self.send_error(404)

    def _answer(self, kind: str, text: str) -> None:
        data = text.encode()
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002, ANN401
        """Keep quiet."""


def _page(health: dict[str, Any]) -> str:
    title = "lumidock: ok" if health["ok"] else "lumidock: NOT ok"
    head = f"<meta charset=utf-8><meta http-equiv=refresh content=1><title>{title}</title><style>{_STYLE}</style>"
    return f"<!doctype html>{head}<h1>{title}</h1>{_table(health)}"


def _table(content: dict[str, Any]) -> str:
    rows = (f"<tr><td>{html.escape(str(name))}<td>{_cell(value)}" for name, value in content.items())
    return f"<table>{''.join(rows)}</table>"


def _cell(value: object) -> str:
    if isinstance(value, dict):
        return _table(value)
    return html.escape(f"{value:.3g}" if isinstance(value, float) else str(value))
