"""The console as an HTTP server on a thread of its own."""

from __future__ import annotations

import socket
import threading
import time

import uvicorn

from lumidock.app.console.guard import Guard, new_token
from lumidock.app.console.routes import Console, application

_STARTING_S = 10.0
_CLOSING_S = 3.0
_MOST_CONNECTIONS = 64  # beyond them a client is told to come later
_MOST_MESSAGE = 1024  # bytes of what a page sends over its socket: the number of the fix that it saw last
_IDLE_S = 5  # until a connection without a request is closed


class ConsoleServer:
    """Serves a console from its creation until it is closed."""

    def __init__(self, console: Console, host: str, port: int) -> None:
        """Listen on `host`, `port` (0: any that is free). Raises: OSError when that cannot be."""
        self.console, self.token = console, new_token()
        self._socket = _listening(host, port)
        config = uvicorn.Config(
            Guard(application(console), host, self.token),
            ws="wsproto",
            ws_max_size=_MOST_MESSAGE,
            http="h11",
            loop="asyncio",
            lifespan="off",
            log_config=None,
            log_level="critical",  # garbage from clients is no news
            access_log=False,
            server_header=False,
            limit_concurrency=_MOST_CONNECTIONS,
            timeout_keep_alive=_IDLE_S,
            timeout_graceful_shutdown=1,
        )
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._server.run, args=([self._socket],), name="console", daemon=True)
        self._thread.start()
        end_s = time.monotonic() + _STARTING_S
        while not self._server.started and self._thread.is_alive() and time.monotonic() < end_s:
            time.sleep(0.01)
        if not self._server.started:
            self.close()
            raise OSError("the console did not start")

    @property
    def port(self) -> int:
        """The port that is listened on."""
        return int(self._socket.getsockname()[1])

    def close(self) -> None:
        """Stop answering, and end what the console started."""
        self._server.should_exit = True
        self._thread.join(_CLOSING_S)
        self._socket.close()
        self.console.close()


def _listening(host: str, port: int) -> socket.socket:
    family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    listener = socket.socket(family, kind, protocol)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.listen()  # only now is the port nobody else's: two sockets may be bound to it
    except OSError:
        listener.close()
        raise
    return listener
