"""Messages out of a ROS 1 bag that may be cut short, damaged or hostile. Source: wiki.ros.org/Bags/Format/2.0."""

from __future__ import annotations

import bz2
import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import lz4.frame

from lumidock.errors import InputError
from lumidock.streams.ros import Broken, Message, Topic, ros2_type

_MAGIC = b"#ROSBAG V2.0\n"
_MAX_RECORD = 1 << 28
_LENGTH = struct.Struct("<I")
_MESSAGE, _HEADER, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 5, 6, 7
_DAMAGED = (ValueError, KeyError, EOFError, OverflowError, OSError, RuntimeError, MemoryError, struct.error)

_Fields = dict[str, bytes]


def topics(path: Path) -> list[Topic]:
    """Topics of a ROS 1 bag, from its index or, where a killed recorder left none, from all of it.

    Raises: InputError when it is no such bag.
    """
    with path.open("rb") as file:
        known = _Known(None)
        _, counts, whole = _read_index(path, file, known)
        if not whole:
            counts = {}
            for message in _walk(path, file, [], known):
                if isinstance(message, Message):
                    counts[message.topic] = counts.get(message.topic, 0) + 1
        return [Topic(name, kind, counts.get(name)) for name, kind in dict(known.connections.values()).items()]


def messages(path: Path, wanted: Collection[str]) -> Iterator[Message | Broken]:
    """Messages on the topics `wanted`, in the order of the file; what cannot be read is skipped and told.

    Raises: InputError when it is no such bag.
    """
    with path.open("rb") as file:
        known = _Known(wanted)
        chunks = _read_index(path, file, known)[0]
        yield from _walk(path, file, chunks, known)


@dataclass(slots=True)
class _Known:
    """Topic and type of each connection met so far, and the topics that are wanted; all of them when that is None."""

    wanted: Collection[str] | None
    connections: dict[int, tuple[str, str]] = field(default_factory=dict)

    def read(self, header: _Fields, data: bytes) -> Message | None:
        """The message of a record, if it is one; connections are kept."""
        opcode = header["op"][0]
        if opcode == _CONNECTION:
            kind = _fields(data)["type"].decode()
            self.connections[_number(header["conn"])] = header["topic"].decode(), ros2_type(kind)
        elif opcode == _MESSAGE:
            topic, kind = self.connections.get(_number(header["conn"]), ("", ""))
            if topic and (self.wanted is None or topic in self.wanted):
                seconds, nanoseconds = struct.unpack("<II", header["time"])
                return Message(topic, kind, "ros1", seconds * 10**9 + nanoseconds, data)
        return None


def _number(value: bytes) -> int:
    return int.from_bytes(value, "little")


def _fields(data: bytes) -> _Fields:
    """The fields of a header. Raises: ValueError when they do not fill it."""
    found, at = _Fields(), 0
    while at < len(data):
        (length,) = _LENGTH.unpack_from(data, at)
        at += _LENGTH.size
        name, equals, value = data[at : at + length].partition(b"=")
        if not equals or at + length > len(data):
            raise ValueError("a header field is damaged")
        found[name.decode()] = value
        at += length
    return found


def _read_record(file: BinaryIO, at: int, size: int) -> tuple[_Fields, int, int]:
    """Header of the record at byte `at`, where its data starts, and how long they are. Raises: ValueError."""
    file.seek(at)
    (length,) = _LENGTH.unpack(file.read(_LENGTH.size))
    if length > min(_MAX_RECORD, size - at):
        raise ValueError("a record claims too much")
    header = _fields(file.read(length))
    (length,) = _LENGTH.unpack(file.read(_LENGTH.size))
    start = file.tell()
    if length > min(_MAX_RECORD, size - start) or len(header["op"]) != 1:
        raise ValueError("a record claims too much")
    return header, start, length


def _read_index(path: Path, file: BinaryIO, known: _Known) -> tuple[list[int], dict[str, int], bool]:
    """Where chunks start, the messages of each topic, and whether the index behind the data could all be read."""
    size = file.seek(0, 2)
    file.seek(0)
    if file.read(len(_MAGIC)) != _MAGIC:
        raise InputError(f"{path}: not a bag of ROS 1")
    chunks, counts = list[int](), dict[str, int]()
    try:
        header, _, _ = _read_record(file, len(_MAGIC), size)
        at = _number(header["index_pos"]) or size
        whole = at < size
        while at < size:
            header, start, length = _read_record(file, at, size)
            data = file.read(length)
            known.read(header, data)
            if header["op"][0] == _CHUNK_INFO:
                chunks.append(_number(header["chunk_pos"]))
                for number, count in struct.iter_unpack("<II", data):
                    topic = known.connections.get(number, ("", ""))[0]
                    counts[topic] = counts.get(topic, 0) + count
            at = start + length
    except _DAMAGED:
        whole = False  # the data themselves are read record by record
    return sorted(chunks), counts, whole


def _walk(path: Path, file: BinaryIO, chunks: list[int], known: _Known) -> Iterator[Message | Broken]:
    """Record by record; where one makes no sense, on from the next chunk that the index lists."""
    size, at, index = file.seek(0, 2), len(_MAGIC), 0
    while at < size and not (index and at >= index):
        try:
            header, start, length = _read_record(file, at, size)
            if header["op"][0] == _HEADER:
                index = _number(header["index_pos"])
        except _DAMAGED:
            yield Broken(f"{path}: damaged or cut short at byte {at}")
            at = next((position for position in chunks if position > at), size)
            continue
        yield from _record(path, at, header, file.read(length), known)
        at = start + length


def _record(path: Path, at: int, header: _Fields, data: bytes, known: _Known) -> Iterator[Message | Broken]:
    try:
        inner = _unpacked(header, data) if header["op"][0] == _CHUNK else [(header, data)]
        for kind, content in inner:
            message = known.read(kind, content)
            if message is not None:
                yield message
    except _DAMAGED as error:
        yield Broken(f"{path}: chunk at byte {at}: {' '.join(str(error).split())}")


def _unpacked(header: _Fields, data: bytes) -> Iterator[tuple[_Fields, bytes]]:
    """Records of a chunk, whose size is held against what it says of itself."""
    size = _number(header["size"])
    if size > _MAX_RECORD:
        raise ValueError(f"claims {size} bytes")
    content = _decompress(data, header["compression"], size)
    if len(content) != size:
        raise ValueError("size does not fit")
    at = 0
    while at < size:
        (length,) = _LENGTH.unpack_from(content, at)
        fields = _fields(content[at + 4 : at + 4 + length])
        at += 4 + length
        (length,) = _LENGTH.unpack_from(content, at)
        yield fields, content[at + 4 : at + 4 + length]
        at += 4 + length


def _decompress(data: bytes, compression: bytes, size: int) -> bytes:
    """At most `size` + 1 bytes of what `data` holds."""
    if compression == b"none":
        return data
    if compression == b"bz2":
        return bz2.BZ2Decompressor().decompress(data, max_length=size + 1)
    if compression == b"lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1))
    raise ValueError(f"compression {compression[:20]!r} is not supported")
