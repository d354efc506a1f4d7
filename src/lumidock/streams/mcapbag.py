"""Messages out of an MCAP file that may be cut short, damaged or hostile. Source: MCAP specification, mcap.dev."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, Schema
from mcap.summary import Summary

from lumidock.errors import InputError
from lumidock.streams.ros import Broken, Message, Topic, ros2_type

_MAGIC = b"\x89MCAP0\r\n"
_ENCODINGS = ("ros1", "cdr", "protobuf")
_MAX_RECORD = 1 << 28  # a chunk of 256 MiB holds ten raw pictures of 24 megapixels
_HEAD, _MESSAGE = struct.Struct("<BQ"), struct.Struct("<HIQQ")
# opcode and length of a chunk, times of its first and last message, its size and checksum, length of its compression
_CHUNK = struct.Struct("<BQQQQII")
_CHUNK_OPCODE, _LONGEST_NAME, _BLOCK = bytes([int(Opcode.CHUNK)]), 8, 1 << 20
_LAST_OPCODE = int(Opcode.DATA_END)
_DAMAGED = (
    *(McapError, ValueError, EOFError, OverflowError, struct.error),
    *(MemoryError, RuntimeError, KeyError, zstandard.ZstdError),
)


def topics(path: Path) -> list[Topic]:
    """Topics of an MCAP file, from its summary or, where a killed recorder left none, from all of it.

    Raises: InputError when it is no MCAP file.
    """
    with path.open("rb") as file:
        _check_magic(path, file)
        summary = _summary(file)
        if summary is None or not summary.channels:
            return _count_topics(path, file)
        counts = summary.statistics.channel_message_counts if summary.statistics else None
        return [
            Topic(channel.topic, ros2_type(schema.name), counts.get(number, 0) if counts is not None else None)
            for number, channel in summary.channels.items()
            if (schema := summary.schemas.get(channel.schema_id)) is not None
        ]


def messages(path: Path, wanted: Collection[str]) -> Iterator[Message | Broken]:
    """Messages on the topics `wanted`, in the order of the file; what cannot be read is skipped and told.

    Raises: InputError when it is no MCAP file.
    """
    with path.open("rb") as file:
        _check_magic(path, file)
        summary = _summary(file)
        known, chunks = _Known(wanted), list[int]()
        if summary is not None:  # the chunk that defines a channel may be the one that is damaged
            chunks = sorted(index.chunk_start_offset for index in summary.chunk_indexes)
            known.schemas = {number: ros2_type(schema.name) for number, schema in summary.schemas.items()}
            known.channels = dict(summary.channels)
        yield from _walk(path, file, chunks, known)


@dataclass(slots=True)
class _Known:
    """Schemas and channels met so far, and the topics that are wanted; all of them when that is None."""

    wanted: Collection[str] | None
    schemas: dict[int, str] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)

    def read(self, opcode: int, body: bytes) -> Message | None:
        """The message of a record, if it is one; schemas and channels are kept."""
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(ReadDataStream(BytesIO(body)))
            self.schemas[schema.id] = ros2_type(schema.name)
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(ReadDataStream(BytesIO(body)))
            self.channels[channel.id] = channel
        elif opcode == Opcode.MESSAGE:
            number, _, log_ns, _ = _MESSAGE.unpack_from(body)
            seen = self.channels.get(number)
            if seen is not None and (self.wanted is None or seen.topic in self.wanted):
                named = seen.message_encoding or "cdr"
                encoding = named if named in _ENCODINGS else "unknown"
                kind = self.schemas.get(seen.schema_id, "")
                return Message(seen.topic, kind, encoding, log_ns, body[_MESSAGE.size :])
        return None


def _check_magic(path: Path, file: BinaryIO) -> None:
    file.seek(0)
    if file.read(len(_MAGIC)) != _MAGIC:
        raise InputError(f"{path}: not an MCAP file")


def _summary(file: BinaryIO) -> Summary | None:
    file.seek(0)
    try:
        return SeekingReader(file, record_size_limit=_MAX_RECORD).get_summary()
    except (*_DAMAGED, OSError, TypeError):
        return None


def _count_topics(path: Path, file: BinaryIO) -> list[Topic]:
    known, counts = _Known(None), dict[tuple[str, str], int]()
    for message in _walk(path, file, [], known):
        if isinstance(message, Message):
            key = message.topic, message.type
            counts[key] = counts.get(key, 0) + 1
    return [Topic(name, kind, count) for (name, kind), count in counts.items()]


def _walk(path: Path, file: BinaryIO, chunks: list[int], known: _Known) -> Iterator[Message | Broken]:
    """Record by record; where one makes no sense, on from the next chunk, by the summary or else by its looks."""
    size = file.seek(0, 2)
    before, at = 0, len(_MAGIC)
    while at < size:
        opcode, length = _head(file, at)
        if opcode in (Opcode.DATA_END, Opcode.FOOTER):
            return
        end, broken = at + _HEAD.size + length, True
        if length <= _MAX_RECORD and _is_record(opcode, end, size):
            broken = False
            for found in _record(path, at, opcode, file.read(length), known):
                broken = broken or isinstance(found, Broken)
                yield found
        else:
            yield Broken(f"{path}: damaged or cut short at byte {at}")
        if broken and not _follows(file, end, size):  # no length can be believed, nor that of the record before
            end = _resumed(file, chunks, before, at, size)
        before, at = at, end


def _resumed(file: BinaryIO, chunks: list[int], before: int, at: int, size: int) -> int:
    """Where to read on, by the summary's `chunks` or by looks, after the record at `at`: perhaps short of it."""
    if chunks:
        return next((start for start in chunks if start > before and start != at), size)
    found = _next_chunk(file, before + 1, size)
    return found if found != at else _next_chunk(file, at + 1, size)


def _head(file: BinaryIO, at: int) -> tuple[int, int]:
    """Opcode and length of the record at byte `at`; zeros at the end of the file."""
    file.seek(at)
    head = file.read(_HEAD.size)
    return _HEAD.unpack(head) if len(head) == _HEAD.size else (0, 0)


def _is_record(opcode: int, end: int, size: int) -> bool:
    """Whether a record that would end at byte `end` can be one of a file of `size` bytes."""
    return 0 < opcode <= _LAST_OPCODE and end <= size


def _follows(file: BinaryIO, at: int, size: int) -> bool:
    """Whether a record can begin at byte `at`, or the file end there."""
    if at >= size:
        return at == size
    opcode, length = _head(file, at)
    return _is_record(opcode, at + _HEAD.size + length, size)


def _next_chunk(file: BinaryIO, start: int, size: int) -> int:
    """Where the next chunk begins from `start` on, by what its first fields and the record behind it look like."""
    while start < size:
        file.seek(start)
        block = file.read(_BLOCK + _CHUNK.size)
        at = block.find(_CHUNK_OPCODE)
        while 0 <= at < _BLOCK:
            if len(block) >= at + _CHUNK.size:
                _, length, first_ns, last_ns, _, _, name = _CHUNK.unpack_from(block, at)
                end = start + at + _HEAD.size + length
                sound = first_ns <= last_ns and name <= _LONGEST_NAME and _HEAD.size < length <= _MAX_RECORD
                if sound and _follows(file, end, size):
                    return start + at
            at = block.find(_CHUNK_OPCODE, at + 1)
        start += _BLOCK
    return size


def _record(path: Path, at: int, opcode: int, body: bytes, known: _Known) -> Iterator[Message | Broken]:
    try:
        inner = _unpacked(body) if opcode == Opcode.CHUNK else [(opcode, body)]
        for kind, content in inner:
            message = known.read(kind, content)
            if message is not None:
                yield message
    except _DAMAGED as error:
        yield Broken(f"{path}: chunk at byte {at}: {' '.join(str(error).split()) or type(error).__name__}")


def _unpacked(body: bytes) -> Iterator[tuple[int, bytes]]:
    """Records of a chunk, whose size and checksum are held against what it says of itself."""
    chunk = Chunk.read(ReadDataStream(BytesIO(body)))
    if chunk.uncompressed_size > _MAX_RECORD:
        raise ValueError(f"claims {chunk.uncompressed_size} bytes")
    data = _decompress(chunk.data, chunk.compression, chunk.uncompressed_size)
    if len(data) != chunk.uncompressed_size or chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise ValueError("checksum or size does not fit")
    at = 0
    while at + _HEAD.size <= len(data):
        opcode, length = _HEAD.unpack_from(data, at)
        at += _HEAD.size
        yield opcode, data[at : at + length]
        at += length


def _decompress(data: bytes, compression: str, size: int) -> bytes:
    """At most `size` + 1 bytes of what `data` holds."""
    if compression == "zstd":
        return bytes(zstandard.ZstdDecompressor().stream_reader(data).read(size + 1))
    if compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1))
    if compression:
        raise ValueError(f"compression {compression[:20]!r} is not supported")
    return data
