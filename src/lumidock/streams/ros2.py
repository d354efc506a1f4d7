"""A fix as ROS 2 messages, serialized without ROS: pose, transforms, camera, picture, annotations and status.

Conventions: REP-103 and REP-105; the camera's frame is optical; every stamp is the time of exposure; the covariance is
row by row in x, y, z and rotations about the fixed axes of the dock; quaternions are x, y, z, w.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from lumidock.camera import Camera
from lumidock.datatypes import Array, Detections, Fix, Frame, Unusable, Velocity
from lumidock.geometry import quat_xyzw_from_rotation, se3_inverse
from lumidock.streams.jpeg import jpeg_of
from lumidock.streams.vehicle import Vehicle

STATUS_MSG = """\
# What lumidock says of one frame. Numbers that it does not know are NaN.
std_msgs/Header header       # time of exposure; frame_id is the dock's
bool valid                   # the full pose may be used
bool guide                   # bearing and range may be used
string status                # none, acquired, tracking, coasting
string stage                 # search, front, transition, rear
string reason                # why there is no valid pose; empty when there is
uint32 n_seen                # detections in the frame
uint32 n_used                # detections behind the pose
float64 pl_lateral_m         # what hypot(ex, ey) exceeds once in 1e6 frames
float64 pl_axial_m           # the same of |ez|
float64 pl_angle_rad         # the same of the total rotation error
float64 bearing_x_rad        # atan2(x, z) of the dock's origin in the camera
float64 bearing_y_rad        # atan2(y, z)
float64 range_m              # its distance
float64 pl_bearing_rad       # what the bearing's error exceeds once in 1e6 frames
float64 pl_range_m           # the same of the range
float64 latency_s            # from the frame to the fix, decoding excluded
"""
_DEFINITIONS = {
    "lumidock_msgs/msg/Status": STATUS_MSG,
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
    "foxglove_msgs/msg/Point2": "float64 x\nfloat64 y\n",
    "foxglove_msgs/msg/Color": "float64 r\nfloat64 g\nfloat64 b\nfloat64 a\n",
    "foxglove_msgs/msg/CircleAnnotation": (
        "builtin_interfaces/Time timestamp\nfoxglove_msgs/Point2 position\nfloat64 diameter\nfloat64 thickness\n"
        "foxglove_msgs/Color fill_color\nfoxglove_msgs/Color outline_color\n"
    ),
    "foxglove_msgs/msg/PointsAnnotation": (
        "uint8 UNKNOWN=0\nuint8 POINTS=1\nuint8 LINE_LOOP=2\nuint8 LINE_STRIP=3\nuint8 LINE_LIST=4\n"
        "builtin_interfaces/Time timestamp\nuint8 type\nfoxglove_msgs/Point2[] points\n"
        "foxglove_msgs/Color outline_color\nfoxglove_msgs/Color[] outline_colors\nfoxglove_msgs/Color fill_color\n"
        "float64 thickness\n"
    ),
    "foxglove_msgs/msg/TextAnnotation": (
        "builtin_interfaces/Time timestamp\nfoxglove_msgs/Point2 position\nstring text\nfloat64 font_size\n"
        "foxglove_msgs/Color text_color\nfoxglove_msgs/Color background_color\n"
    ),
    "foxglove_msgs/msg/ImageAnnotations": (
        "foxglove_msgs/CircleAnnotation[] circles\nfoxglove_msgs/PointsAnnotation[] points\n"
        "foxglove_msgs/TextAnnotation[] texts\n"
    ),
}
PREFIX = "/lumidock"
TYPES = {
    f"{PREFIX}/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    f"{PREFIX}/velocity": "geometry_msgs/msg/TwistWithCovarianceStamped",
    f"{PREFIX}/status": "lumidock_msgs/msg/Status",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    f"{PREFIX}/camera_info": "sensor_msgs/msg/CameraInfo",
    f"{PREFIX}/image/compressed": "sensor_msgs/msg/CompressedImage",
    f"{PREFIX}/annotations": "foxglove_msgs/msg/ImageAnnotations",
}
_NAMED, _SPURIOUS, _CLEAR = (0.3, 1.0, 0.4, 1.0), (1.0, 0.25, 0.25, 1.0), (0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Serialized:
    """A message as CDR bytes, with its topic and its stamp."""

    topic: str
    t_ns: int
    data: bytes


@cache
def typestore() -> Typestore:
    """The definitions of ROS 2 and those of lumidock and Foxglove."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in _DEFINITIONS.items():
        if name not in store.fielddefs:
            store.register(get_types_from_msg(text, name))
    return store


def definition(message_type: str) -> str:
    """The text that stands for a type in an MCAP file."""
    return str(typestore().generate_msgdef(message_type, ros_version=2)[0])


def type_hash(message_type: str) -> str:
    """RIHS01 hash of a type, which ROS 2 matches types by. Source: REP-2016."""
    return str(typestore().hash_rihs01(message_type))


def messages(
    item: Frame | Detections | Unusable,
    fix: Fix,
    latency_us: int | None,
    camera: Camera,
    vehicle: Vehicle | None,
    light_ids: tuple[str, ...],
    *,
    picture: bool = True,
) -> Iterator[Serialized]:
    """The messages of one frame: a pose and its transform only where that is valid, a velocity where it is known."""
    frames = _Frames.of(vehicle)
    if item.t_ns is None:
        return
    t_ns = item.t_ns
    yield _serialized(f"{PREFIX}/status", t_ns, _status(fix, t_ns, latency_us, frames))
    if fix.T_dock_cam is not None:
        yield _serialized(f"{PREFIX}/pose", t_ns, _pose_stamped(fix, t_ns, frames))
        transform = _transform(frames.dock, frames.camera, t_ns, fix.T_dock_cam)
        yield _serialized("/tf", t_ns, _make("tf2_msgs/msg/TFMessage", [transform]))
    if fix.velocity is not None:
        yield _serialized(f"{PREFIX}/velocity", t_ns, _twist_stamped(fix.velocity, t_ns, frames))
    if picture and isinstance(item, Frame):
        if camera.port is None:  # CameraInfo has no words for a port
            yield _serialized(f"{PREFIX}/camera_info", t_ns, _camera_info(camera, t_ns, frames))
        yield _serialized(f"{PREFIX}/image/compressed", t_ns, _compressed(item, t_ns, frames))
        yield _serialized(f"{PREFIX}/annotations", t_ns, _annotations(fix, t_ns, light_ids))


def mounting(vehicle: Vehicle, t_ns: int) -> Serialized:
    """The transform camera -> body, which does not change."""
    T_cam_body = se3_inverse(vehicle.T_body_cam)
    transform = _transform(vehicle.camera_frame, vehicle.body_frame, t_ns, T_cam_body)
    return _serialized("/tf_static", t_ns, _make("tf2_msgs/msg/TFMessage", [transform]))


@dataclass(frozen=True, slots=True)
class _Frames:
    dock: str
    camera: str

    @classmethod
    def of(cls, vehicle: Vehicle | None) -> _Frames:
        return cls("dock", "camera_optical") if vehicle is None else cls(vehicle.dock_frame, vehicle.camera_frame)


def _make(message_type: str, *fields: Any, **named: Any) -> Any:  # noqa: ANN401  # classes made at run time
    return typestore().types[message_type](*fields, **named)


def _serialized(topic: str, t_ns: int, message: Any) -> Serialized:  # noqa: ANN401
    return Serialized(topic, t_ns, bytes(typestore().serialize_cdr(message, TYPES[topic])))


def _time(t_ns: int) -> Any:  # noqa: ANN401
    return _make("builtin_interfaces/msg/Time", *divmod(max(t_ns, 0), 10**9))  # there is no time before zero


def _header(t_ns: int, frame: str) -> Any:  # noqa: ANN401
    return _make("std_msgs/msg/Header", _time(t_ns), frame)


def _status(fix: Fix, t_ns: int, latency_us: int | None, frames: _Frames) -> Any:  # noqa: ANN401
    levels, guide, nan = fix.protection, fix.guide, float("nan")
    numbers = (levels.lateral_m, levels.axial_m, levels.angle_rad) if levels else (nan,) * 3
    bearing = (
        (guide.bearing_x_rad, guide.bearing_y_rad, guide.range_m, guide.pl_bearing_rad, guide.pl_range_m)
        if guide
        else (nan,) * 5
    )
    latency_s = nan if latency_us is None else latency_us * 1e-6
    words = (fix.valid, guide is not None, fix.status, fix.stage, fix.reason, fix.n_seen, fix.n_used)
    return _make(
        "lumidock_msgs/msg/Status", _header(t_ns, frames.dock), *words, *map(float, (*numbers, *bearing)), latency_s
    )


def _pose_stamped(fix: Fix, t_ns: int, frames: _Frames) -> Any:  # noqa: ANN401
    assert fix.T_dock_cam is not None
    covariance = np.full(36, 0.0) if fix.covariance is None else np.asarray(fix.covariance, float).reshape(36)
    position = _make("geometry_msgs/msg/Point", *map(float, fix.T_dock_cam[:3, 3]))
    pose = _make("geometry_msgs/msg/Pose", position, _quaternion(fix.T_dock_cam))
    with_covariance = _make("geometry_msgs/msg/PoseWithCovariance", pose, covariance)
    return _make("geometry_msgs/msg/PoseWithCovarianceStamped", _header(t_ns, frames.dock), with_covariance)


def _twist_stamped(velocity: Velocity, t_ns: int, frames: _Frames) -> Any:  # noqa: ANN401
    linear, angular = (
        _make("geometry_msgs/msg/Vector3", *map(float, vector))
        for vector in (velocity.linear_m_s, velocity.angular_rad_s)
    )
    twist = _make("geometry_msgs/msg/Twist", linear, angular)
    with_covariance = _make("geometry_msgs/msg/TwistWithCovariance", twist, velocity.covariance.reshape(36))
    return _make("geometry_msgs/msg/TwistWithCovarianceStamped", _header(t_ns, frames.camera), with_covariance)


def _quaternion(T: Array) -> Any:  # noqa: ANN401
    return _make("geometry_msgs/msg/Quaternion", *map(float, quat_xyzw_from_rotation(T[:3, :3])))


def _transform(parent: str, child: str, t_ns: int, T_parent_child: Array) -> Any:  # noqa: ANN401
    translation = _make("geometry_msgs/msg/Vector3", *map(float, T_parent_child[:3, 3]))
    transform = _make("geometry_msgs/msg/Transform", translation, _quaternion(T_parent_child))
    return _make("geometry_msgs/msg/TransformStamped", _header(t_ns, parent), child, transform)


def _camera_info(camera: Camera, t_ns: int, frames: _Frames) -> Any:  # noqa: ANN401
    P = np.hstack([camera.K, np.zeros((3, 1))]).reshape(12)
    roi = _make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
    matrices = {"d": np.asarray(camera.distortion, float), "k": camera.K.reshape(9), "r": np.eye(3).reshape(9), "p": P}
    return _make(
        "sensor_msgs/msg/CameraInfo",
        header=_header(t_ns, frames.camera),
        height=camera.height,
        width=camera.width,
        distortion_model=camera.model,
        binning_x=0,
        binning_y=0,
        roi=roi,
        **matrices,
    )


def _compressed(frame: Frame, t_ns: int, frames: _Frames) -> Any:  # noqa: ANN401
    data = np.frombuffer(jpeg_of(frame), np.uint8)
    return _make("sensor_msgs/msg/CompressedImage", _header(t_ns, frames.camera), "jpeg", data)


def _annotations(fix: Fix, t_ns: int, light_ids: tuple[str, ...]) -> Any:  # noqa: ANN401
    """A ring around each detection, and the name of its light. Foxglove counts pixels from the corner of the first."""
    circles, texts, time = [], [], _time(t_ns)
    green, red, clear = (_make("foxglove_msgs/msg/Color", *rgba) for rgba in (_NAMED, _SPURIOUS, _CLEAR))
    detections = fix.match.detections if fix.match else Detections.from_uv(fix.frame, t_ns, np.empty((0, 2)))
    named = fix.match.light if fix.match else np.empty(0, np.int64)
    for (u, v), radius, light in zip(detections.uv + 0.5, detections.radius_px, named, strict=True):
        diameter = 2.0 * max(8.0, 1.6 * float(np.nan_to_num(radius)) + 4.0)
        color = green if light >= 0 else red
        at = _make("foxglove_msgs/msg/Point2", float(u), float(v))
        ring = (time, at, diameter, 2.0, clear, color)
        circles.append(_make("foxglove_msgs/msg/CircleAnnotation", *ring))
        if light >= 0:
            beside = _make("foxglove_msgs/msg/Point2", float(u) + diameter / 2.0 + 2.0, float(v))
            words = (time, beside, light_ids[light], 16.0, color, clear)
            texts.append(_make("foxglove_msgs/msg/TextAnnotation", *words))
    return _make("foxglove_msgs/msg/ImageAnnotations", circles, [], texts)
