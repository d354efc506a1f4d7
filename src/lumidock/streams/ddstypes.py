"""ROS 2 messages as cyclonedds knows them, and participants in a domain of DDS."""

from __future__ import annotations

import types
from dataclasses import dataclass
from functools import cache
from typing import Any

from cyclonedds.core import DDSException
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl import types as idl
from rosbags.interfaces import Nodetype

from lumidock.streams import rostypes

_NUMBERS = {"bool": bool, "string": str, "octet": idl.byte}
_LOOPBACK = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface address='127.0.0.1'/></Interfaces>"
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    "<Peers><Peer address='127.0.0.1'/></Peers></Discovery></Domain></CycloneDDS>"
)


@cache
def participant(domain: int, everywhere: bool) -> DomainParticipant:
    """The participant of this process in `domain`, on this machine only or on every interface; there is one of each.

    Raises: OSError where that cannot be.
    """
    try:
        if not everywhere:
            _configured(domain)
        return DomainParticipant(domain)
    except DDSException as error:
        raise OSError(f"DDS domain {domain}: {error}") from None


@cache
def _configured(domain: int) -> Domain:
    """The domain with its settings, which hold as long as this object lives."""
    return Domain(domain, _LOOPBACK)


@dataclass
class RawSample:
    """A sample as it came, serialized as CDR; cyclonedds adds its `sample_info`."""

    data: bytes


def _as_it_came(_kind: object, data: bytes, has_header: bool = True, use_version_2: bool | None = None) -> RawSample:
    del has_header, use_version_2
    return RawSample(bytes(data))


@cache
def raw_type(message_type: str) -> type[IdlStruct]:
    """The same type as `dds_type`, of which samples are not taken apart: a picture would become a list of numbers."""
    known = dds_type(message_type)
    return types.new_class(
        known.__name__,
        (IdlStruct,),
        {"typename": _type_name(message_type)},
        lambda space: space.update(
            {"__annotations__": known.__annotations__, "__module__": __name__, "deserialize": classmethod(_as_it_came)}
        ),
    )


def _type_name(message_type: str) -> str:
    package, _, name = message_type.split("/")
    return f"{package}.msg.dds_.{name}_"


@cache
def dds_type(message_type: str) -> type[IdlStruct]:
    """The class by which cyclonedds knows a ROS 2 message."""
    annotations = {field: _annotation(kind) for field, kind in rostypes.typestore().fielddefs[message_type][1]}
    made = types.new_class(
        message_type.replace("/", "_"),
        (IdlStruct,),
        {"typename": _type_name(message_type)},
        lambda space: space.update({"__annotations__": annotations, "__module__": __name__}),
    )
    return dataclass(made)


def _annotation(kind: Any) -> Any:  # noqa: ANN401  # nested tuples of rosbags
    node, detail = kind
    if node == Nodetype.BASE:
        return _NUMBERS.get(detail[0]) or getattr(idl, detail[0])
    if node == Nodetype.NAME:
        return dds_type(detail)
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
    return [_value(one, detail[0]) for one in (value.tolist() if hasattr(value, "tolist") else value)]
