"""The health of a running server as JSON, where the console is not installed or not wanted."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Callable
from functools import partial
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

from lumidock.streams.localweb import is_known_host, is_own_origin

_TIMEOUT_S = 2.0  # a client may take over one request


class HealthPage:
    """Answers GET /health.json, and GET / with the same, one client after the other."""

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
        host = self.headers.get("Host") or ""
        if not (is_known_host(self._listening, host) and is_own_origin(host, self.headers.get("Origin"))):
            self.send_error(403)
            return
        if self.path not in ("/", "/health.json"):
            self.send_error(404)
            return
        data = json.dumps(self._health()).encode()
        self.send_response(200)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002, ANN401
        """Keep quiet."""
