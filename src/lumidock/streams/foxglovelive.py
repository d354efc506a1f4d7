"""Fixes to Foxglove, live, over a WebSocket of this machine."""

from __future__ import annotations

import foxglove
from foxglove import Channel, Schema

from lumidock.datatypes import Detections, Fix, Frame, Unusable
from lumidock.streams import ros2, rostypes

_BACKLOG = 32  # messages that a client may be behind before the oldest are dropped


class FoxgloveLive:
    """A server that Foxglove connects to; a client that does not keep up loses messages, not we time."""

    def __init__(self, host: str, port: int, publication: ros2.Publication) -> None:
        """Listen on `host`, `port`. Raises: OSError when that cannot be."""
        self._context = foxglove.Context()
        try:
            self._server = foxglove.start_server(
                name="lumidock", host=host, port=port, context=self._context, message_backlog_size=_BACKLOG
            )
        except (RuntimeError, OSError) as error:
            raise OSError(f"{host}:{port}: {error}") from None
        self._publication = publication
        self._channels = {
            topic: Channel(
                topic,
                schema=Schema(name=kind, encoding="ros2msg", data=rostypes.definition(kind).encode()),
                message_encoding="cdr",
                context=self._context,
            )
            for topic, kind in rostypes.TYPES.items()
        }

    @property
    def port(self) -> int:
        """The port that is listened on."""
        return int(self._server.port)

    def add(self, item: Frame | Detections | Unusable, fix: Fix, latency_us: int | None) -> None:
        """Send one frame to whoever listens."""
        for message in self._publication.messages(item, fix, latency_us):
            self._send(message)

    def _send(self, message: rostypes.Serialized) -> None:
        self._channels[message.topic].log(message.data, log_time=max(message.t_ns, 0))

    def close(self) -> None:
        """Part from the clients."""
        self._server.stop()
