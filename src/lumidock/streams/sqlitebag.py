"""Messages out of a ROS 2 bag in SQLite form. Source: the schema of rosbag2_storage_sqlite3."""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Iterator
from contextlib import closing
from pathlib import Path

import zstandard

from lumidock.errors import InputError
from lumidock.streams.ros import Broken, Message, Topic, ros2_type

_MAX_MESSAGE = 1 << 28
_ZSTD = b"\x28\xb5\x2f\xfd"
_DAMAGED = (sqlite3.Error, ValueError, TypeError, OverflowError, MemoryError, zstandard.ZstdError)
_TABLES = "SELECT count(*) FROM sqlite_master WHERE type = 'table' AND name IN ('topics', 'messages')"


def topics(path: Path) -> list[Topic]:
    """Topics of a bag. Raises: InputError when it is none."""
    query = "SELECT name, type, (SELECT count(*) FROM messages WHERE topic_id = topics.id) FROM topics"
    try:
        with closing(_open(path)) as database:
            return [Topic(str(name), ros2_type(str(kind)), count) for name, kind, count in database.execute(query)]
    except _DAMAGED as error:
        raise InputError(f"{path}: {' '.join(str(error).split())}") from None


def messages(path: Path, wanted: Collection[str]) -> Iterator[Message | Broken]:
    """Messages on the topics `wanted` by time of recording; where the file is damaged they end, and it is told.

    Raises: InputError when it is no such bag.
    """
    query = (
        "SELECT name, type, timestamp, data FROM messages JOIN topics ON topics.id = messages.topic_id"
        f" WHERE name IN ({','.join('?' * len(wanted))}) ORDER BY timestamp, messages.id"
    )
    with closing(_open(path)) as database:
        try:
            for name, kind, log_ns, data in database.execute(query, tuple(wanted)):
                yield Message(str(name), ros2_type(str(kind)), "cdr", int(log_ns), _plain(bytes(data)))
        except _DAMAGED as error:
            yield Broken(f"{path}: {' '.join(str(error).split())}")


def _open(path: Path) -> sqlite3.Connection:
    """The database, read-only; without a journal beside it nothing else can be writing."""
    journal = path.with_name(path.name + "-wal").exists()
    uri = f"{path.resolve().as_uri()}?mode=ro{'' if journal else '&immutable=1'}"
    try:
        database = sqlite3.connect(uri, uri=True)
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MAX_MESSAGE)
        if database.execute(_TABLES).fetchone() != (2,):  # a view in their place could keep us busy forever
            raise InputError(f"{path}: a database, but no bag of ROS 2")
    except _DAMAGED as error:
        raise InputError(f"{path}: {' '.join(str(error).split())}") from None
    return database


def _plain(data: bytes) -> bytes:
    """A message, unpacked where the recorder compressed each one."""
    if not data.startswith(_ZSTD):
        return data
    plain = zstandard.ZstdDecompressor().stream_reader(data).read(_MAX_MESSAGE + 1)
    if len(plain) > _MAX_MESSAGE:
        raise ValueError("a message unpacks to too much")
    return bytes(plain)
