"""Fixes to ROS 2 over DDS, without ROS: poses, transforms and status; pictures go by zenoh or MCAP."""

from __future__ import annotations

import types
from dataclasses import dataclass
from functools import cache
from typing import Any

from cyclonedds.core import DDSException, Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl import types as idl
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic
from rosbags.interfaces import Nodetype

from lumidock.camera import Camera
from lumidock.datatypes import Detections, Fix, Frame, Unusable
from lumidock.streams import ros2, rostypes
from lumidock.streams.vehicle import Vehicle

_TOPICS = tuple(t for t in rostypes.TYPES if not t.startswith((f"{rostypes.PREFIX}/image", f"{rostypes.PREFIX}/annot")))
_NUMBERS = {"bool": bool, "string": str, "octet": idl.byte}
_LOOPBACK = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface address='127.0.0.1'/></Interfaces>"
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    "<Peers><Peer address='127.0.0.1'/></Peers></Discovery></Domain></CycloneDDS>"
)


class DdsLink:
    """Publishes in a domain of DDS, on this machine only or on every interface."""

    def __init__(
        self, domain: int, everywhere: bool, camera: Camera, vehicle: Vehicle | None, light_ids: tuple[str, ...]
    ) -> None:
        """Join `domain`. Raises: OSError when that cannot be."""
        try:
            self._domain = None if everywhere else Domain(domain, _LOOPBACK)
            self._participant = DomainParticipant(domain)
            self._writers = {topic: self._writer(topic) for topic in _TOPICS}
        except DDSException as error:
            raise OSError(f"DDS domain {domain}: {error}") from None
        self._publication = ros2.Publication(camera, vehicle, light_ids)

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
        """Leave the domain."""
        self._writers.clear()
        del self._participant, self._domain


@cache
def dds_type(message_type: str) -> type[IdlStruct]:
    """The class by which cyclonedds knows a ROS 2 message."""
    package, _, name = message_type.split("/")
    annotations = {field: _annotation(kind) for field, kind in rostypes.typestore().fielddefs[message_type][1]}
    made = types.new_class(
        f"{name}_",
        (IdlStruct,),
        {"typename": f"{package}.msg.dds_.{name}_"},
        lambda space: space.update({"__annotations__": annotations, "__module__": __name__}),
    )
    return dataclass(made)


def _annotation(kind: Any) -> Any:  # noqa: ANN401  # nested tuples of rosbags
    node, detail = kind
    if node == Nodetype.BASE:
        return _NUMBERS.get(detail[0]) or getattr(idl, detail[0])
    if node == Nodetype.NAME:
        return dds_type(detail)
    if node == Nodetype.SEQUENCE and detail[0] == (Nodetype.BASE, ("uint8", 0)):
        return bytes  # in one piece: a list of the bytes of a picture takes longer than the picture may
    inner, length = _annotation(detail[0]), detail[1]
    arrays: Any = idl.array if node == Nodetype.ARRAY else idl.sequence
    return arrays[inner, length] if node == Nodetype.ARRAY else arrays[inner]


def as_dds(content: Any, message_type: str) -> Any:  # noqa: ANN401
    """A message of rosbags as an object of `dds_type`."""
    fields = rostypes.typestore().fielddefs[message_type][1]
    return dds_type(message_type)(**{name: _value(getattr(content, name), kind) for name, kind in fields})


def _value(value: Any, kind: Any) -> Any:  # noqa: ANN401
    node, detail = kind
    if node == Nodetype.BASE:
        return value
    if node == Nodetype.NAME:
        return as_dds(value, detail)
    if hasattr(value, "dtype") and value.dtype == "uint8" and node == Nodetype.SEQUENCE:
        return value.tobytes()
    return [_value(one, detail[0]) for one in (value.tolist() if hasattr(value, "tolist") else value)]
