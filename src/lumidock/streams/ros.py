"""ROS messages as frames and cameras: Image, CompressedImage and CameraInfo of ROS 1 and ROS 2, without ROS."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cache
from typing import Any

import cv2
import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from lumidock.camera import Camera, camera_from
from lumidock.datatypes import Image
from lumidock.errors import FrameError, InputError
from lumidock.streams.images import MAX_PIXELS, decode_image, mono_if_gray

IMAGE, COMPRESSED, CAMERA_INFO = (f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo"))
_UNREADABLE = (SerdeError, ValueError, IndexError, KeyError, TypeError, AssertionError, struct.error, MemoryError)

# channels, bytes each, conversion to bgr8 or mono8; sensor_msgs/image_encodings.hpp
_BAYER = {"rggb": cv2.COLOR_BayerRGGB2BGR, "bggr": cv2.COLOR_BayerBGGR2BGR, "gbrg": cv2.COLOR_BayerGBRG2BGR}
_BAYER["grbg"] = cv2.COLOR_BayerGRBG2BGR
_ENCODINGS: dict[str, tuple[int, int, int | None]] = {
    "mono8": (1, 1, None),
    "8UC1": (1, 1, None),
    "mono16": (1, 2, None),
    "16UC1": (1, 2, None),
    "bgr8": (3, 1, None),
    "8UC3": (3, 1, None),
    "rgb8": (3, 1, cv2.COLOR_RGB2BGR),
    "bgr16": (3, 2, None),
    "rgb16": (3, 2, cv2.COLOR_RGB2BGR),
    "bgra8": (4, 1, cv2.COLOR_BGRA2BGR),
    "rgba8": (4, 1, cv2.COLOR_RGBA2BGR),
    "uyvy": (2, 1, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422": (2, 1, cv2.COLOR_YUV2BGR_UYVY),
    "yuyv": (2, 1, cv2.COLOR_YUV2BGR_YUY2),
    "yuv422_yuy2": (2, 1, cv2.COLOR_YUV2BGR_YUY2),
    **{f"bayer_{pattern}{8 * size}": (1, size, code) for pattern, code in _BAYER.items() for size in (1, 2)},
}


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


def picture_of(message: Message, *, bits: int = 16) -> tuple[int, Image]:
    """Exposure time ns, or where that is zero the time of recording, and picture, mono8 or bgr8, of a message.

    16-bit pixels keep the upper 8 of their `bits`. Raises: FrameError, one line.
    """
    content = _deserialize(message)
    t_ns = _stamp_ns(content.header.stamp) or message.log_ns
    try:
        if message.type == COMPRESSED:
            return t_ns, decode_image(bytes(content.data), message.topic)
        return t_ns, _raw_picture(content, message.topic, bits)
    except (cv2.error, MemoryError, ValueError) as error:
        raise FrameError("bad_frame", f"{message.topic}: {' '.join(str(error).split())}") from None


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


def _raw_picture(content: Any, topic: str, bits: int) -> Image:  # noqa: ANN401
    width, height, step = int(content.width), int(content.height), int(content.step)
    encoding = _ENCODINGS.get(str(content.encoding))
    if encoding is None:
        raise FrameError("bad_frame", f"{topic}: encoding {str(content.encoding)[:40]!r} is not supported")
    channels, size, conversion = encoding
    row = width * channels * size
    if not 0 < width * height <= MAX_PIXELS or step < row or step * height > len(content.data):
        raise FrameError("bad_frame", f"{topic}: {width}x{height} pixels do not fit {len(content.data)} bytes")
    data = np.asarray(content.data, np.uint8)[: step * height].reshape(height, step)[:, :row]
    pixels = np.ascontiguousarray(data)
    if size == 2:
        wide = pixels.view(np.dtype(np.uint16).newbyteorder(">" if content.is_bigendian else "<"))
        pixels = np.minimum(wide.astype(np.uint16) >> (bits - 8), 255).astype(np.uint8)
    image = pixels.reshape((height, width) if channels == 1 else (height, width, channels))
    if conversion is not None:
        image = np.asarray(cv2.cvtColor(image, conversion), np.uint8)
    return mono_if_gray(image)
