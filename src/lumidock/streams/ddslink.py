"""Fixes to ROS 2 over DDS, without ROS: poses, transforms and status; pictures go by zenoh or MCAP."""

from __future__ import annotations

from typing import Any

from cyclonedds.core import DDSException, Policy, Qos
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic

from lumidock.datatypes import Detections, Fix, Frame, Unusable
from lumidock.streams import ros2, rostypes
from lumidock.streams.ddstypes import as_dds, dds_type, participant

_TOPICS = tuple(t for t in rostypes.TYPES if not t.startswith((f"{rostypes.PREFIX}/image", f"{rostypes.PREFIX}/annot")))


class DdsLink:
    """Publishes in a domain of DDS, on this machine only or on every interface."""

    def __init__(self, domain: int, everywhere: bool, publication: ros2.Publication) -> None:
        """Join `domain`. Raises: OSError when that cannot be."""
        self._participant = participant(domain, everywhere)
        try:
            self._writers = {topic: self._writer(topic) for topic in _TOPICS}
        except DDSException as error:
            raise OSError(f"DDS domain {domain}: {error}") from None
        self._publication = publication

    def _writer(self, topic: str) -> DataWriter[Any]:
        last = Policy.Durability.TransientLocal if topic == "/tf_static" else Policy.Durability.Volatile
        # a reader that does not keep up loses messages, and never holds us up
        qos = Qos(Policy.Reliability.Reliable(0), last, Policy.History.KeepLast(10))
        return DataWriter(
            self._participant, Topic(self._participant, f"rt{topic}", dds_type(rostypes.TYPES[topic]), qos), qos
        )

    def add(self, item: Frame | Detections | Unusable, fix: Fix, latency_us: int | None) -> None:
        """Publish one frame. Raises: OSError when DDS refuses."""
        try:
            for message in self._publication.messages(item, fix, latency_us, picture=False):
                kind = rostypes.TYPES[message.topic]
                content = rostypes.typestore().deserialize_cdr(message.data, kind)
                self._writers[message.topic].write(as_dds(content, kind))
        except DDSException as error:
            raise OSError(str(error)) from None

    def close(self) -> None:
        """Stop publishing."""
        self._writers.clear()
