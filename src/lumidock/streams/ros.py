"""Messages of bags as pictures and calibrations, without ROS: those of ROS 1, ROS 2 and Foxglove.

Read are Image, CompressedImage and CameraInfo of sensor_msgs, CompressedVideo of foxglove_msgs, FFMPEGPacket of
ffmpeg_image_transport_msgs, and of Foxglove, in protobuf, CompressedVideo, CompressedImage, RawImage and
CameraCalibration.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from lumidock.datatypes import ENCODINGS, Image
from lumidock.errors import FrameError, InputError
from lumidock.streams import protobuf
from lumidock.streams.camera_info import CameraInfo
from lumidock.streams.images import decode_image, full_scale, picture_header
from lumidock.streams.pixels import unpack
from lumidock.streams.source import Reading, Size

IMAGE, COMPRESSED, CAMERA_INFO = (f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo"))
_VIDEO, _FFMPEG = "foxglove_msgs/msg/CompressedVideo", "ffmpeg_image_transport_msgs/msg/FFMPEGPacket"
_FOX_VIDEO, _FOX_COMPRESSED, _FOX_RAW = (
    f"foxglove.{name}" for name in ("CompressedVideo", "CompressedImage", "RawImage")
)
_FOX_INFO = "foxglove.CameraCalibration"
# in the order in which one of several forms of the same pictures is preferred
PICTURES = (IMAGE, _FOX_RAW, COMPRESSED, _FOX_COMPRESSED, _VIDEO, _FOX_VIDEO, _FFMPEG)
INFOS = (CAMERA_INFO, _FOX_INFO)
_DEFINITIONS = {
    _VIDEO: "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n",
    _FFMPEG: (
        "std_msgs/Header header\nint32 width\nint32 height\nstring encoding\nuint64 pts\nuint8 flags\n"
        "bool is_bigendian\nuint8[] data\n"
    ),
}
# Of DVLs; their drivers also send TwistWithCovarianceStamped.
DVL, UUV_DVL, COLA_DVL = "marine_acoustic_msgs/msg/Dvl", "uuv_sensor_ros_plugins_msgs/msg/DVL", "cola2_msgs/msg/DVL"
_DVL_BEAM = (
    "float64 range\nfloat64 range_covariance\nfloat64 velocity\nfloat64 velocity_covariance\n"
    "geometry_msgs/PoseStamped pose\n"
)
_BEAMED = (
    "std_msgs/Header header\ngeometry_msgs/Vector3 velocity\nfloat64[9] velocity_covariance\nfloat64 altitude\n"
    "DVLBeam[] beams\n"
)
_DEFINITIONS |= {
    "uuv_sensor_ros_plugins_msgs/msg/DVLBeam": _DVL_BEAM,
    UUV_DVL: _BEAMED,
    "cola2_msgs/msg/DVLBeam": _DVL_BEAM,
    COLA_DVL: _BEAMED,
    DVL: (
        "std_msgs/Header header\nuint8 velocity_mode\nuint8 dvl_type\ngeometry_msgs/Vector3 velocity\n"
        "float64[9] velocity_covar\nfloat64 altitude\nfloat64 course_gnd\nfloat64 speed_gnd\nuint8 num_good_beams\n"
        "float32 sound_speed\nbool beam_ranges_valid\nbool beam_velocities_valid\n"
        "geometry_msgs/Vector3[4] beam_unit_vec\nfloat64[4] range\nfloat32[4] range_covar\nfloat32[4] beam_quality\n"
        "float32[4] beam_velocity\nfloat32[4] beam_velocity_covar\n"
    ),
}
UNREADABLE = (
    *(SerdeError, ValueError, IndexError, KeyError, TypeError),
    *(AssertionError, OverflowError, struct.error, MemoryError),
)
# by what encoders and formats are called, as PyAV calls the decoder
_CODECS = {"h264": "h264", "avc": "h264", "h265": "hevc", "hevc": "hevc", "vp9": "vp9", "av1": "av1", "vp8": "vp8"}
_START = (b"\0\0\0\1", b"\0\0\1")
_H264_FIRST, _H265_FIRST = {1, 5, 6, 7, 8, 9}, {1, 19, 20, 21, 32, 33, 34, 35, 39}  # NAL units that a frame begins with


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a bag: its type under the ROS 2 name, and how many messages it holds, where that is written."""

    name: str
    type: str
    count: int | None = None


@dataclass(frozen=True, slots=True)
class Message:
    """A message as it lies in a bag; `encoding` is cdr (ROS 2), ros1 or protobuf, `log_ns` when it was recorded."""

    topic: str
    type: str
    encoding: str
    log_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Broken:
    """A stretch of a bag that cannot be read, and why."""

    text: str


@dataclass(frozen=True, slots=True)
class Content:
    """What a message with a picture holds: its stamp ns (0: none), and data of a `kind` that `form` says more of.

    `raw` pixels in an encoding, with `size`, bytes a row and byte order; a `still` picture file; or a frame of `video`
    in a codec, which cannot be decoded on its own.
    """

    stamp_ns: int
    frame_id: str
    kind: Literal["raw", "still", "video"]
    form: str
    data: np.ndarray
    size: Size | None = None
    step: int = 0
    order: str = "<"


@cache
def typestore(encoding: str) -> Typestore:
    """The message definitions of ROS 1 or ROS 2; those that a bag brings along are not trusted."""
    store = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_JAZZY)
    for name, text in _DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store


def ros2_type(name: str) -> str:
    """A message type under its ROS 2 name: sensor_msgs/Image is sensor_msgs/msg/Image."""
    return name if "/msg/" in name else name.replace("/", "/msg/", 1)


def content_of(message: Message) -> Content:
    """The content of a message with a picture. Raises: FrameError, one line, for one that is damaged."""
    try:
        if message.encoding == "protobuf":
            return _of_protobuf(message)
        if message.encoding == "unknown":
            raise FrameError(
                "bad_frame",
                f"{message.topic}: messages in an encoding that is not read; read are cdr, ros1 and protobuf",
            )
        return _of_ros(message)
    except UNREADABLE as error:
        why = " ".join(str(error).split()) or type(error).__name__
        raise FrameError("bad_frame", f"{message.topic}: damaged message: {why}") from None


def _of_ros(message: Message) -> Content:
    found = deserialized(message)
    if message.type == _VIDEO:
        data = np.asarray(found.data, np.uint8)
        return Content(stamp_ns_of(found.timestamp), str(found.frame_id), "video", _codec(str(found.format)), data)
    stamp_ns, frame_id, data = (
        stamp_ns_of(found.header.stamp),
        str(found.header.frame_id),
        np.asarray(found.data, np.uint8),
    )
    if message.type == _FFMPEG:
        return Content(stamp_ns, frame_id, "video", _codec(str(found.encoding)), data)
    if message.type == COMPRESSED:
        return _compressed(stamp_ns, frame_id, str(found.format), data)
    size, order = (int(found.width), int(found.height)), ">" if found.is_bigendian else "<"
    return Content(stamp_ns, frame_id, "raw", str(found.encoding), data, size=size, step=int(found.step), order=order)


def _of_protobuf(message: Message) -> Content:
    fields = protobuf.fields_of(message.data)
    stamp_ns = protobuf.time_ns(fields, 1)
    if message.type == _FOX_RAW:
        size = protobuf.number(fields, 2), protobuf.number(fields, 3)
        encoding, step = protobuf.content(fields, 4).decode(), protobuf.number(fields, 5)
        data = np.frombuffer(protobuf.content(fields, 6), np.uint8)
        return Content(stamp_ns, protobuf.content(fields, 7).decode(), "raw", encoding, data, size=size, step=step)
    if message.type == _FOX_COMPRESSED:
        data, form = np.frombuffer(protobuf.content(fields, 2), np.uint8), protobuf.content(fields, 3).decode()
        return _compressed(stamp_ns, protobuf.content(fields, 4).decode(), form, data)
    data, form = np.frombuffer(protobuf.content(fields, 3), np.uint8), protobuf.content(fields, 4).decode()
    return Content(stamp_ns, protobuf.content(fields, 2).decode(), "video", _codec(form), data)


def _compressed(stamp_ns: int, frame_id: str, form: str, data: np.ndarray) -> Content:
    """A CompressedImage: a picture file or, against its definition and yet common, a frame of video."""
    if "compressedDepth" in form:
        raise FrameError("bad_frame", f"a depth picture ({form[:40]})")
    codec = _codec(form, default="") or _codec_in(bytes(data[:16]))
    if codec:
        return Content(stamp_ns, frame_id, "video", codec, data)
    return Content(stamp_ns, frame_id, "still", form, data)


def _codec(form: str, default: str | None = None) -> str:
    """The decoder for what a format or an encoder is called: h264, libx264, hevc_nvenc, video/H265, h264;yuv420p;..."""
    word = form.lower().replace(".", "").replace("x264", "h264").replace("x265", "h265").partition(";")[0]
    for name, codec in _CODECS.items():
        if name in word:
            return codec
    if default is not None:
        return default
    raise FrameError("bad_frame", f"video of codec {form[:40]!r} is not supported; read are {', '.join(_CODECS)}")


def _codec_in(head: bytes) -> str:
    """The codec of a frame of video by its first NAL unit; empty where it is no such frame."""
    for start in _START:
        if head.startswith(start) and len(head) > len(start):
            first = head[len(start)]
            if first & 0x1F in (7, 9):
                return "h264"
            if first >> 1 & 0x3F in _H265_FIRST and not first & 0x81:
                return "hevc"
            return "h264" if first & 0x1F in _H264_FIRST else ""
    return ""


def size_of(content: Content, topic: str, *, as_stored: bool = False) -> Size | None:
    """Size of a picture, by its header alone; None for video. Raises: FrameError, one line."""
    if content.kind == "raw":
        return content.size
    if content.kind == "still":
        header = picture_header(content.data.tobytes(), topic)
        return (header.width, header.height) if as_stored else header.size
    return None


def picture_of(content: Content, topic: str, reading: Reading, size: Size | None = None) -> tuple[Image, str]:
    """Picture and a mosaic's encoding of raw pixels or a still picture, which must be of `size` where that is given.

    16-bit pixels, of which the lower `bits` count, get their full scale. Raises: FrameError, one line.
    """
    try:
        if content.kind == "still":
            encoding = _mosaic_in(content.form)
            data = content.data.tobytes()
            image = decode_image(data, "compressed", encoding, size=size, as_stored=reading.as_stored)
            return full_scale(image, reading.bits), encoding
        found, step, order = content.size or (0, 0), content.step, content.order
        return unpack(content.data, content.form, found, step, order=order, bits=reading.bits, wanted=size)
    except FrameError as error:
        raise FrameError(error.reason, f"{topic}: {error}") from None


def _mosaic_in(form: str) -> str:
    """The encoding of a mosaic that was compressed as it is: `bayer_rggb8; png compressed`, no colours after it."""
    encoding, _, how = form.partition(";")
    raw = encoding.startswith("bayer") and encoding in ENCODINGS and how.rstrip().endswith("compressed")
    return encoding if raw else ""


def info_of(message: Message) -> CameraInfo:
    """The content of a CameraInfo or a CameraCalibration. Raises: InputError, one line, for one that is damaged."""
    read: Callable[[Message], CameraInfo] = _info_of_protobuf if message.encoding == "protobuf" else _info_of_ros
    try:
        return read(message)
    except UNREADABLE as error:
        why = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{message.topic}: damaged message: {why}") from None


def _info_of_ros(message: Message) -> CameraInfo:
    info = deserialized(message)
    d, k, r, p = (
        tuple(float(value) for value in getattr(info, name.upper() if message.encoding == "ros1" else name))
        for name in ("d", "k", "r", "p")
    )
    binning = max(int(info.binning_x), 1), max(int(info.binning_y), 1)
    roi = int(info.roi.x_offset), int(info.roi.y_offset), int(info.roi.width), int(info.roi.height)
    size, frame_id = (int(info.width), int(info.height)), str(info.header.frame_id)
    lens = str(info.distortion_model)
    return CameraInfo(message.topic, frame_id, size, lens, d=d, k=k, r=r, p=p, binning=binning, roi=roi)


def _info_of_protobuf(message: Message) -> CameraInfo:
    fields = protobuf.fields_of(message.data)
    d, k, r, p = (protobuf.doubles(fields, key) for key in (5, 6, 7, 8))
    if len(k) not in (0, 9) or len(r) not in (0, 9) or len(p) not in (0, 12):
        raise ValueError("a matrix of another size")
    size, frame_id = (protobuf.number(fields, 2), protobuf.number(fields, 3)), protobuf.content(fields, 9).decode()
    lens = protobuf.content(fields, 4).decode()
    return CameraInfo(message.topic, frame_id, size, lens, d=d, k=k, r=r, p=p)


def deserialized(message: Message) -> Any:  # noqa: ANN401  # classes made at run time from message definitions
    """The fields of a message of ROS 1 or ROS 2. Raises: one of `UNREADABLE` for one that is damaged."""
    store = typestore(message.encoding)
    if message.encoding == "ros1":
        return store.deserialize_ros1(message.data, message.type)
    return store.deserialize_cdr(message.data, message.type)


def stamp_ns_of(stamp: Any) -> int:  # noqa: ANN401
    """A stamp of ROS in ns."""
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)
