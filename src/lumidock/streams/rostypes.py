"""Message types of ROS 2 and how they are serialized, without ROS."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from lumidock.datatypes import Array
from lumidock.geometry import quat_xyzw_from_rotation

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
float64 exposure_factor      # by what exposure times gain should be multiplied; below 1 too bright
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
PREFIX, DOCK_POSE = "/lumidock", "/detected_dock_pose"  # where nav2's docking server looks
TYPES = {
    f"{PREFIX}/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    f"{PREFIX}/body_pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    f"{PREFIX}/velocity": "geometry_msgs/msg/TwistWithCovarianceStamped",
    f"{PREFIX}/odometry": "nav_msgs/msg/Odometry",
    DOCK_POSE: "geometry_msgs/msg/PoseStamped",
    f"{PREFIX}/status": "lumidock_msgs/msg/Status",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    f"{PREFIX}/camera_info": "sensor_msgs/msg/CameraInfo",
    f"{PREFIX}/image/compressed": "sensor_msgs/msg/CompressedImage",
    f"{PREFIX}/annotations": "foxglove_msgs/msg/ImageAnnotations",
}
# m², rad² and their squares per second, of what is not known: larger than any dock, and not the zero that would claim
# certainty or the negative value that only some readers know
UNKNOWN_VARIANCE = 1e6


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


def dds_name(message_type: str) -> str:
    """The name of a type in DDS: geometry_msgs::msg::dds_::Pose_."""
    package, _, name = message_type.split("/")
    return f"{package}::msg::dds_::{name}_"


def make(message_type: str, *fields: Any, **named: Any) -> Any:  # noqa: ANN401  # classes made at run time
    """A message by its type and fields."""
    return typestore().types[message_type](*fields, **named)


def serialized(topic: str, t_ns: int, message: Any) -> Serialized:  # noqa: ANN401
    """A message of the type that its topic has."""
    return Serialized(topic, t_ns, bytes(typestore().serialize_cdr(message, TYPES[topic])))


def time_of(t_ns: int) -> Any:  # noqa: ANN401
    """A stamp; there is no time before zero."""
    return make("builtin_interfaces/msg/Time", *divmod(max(t_ns, 0), 10**9))


def header(t_ns: int, frame: str) -> Any:  # noqa: ANN401
    """A header of a stamp and a frame."""
    return make("std_msgs/msg/Header", time_of(t_ns), frame)


def pose_of(T_parent_child: Array) -> Any:  # noqa: ANN401
    """A geometry_msgs/Pose."""
    position = make("geometry_msgs/msg/Point", *map(float, T_parent_child[:3, 3]))
    return make("geometry_msgs/msg/Pose", position, _quaternion(T_parent_child))


def pose_with_covariance(T_parent_child: Array, covariance: Array | None) -> Any:  # noqa: ANN401
    """A geometry_msgs/PoseWithCovariance; the variances of one whose `covariance` (6, 6) is not known are huge."""
    return make("geometry_msgs/msg/PoseWithCovariance", pose_of(T_parent_child), known(covariance))


def known(covariance: Array | None) -> Array:
    """The 36 numbers of a covariance (6, 6), or those of one that is not known."""
    full = np.eye(6) * UNKNOWN_VARIANCE if covariance is None else np.asarray(covariance, float)
    return full.reshape(36)


def transform_of(parent: str, child: str, t_ns: int, T_parent_child: Array) -> Any:  # noqa: ANN401
    """A geometry_msgs/TransformStamped."""
    translation = make("geometry_msgs/msg/Vector3", *map(float, T_parent_child[:3, 3]))
    transform = make("geometry_msgs/msg/Transform", translation, _quaternion(T_parent_child))
    return make("geometry_msgs/msg/TransformStamped", header(t_ns, parent), child, transform)


def _quaternion(T: Array) -> Any:  # noqa: ANN401
    return make("geometry_msgs/msg/Quaternion", *map(float, quat_xyzw_from_rotation(T[:3, :3])))
