"""Just enough of Protocol Buffers for Foxglove's messages. Sources: protobuf.dev (encoding), foxglove-sdk (schemas)."""

from __future__ import annotations

import struct

Value = int | bytes
Fields = dict[int, list[Value]]
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_MOST_BYTES = 10  # of a number


def fields_of(data: bytes) -> Fields:
    """The fields of a message by number, each as often as it is there. Raises: ValueError when they do not fill it."""
    found, at = Fields(), 0
    while at < len(data):
        key, at = _varint(data, at)
        kind, value = key & 7, 0
        if kind == _VARINT:
            value, at = _varint(data, at)
            found.setdefault(key >> 3, []).append(value)
            continue
        if kind not in (_FIXED64, _BYTES, _FIXED32):
            raise ValueError(f"field of kind {kind}")
        length = {_FIXED64: 8, _FIXED32: 4}.get(kind, 0)
        if kind == _BYTES:
            length, at = _varint(data, at)
        if at + length > len(data):
            raise ValueError("a field is cut short")
        content = data[at : at + length]
        found.setdefault(key >> 3, []).append(content if kind == _BYTES else int.from_bytes(content, "little"))
        at += length
    return found


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = 0
    for number in range(_MOST_BYTES):
        if at >= len(data):
            break
        value |= (data[at] & 0x7F) << 7 * number
        at += 1
        if not data[at - 1] & 0x80:
            return value, at
    raise ValueError("a number is cut short")


def number(fields: Fields, key: int) -> int:
    """A whole number, 0 where it is not there. Raises: ValueError for anything else."""
    value = fields.get(key, [0])[-1]
    if not isinstance(value, int):
        raise ValueError(f"field {key} is no number")
    return value


def content(fields: Fields, key: int) -> bytes:
    """Bytes, a text or a message within, empty where it is not there. Raises: ValueError for anything else."""
    value = fields.get(key, [b""])[-1]
    if not isinstance(value, bytes):
        raise ValueError(f"field {key} is a number")
    return value


def doubles(fields: Fields, key: int) -> tuple[float, ...]:
    """Numbers of 8 bytes each, packed or one by one. Raises: ValueError for anything else."""
    data = b"".join(value if isinstance(value, bytes) else struct.pack("<Q", value) for value in fields.get(key, []))
    if len(data) % 8:
        raise ValueError(f"field {key} is no list of numbers")
    return struct.unpack(f"<{len(data) // 8}d", data)


def time_ns(fields: Fields, key: int) -> int:
    """A google.protobuf.Timestamp. Raises: ValueError for anything else."""
    inner = fields_of(content(fields, key))
    return number(inner, 1) * 10**9 + number(inner, 2)
