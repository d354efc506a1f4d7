"""A fix as ROS 2 messages: poses and odometry, transforms, status and diagnostics, and what is to be seen of the frame.

Conventions: REP-103 and REP-105; the camera's frame is optical; every stamp is the time of exposure; the covariance is
row by row in x, y, z and rotations about the fixed axes of the dock; quaternions are x, y, z, w.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from lumidock.camera import Camera
from lumidock.datatypes import Array, Detections, Fix, Frame, Unusable
from lumidock.geometry import se3_inverse, skew
from lumidock.go_no_go import WORDS, Verdict, Watch
from lumidock.streams import rospicture
from lumidock.streams.rostypes import (
    DOCK_POSE,
    PREFIX,
    Serialized,
    header,
    known,
    make,
    pose_of,
    pose_with_covariance,
    serialized,
    transform_of,
)
from lumidock.streams.vehicle import Vehicle
from lumidock.streams.velocity import body_velocity

_SLOWLY_NS = 10**9  # between two diagnostics, and two of the same mounting
_MEASURED = ("acquired", "tracking")  # fixes that a filter may take; a predicted one holds nothing new
# of the dock as a robot that drives into it sees it: x into the dock, y left, z up (REP-103)
_T_DOCK_ENTRY = np.array([[0.0, -1, 0, 0], [0, 0, 1, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])
_BROKEN = ("bad_frame", "bad_stamp", "frozen", "calibration", "survey")  # reasons that somebody has to look into
_OK, _WARN, _ERROR = range(3)  # levels of diagnostic_msgs/DiagnosticStatus
_VERDICTS: dict[Verdict, int] = {"go": _OK, "hold": _WARN, "abort": _ERROR}


class Publication:
    """Makes the messages of one frame after the other."""

    def __init__(
        self, camera: Camera, vehicle: Vehicle | None, light_ids: tuple[str, ...], watch: Watch | None = None
    ) -> None:
        """Messages of one camera; with a `watch` the diagnostics say go or no-go too."""
        self._camera, self._vehicle, self._light_ids, self._watch = camera, vehicle, light_ids, watch
        self._dock, self._cam, self._way = "dock", "camera_optical", "camera_to_dock"
        if vehicle is not None:
            self._dock, self._cam, self._way = vehicle.dock_frame, vehicle.camera_frame, vehicle.transform
        self._slow_ns: int | None = None

    def messages(
        self, item: Frame | Detections | Unusable, fix: Fix, latency_us: int | None, *, picture: bool = True
    ) -> Iterator[Serialized]:
        """The messages of one frame: a pose and its transform where that is valid, a velocity where it is known."""
        if item.t_ns is None:
            return
        t_ns = item.t_ns
        self._watch = self._watch.after(fix) if self._watch else None
        yield serialized(f"{PREFIX}/status", t_ns, self._status(fix, t_ns, latency_us))
        if self._slow_ns is None or abs(t_ns - self._slow_ns) >= _SLOWLY_NS:
            self._slow_ns = t_ns
            yield from self._slowly(fix, t_ns)
        if fix.T_dock_cam is not None:
            yield from self._pose(fix, fix.T_dock_cam, t_ns)
        if fix.velocity is not None:
            covariance = known(fix.velocity.covariance)
            twist = _twist(fix.velocity.linear_m_s, fix.velocity.angular_rad_s, covariance)
            stamped = make("geometry_msgs/msg/TwistWithCovarianceStamped", header(t_ns, self._cam), twist)
            yield serialized(f"{PREFIX}/velocity", t_ns, stamped)
        if picture and isinstance(item, Frame):
            if self._camera.port is None:  # CameraInfo has no words for a port
                yield serialized(f"{PREFIX}/camera_info", t_ns, rospicture.camera_info(self._camera, t_ns, self._cam))
            yield serialized(f"{PREFIX}/image/compressed", t_ns, rospicture.compressed(item, t_ns, self._cam))
            yield serialized(f"{PREFIX}/annotations", t_ns, rospicture.rings(fix, t_ns, self._light_ids))

    def _pose(self, fix: Fix, T_dock_cam: Array, t_ns: int) -> Iterator[Serialized]:
        with_covariance = pose_with_covariance(T_dock_cam, fix.covariance)
        stamped = make("geometry_msgs/msg/PoseWithCovarianceStamped", header(t_ns, self._dock), with_covariance)
        yield serialized(f"{PREFIX}/pose", t_ns, stamped)
        if self._way == "camera_to_dock":
            yield _transforms("/tf", t_ns, transform_of(self._cam, self._dock, t_ns, se3_inverse(T_dock_cam)))
        elif self._way == "dock_to_camera":
            yield _transforms("/tf", t_ns, transform_of(self._dock, self._cam, t_ns, T_dock_cam))
        if fix.status in _MEASURED:
            dock = pose_of(se3_inverse(T_dock_cam) @ _T_DOCK_ENTRY)
            yield serialized(DOCK_POSE, t_ns, make("geometry_msgs/msg/PoseStamped", header(t_ns, self._cam), dock))
            if self._vehicle is not None:
                yield from self._body(fix, T_dock_cam, t_ns, self._vehicle)

    def _body(self, fix: Fix, T_dock_cam: Array, t_ns: int, vehicle: Vehicle) -> Iterator[Serialized]:
        """Pose and motion of the vehicle's body in the dock, as filters of others take them."""
        T_dock_body = T_dock_cam @ se3_inverse(vehicle.T_body_cam)
        covariance = None
        if fix.covariance is not None:
            J = np.eye(6)
            J[:3, 3:] = -skew(T_dock_body[:3, 3] - T_dock_cam[:3, 3])  # a rotation error moves what is away from cam
            covariance = J @ fix.covariance @ J.T
        where, head = pose_with_covariance(T_dock_body, covariance), header(t_ns, self._dock)
        yield serialized(f"{PREFIX}/body_pose", t_ns, make("geometry_msgs/msg/PoseWithCovarianceStamped", head, where))
        odometry = make("nav_msgs/msg/Odometry", head, vehicle.body_frame, where, _twist_of_body(fix, vehicle))
        yield serialized(f"{PREFIX}/odometry", t_ns, odometry)

    def _slowly(self, fix: Fix, t_ns: int) -> Iterator[Serialized]:
        """What does not have to come with every frame: diagnostics, and the mounting where nobody else has it."""
        yield serialized("/diagnostics", t_ns, self._diagnostics(fix, t_ns))
        vehicle = self._vehicle
        if vehicle is None or not vehicle.mounting_transform:
            return
        if self._way == "dock_to_camera":  # the camera's parent is the dock, so that the body has to hang on the camera
            T_cam_body = se3_inverse(vehicle.T_body_cam)
            yield _transforms("/tf_static", t_ns, transform_of(self._cam, vehicle.body_frame, t_ns, T_cam_body))
        else:
            mounting = transform_of(vehicle.body_frame, self._cam, t_ns, vehicle.T_body_cam)
            yield _transforms("/tf_static", t_ns, mounting)

    def _status(self, fix: Fix, t_ns: int, latency_us: int | None) -> Any:  # noqa: ANN401  # classes made at run time
        levels, guide, nan = fix.protection, fix.guide, float("nan")
        numbers = (levels.lateral_m, levels.axial_m, levels.angle_rad) if levels else (nan,) * 3
        bearing = (
            (guide.bearing_x_rad, guide.bearing_y_rad, guide.range_m, guide.pl_bearing_rad, guide.pl_range_m)
            if guide
            else (nan,) * 5
        )
        latency_s = nan if latency_us is None else latency_us * 1e-6
        words = (fix.valid, guide is not None, fix.status, fix.stage, fix.reason, fix.n_seen, fix.n_used)
        floats = map(float, (*numbers, *bearing))
        return make(
            "lumidock_msgs/msg/Status", header(t_ns, self._dock), *words, *floats, latency_s, fix.exposure_factor
        )

    def _diagnostics(self, fix: Fix, t_ns: int) -> Any:  # noqa: ANN401
        level, text = _WARN, fix.reason.replace("_", " ")
        if fix.valid:
            level, text = _OK, "pose"
        elif fix.reason in _BROKEN:
            level = _ERROR
        elif fix.guide is not None:
            text = f"bearing and range only: {text}"
        words = {"status": fix.status, "stage": fix.stage, "reason": fix.reason}
        words |= {"detections": str(fix.n_seen), "lights used": str(fix.n_used)}
        told = [_diagnostic(level, "lumidock: fix", text, words)]
        if self._watch:
            advice = self._watch.advise(t_ns)
            words = {"verdict": advice.verdict, "word": advice.word}
            told.append(_diagnostic(_VERDICTS[advice.verdict], "lumidock: go / no-go", WORDS[advice.word], words))
        return make("diagnostic_msgs/msg/DiagnosticArray", header(t_ns, self._dock), told)


def _diagnostic(level: int, name: str, text: str, words: Mapping[str, str]) -> Any:  # noqa: ANN401
    values = [make("diagnostic_msgs/msg/KeyValue", key, value) for key, value in words.items()]
    return make("diagnostic_msgs/msg/DiagnosticStatus", level, name, text, "lumidock", values)


def _transforms(topic: str, t_ns: int, transform: Any) -> Serialized:  # noqa: ANN401
    return serialized(topic, t_ns, make("tf2_msgs/msg/TFMessage", [transform]))


def _twist(linear_m_s: Array, angular_rad_s: Array, covariance: Array) -> Any:  # noqa: ANN401
    vectors = (make("geometry_msgs/msg/Vector3", *map(float, part)) for part in (linear_m_s, angular_rad_s))
    return make("geometry_msgs/msg/TwistWithCovariance", make("geometry_msgs/msg/Twist", *vectors), covariance)


def _twist_of_body(fix: Fix, vehicle: Vehicle) -> Any:  # noqa: ANN401
    """Motion in axes of the body; zero with huge variances where it is not known."""
    velocity = body_velocity(fix, vehicle)
    if velocity is None:
        return _twist(np.zeros(3), np.zeros(3), known(None))
    return _twist(velocity.linear_m_s, velocity.angular_rad_s, known(velocity.covariance))
