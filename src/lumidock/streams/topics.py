"""Pictures of a ROS 2 topic, live over zenoh or DDS: the newest message is decoded, older ones are dropped."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Protocol

from lumidock.datatypes import Frame, Unusable
from lumidock.errors import FrameError, InputError, extra
from lumidock.streams.bag_info import names_by_pictures
from lumidock.streams.camera_info import camera_of, is_rectified
from lumidock.streams.ros import CAMERA_INFO, COMPRESSED, IMAGE, Content, Message, content_of, info_of, picture_of
from lumidock.streams.source import Item, Network, Reading, Size, Source

_ADDRESS = re.compile(r"(zenoh|dds):((?:tcp|udp|tls|quic)/[^/?#]+:[0-9]{1,5})?((?:/[A-Za-z][A-Za-z0-9_]*)+)")
WANTED = "zenoh:[tcp/HOST:PORT]/TOPIC or dds:/TOPIC"
_ENDPOINT = "tcp/127.0.0.1:7447"  # where rmw_zenohd listens
_TYPES = {"": IMAGE, "compressed": COMPRESSED}  # by how image_transport ends the name of a topic
_LOST_S = 5.0  # without a picture a topic is taken for lost
_CALIBRATION_S = 10.0  # that a CameraInfo is waited for, which drivers send with every picture


class Listening(Protocol):
    """A subscription: why nothing comes, where that is known, and its end."""

    @property
    def problem(self) -> str:
        """Why no messages come; empty where nothing is known to be wrong."""
        ...

    def close(self) -> None:
        """Stop listening."""
        ...


Listen = Callable[[Mapping[str, str], Callable[[Message], None]], Listening]


def open_topic(address: str, reading: Reading, network: Network) -> Source:
    """The pictures of a topic; their calibration, unless it is given, by the CameraInfo beside it.

    Raises: InputError for an address that is none.
    """
    found = _ADDRESS.fullmatch(address)
    if found is None or (found[1] == "dds" and found[2]):
        raise InputError(f"{address}: wanted {WANTED}")
    link, endpoint, topic = found[1], found[2] or _ENDPOINT, found[3]
    listen = partial(_listen, link, endpoint, network)
    base, _, form = topic.rpartition("/")
    pictures, kind = (base, _TYPES[form]) if form in _TYPES else (topic, IMAGE)
    source = Source(Path(address), link, partial(frames_of, listen, {topic: kind}, reading), live=True)
    if not reading.follow_calibration:
        return source
    return _with_calibration(source, listen, pictures, reading)


def _listen(
    link: str, endpoint: str, network: Network, topics: Mapping[str, str], take: Callable[[Message], None]
) -> Listening:
    try:
        if link == "zenoh":
            with extra("zenoh"):
                from lumidock.streams.zenohsession import ZenohTopics
            return ZenohTopics(endpoint, network.domain, tuple(topics), take)
        with extra("dds"):
            from lumidock.streams.ddstopics import DdsTopics
        return DdsTopics(network.domain, network.everywhere, topics, take)
    except OSError as error:
        raise InputError(str(error)) from None


class _Newest:
    """Keeps the newest message of any topic."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._message: Message | None = None

    def take(self, message: Message) -> None:
        """Replace what is there."""
        with self._changed:
            self._message = message
            self._changed.notify()

    def get(self, timeout_s: float) -> Message | None:
        """Wait for a message; None when none comes in time."""
        with self._changed:
            self._changed.wait_for(lambda: self._message is not None, timeout_s)
            message, self._message = self._message, None
            return message


def frames_of(listen: Listen, topics: Mapping[str, str], reading: Reading, size: Size | None) -> Iterator[Item]:
    """The newest picture, over and over. Raises: InputError where none comes for some seconds."""
    newest, (topic,), number, by_header = _Newest(), topics, 0, True
    with closing(listen(topics, newest.take)) as listening:
        while True:
            message = newest.get(_LOST_S)
            if message is None:
                why = f": {listening.problem}" if listening.problem else ""
                raise InputError(f"{topic}: no picture for {_LOST_S:g} s{why}")
            name = f"{number:06d}"
            try:
                content = content_of(message)
                if number == 0:
                    by_header = content.stamp_ns != 0
                yield _item(name, content, message, by_header, reading, size)
            except FrameError as error:
                yield Unusable(name, message.log_ns, error.reason, str(error))
            number += 1


def _item(name: str, content: Content, message: Message, by_header: bool, reading: Reading, size: Size | None) -> Item:
    """One picture with the stamp of its header or, where headers have none, of its arrival. Raises: FrameError."""
    if content.kind == "video":
        raise FrameError("bad_frame", f"{message.topic}: video is not read live; publish raw or compressed pictures")
    if by_header and content.stamp_ns == 0:
        why = f"{message.topic}: frame {name}: its header has no stamp, as others have"
        return Unusable(name, None, "bad_stamp", why)
    image, encoding = picture_of(content, message.topic, reading, size)
    return Frame(name, content.stamp_ns if by_header else message.log_ns, image, encoding=encoding)


def _with_calibration(source: Source, listen: Listen, pictures: str, reading: Reading) -> Source:
    """The same source with the calibration that is published beside it, or why there is none."""
    names = (reading.info_topic,) if reading.info_topic else names_by_pictures(pictures)
    newest, end_s = _Newest(), time.monotonic() + _CALIBRATION_S
    rectified, problem = is_rectified(pictures), ""
    with closing(listen(dict.fromkeys(names, CAMERA_INFO), newest.take)) as listening:
        while (left_s := end_s - time.monotonic()) > 0.0:
            message = newest.get(left_s)
            if message is None or message.type != CAMERA_INFO:
                continue
            try:
                camera, notes = camera_of(info_of(message), rectified=rectified, trusted=reading.trusted)
            except InputError as error:
                problem = str(error)
                break
            return Source(
                source.path, source.kind, source.read, live=True, calibration=camera, rectified=rectified, notes=notes
            )
        why = f" ({listening.problem})" if listening.problem else ""
    problem = problem or f"{source.path}: no calibration on {', '.join(names)}{why}; give --camera FILE"
    return Source(source.path, source.kind, source.read, live=True, no_calibration=problem)
