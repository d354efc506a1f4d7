"""Fixes into an MCAP file for ROS 2, Foxglove and Rerun."""

from __future__ import annotations

import time
from pathlib import Path

from mcap.writer import CompressionType, Writer

from lumidock.datatypes import Detections, Fix, Frame, Unusable
from lumidock.streams import ros2, rostypes

_FLUSH_S = 0.2  # what a killed run may lose, and what the next look at the clock takes


class McapFile:
    """Writes every frame's messages; a file that was cut short can be read but for its last moment."""

    def __init__(self, path: Path, publication: ros2.Publication) -> None:
        """Start the file, replacing one that is there."""
        self._file = path.open("wb")
        self._writer = Writer(self._file, chunk_size=1 << 20, compression=CompressionType.LZ4)
        self._writer.start("ros2", "lumidock")
        for kind in set(rostypes.TYPES.values()):
            rostypes.definition(kind)  # takes a moment at first use, before there are frames
        self._writer.flush()
        self._publication = publication
        self._channels: dict[str, int] = {}
        self._flushed = time.monotonic()

    def add(self, item: Frame | Detections | Unusable, fix: Fix, latency_us: int | None) -> None:
        """Append one frame. Raises: OSError when it cannot be written."""
        for message in self._publication.messages(item, fix, latency_us):
            self._write(message)
        self.tick()

    def tick(self) -> None:
        """Give to the disk what has waited long enough, also when no frame comes."""
        if time.monotonic() - self._flushed > _FLUSH_S:
            self._writer.flush()
            self._flushed = time.monotonic()

    def _write(self, message: rostypes.Serialized) -> None:
        if message.topic not in self._channels:
            kind = rostypes.TYPES[message.topic]
            schema = self._writer.register_schema(kind, "ros2msg", rostypes.definition(kind).encode())
            quality = {"offered_qos_profiles": ""}
            self._channels[message.topic] = self._writer.register_channel(message.topic, "cdr", schema, quality)
        t_ns = max(message.t_ns, 0)
        self._writer.add_message(self._channels[message.topic], t_ns, message.data, t_ns)

    def close(self) -> None:
        """Write the summary and close the file."""
        try:
            self._writer.finish()
        finally:
            self._file.close()
