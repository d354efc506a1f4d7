"""ROS messages as frames and cameras: Image, CompressedImage and CameraInfo of ROS 1 and ROS 2, without ROS."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from lumidock.camera import Camera, camera_from
from lumidock.datatypes import ENCODINGS, Image
from lumidock.errors import FrameError, InputError
from lumidock.streams.images import decode_image, full_scale
from lumidock.streams.pixels import unpack

IMAGE, COMPRESSED, CAMERA_INFO = (f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo"))
_UNREADABLE = (SerdeError, ValueError, IndexError, KeyError, TypeError, AssertionError, struct.error, MemoryError)


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a bag: its type under the ROS 2 name, and how many messages it holds, where that is written."""

    name: str
    type: str
    count: int | None = None


@dataclass(frozen=True, slots=True)
class Message:
    """A message as it lies in a bag; `encoding` is cdr (ROS 2) or ros1, `log_ns` when it was recorded."""

    topic: str
    type: str
    encoding: str
    log_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Broken:
    """A stretch of a bag that cannot be read, and why."""

    text: str


@cache
def typestore(encoding: str) -> Typestore:
    """The message definitions of ROS 1 or ROS 2; those that a bag brings along are not trusted."""
    return get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_JAZZY)


def ros2_type(name: str) -> str:
    """A message type under its ROS 2 name: sensor_msgs/Image is sensor_msgs/msg/Image."""
    return name if "/msg/" in name else name.replace("/", "/msg/", 1)


def picture_of(message: Message, *, bits: int = 16) -> tuple[int, Image, str]:
    """Exposure time ns, or where that is zero the time of recording, picture and a mosaic's encoding, of a message.

    16-bit pixels, of which the lower `bits` count, get their full scale. Raises: FrameError, one line.
    """
    content = _deserialize(message)
    t_ns = _stamp_ns(content.header.stamp) or message.log_ns
    try:
        if message.type == COMPRESSED:
            encoding = _mosaic_in(str(content.format))
            return t_ns, full_scale(decode_image(bytes(content.data), "compressed", encoding), bits), encoding
        size, order = (int(content.width), int(content.height)), ">" if content.is_bigendian else "<"
        encoding, data = str(content.encoding), np.asarray(content.data, np.uint8)
        return t_ns, *unpack(data, encoding, size, int(content.step), order=order, bits=bits)
    except FrameError as error:
        raise FrameError(error.reason, f"{message.topic}: {error}") from None


def _mosaic_in(form: str) -> str:
    """The encoding of a mosaic that was compressed as it is: `bayer_rggb8; png compressed`, no colours after it."""
    encoding, _, how = form.partition(";")
    raw = encoding.startswith("bayer") and encoding in ENCODINGS and how.rstrip().endswith("compressed")
    return encoding if raw else ""


def stamp_of(message: Message) -> int:
    """Stamp of a message with a header, ns, or where that is zero the time of recording. Raises: FrameError."""
    return _stamp_ns(_deserialize(message).header.stamp) or message.log_ns


def camera_of(message: Message) -> Camera:
    """Camera of a CameraInfo message. Raises: InputError, one line, for one that is not calibrated or absurd."""
    try:
        info = _deserialize(message)
    except FrameError as error:
        raise InputError(str(error)) from None
    K, d = (info.K, info.D) if message.encoding == "ros1" else (info.k, info.d)
    if not np.any(K):
        raise InputError(f"{message.topic}: the camera is not calibrated; give --camera FILE")
    model, coefficients = str(info.distortion_model), [float(value) for value in d]
    if not coefficients:
        model, coefficients = "plumb_bob", [0.0] * 5
    most = {"plumb_bob": 5, "rational_polynomial": 8}.get(model, len(coefficients))
    if not any(coefficients[most:]):  # OpenCV fills up to 14 with zeros
        coefficients = coefficients[:most]
    size = int(info.width), int(info.height)
    return camera_from(message.topic, size, [float(value) for value in K], model, coefficients)


def _deserialize(message: Message) -> Any:  # noqa: ANN401  # classes made at run time from message definitions
    store = typestore(message.encoding)
    try:
        if message.encoding == "ros1":
            return store.deserialize_ros1(message.data, message.type)
        return store.deserialize_cdr(message.data, message.type)
    except _UNREADABLE as error:
        why = " ".join(str(error).split()) or type(error).__name__
        raise FrameError("bad_frame", f"{message.topic}: damaged message: {why}") from None


def _stamp_ns(stamp: Any) -> int:  # noqa: ANN401
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)
