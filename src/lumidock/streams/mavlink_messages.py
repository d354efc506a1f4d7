"""A fix as MAVLink messages, for ArduPilot: where the body is, where the dock is, and what there is to say of it.

The local frame is forward, right, down as the approaching vehicle sees the dock, its origin that of the dock: forward
is -z, right +x, down -y of the dock, which has to stand upright. With a heading it is north, east, down instead.
Source: mavlink.io, common.xml; ArduPilot, `handle_odometry` and `handle_vision_position_estimate` of GCS_Common.cpp,
and AC_PrecLand_MAVLink.cpp.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from pymavlink.dialects.v20 import common

from lumidock.datatypes import Array, Fix, Guide
from lumidock.geometry import quat_xyzw_from_rotation, se3_inverse, skew
from lumidock.streams.vehicle import Vehicle
from lumidock.streams.velocity import BodyVelocity, body_velocity

R_LOCAL_DOCK = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_R_AERO_BODY = np.diag([1.0, -1.0, -1.0])  # of the body: REP-103 to aerospace axes
_R_BODY_AERO = _R_AERO_BODY.T
_UNKNOWN = float("nan")  # in the first entry of a covariance
_TEXT_BYTES = 50  # of one STATUSTEXT
_NAMES = (b"dock_brg_x", b"dock_brg_y", b"dock_range")  # at most ten bytes


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """The camera's mounting on the vehicle, and the axes of the local frame: `R_local_dock` (3, 3)."""

    vehicle: Vehicle
    R_local_dock: Array

    @classmethod
    def of(cls, vehicle: Vehicle, heading_rad: float = 0.0) -> Frames:
        """Local axes turned so that a vehicle that faces the dock head-on has this heading; 0: the dock's own."""
        c, s = math.cos(heading_rad), math.sin(heading_rad)
        return cls(vehicle, np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ R_LOCAL_DOCK)


def estimate(link: common.MAVLink, fix: Fix, frames: Frames, resets: int) -> common.MAVLink_message:
    """The pose of the body: ODOMETRY where its velocity is known, else VISION_POSITION_ESTIMATE.

    ArduPilot takes the velocity of every ODOMETRY, so that one without would say that the vehicle stands.
    """
    assert fix.T_dock_cam is not None
    T_dock_body = fix.T_dock_cam @ se3_inverse(frames.vehicle.T_body_cam)
    position = frames.R_local_dock @ T_dock_body[:3, 3]
    R = frames.R_local_dock @ T_dock_body[:3, :3] @ _R_BODY_AERO
    angles = roll_pitch_yaw(R)
    covariance = _pose_covariance(fix, T_dock_body, frames.R_local_dock, angles)
    place, usec = tuple(map(float, position)), _microseconds(fix)
    velocity = body_velocity(fix, frames.vehicle)
    if velocity is None:
        return link.vision_position_estimate_encode(usec, *place, *angles, covariance, resets)
    x, y, z, w = map(float, quat_xyzw_from_rotation(R))
    motion, motion_covariance = _motion(velocity)
    axes = common.MAV_FRAME_LOCAL_FRD, common.MAV_FRAME_BODY_FRD
    kind = common.MAV_ESTIMATOR_TYPE_VISION
    numbers = (usec, *axes, *place, (w, x, y, z), *motion, covariance, motion_covariance)
    return link.odometry_encode(*numbers, resets, kind)


def _microseconds(fix: Fix) -> int:
    return max(fix.t_ns, 0) // 1000


def _pose_covariance(
    fix: Fix, T_dock_body: Array, R_local_dock: Array, angles: tuple[float, float, float]
) -> list[float]:
    if fix.covariance is None or fix.T_dock_cam is None:
        return [_UNKNOWN] + [0.0] * 20
    lever_dock = T_dock_body[:3, 3] - fix.T_dock_cam[:3, 3]
    full = covariance_of_body(fix.covariance, lever_dock, angles[1], angles[2], R_local_dock)
    return [float(value) for value in full[np.triu_indices(6)]]


def _motion(velocity: BodyVelocity) -> tuple[tuple[float, ...], list[float]]:
    """Velocity and turn rate in aerospace axes, and the upper triangle of their covariance."""
    turn = np.kron(np.eye(2), _R_AERO_BODY)
    motion = turn @ np.concatenate([velocity.linear_m_s, velocity.angular_rad_s])
    covariance = turn @ velocity.covariance @ turn.T
    return tuple(map(float, motion)), [float(value) for value in covariance[np.triu_indices(6)]]


def landing_target(link: common.MAVLink, fix: Fix, guide: Guide, frames: Frames) -> common.MAVLink_message:
    """Where the dock's origin is from the body, in body axes; angles are those in the camera."""
    T_body_cam = frames.vehicle.T_body_cam
    p_body = T_body_cam[:3, :3] @ dock_in_cam(guide) + T_body_cam[:3, 3]
    place = tuple(map(float, _R_AERO_BODY @ p_body))
    distance = math.hypot(*place)  # ArduPilot divides the place by it to have a direction
    angles = guide.bearing_x_rad, guide.bearing_y_rad
    no_size, no_orientation = (0.0, 0.0), (0.0,) * 4
    frame, kind = common.MAV_FRAME_BODY_FRD, common.LANDING_TARGET_TYPE_LIGHT_BEACON
    numbers = (_microseconds(fix), 0, frame, *angles, distance, *no_size, *place, no_orientation)
    return link.landing_target_encode(*numbers, kind, position_valid=1)


def dock_in_cam(guide: Guide) -> Array:
    """The dock's origin (3,) m in cam by bearings and range."""
    tan_x, tan_y = math.tan(guide.bearing_x_rad), math.tan(guide.bearing_y_rad)
    ahead = math.copysign(1.0, math.cos(guide.bearing_x_rad))
    direction = ahead * np.array([tan_x, tan_y, 1.0])
    return np.asarray(guide.range_m * direction / np.linalg.norm(direction))


def guide_values(link: common.MAVLink, guide: Guide, boot_ms: int) -> Iterator[common.MAVLink_message]:
    """Bearings, rad, and range, m, by name, as a ground station plots them."""
    for name, value in zip(_NAMES, (guide.bearing_x_rad, guide.bearing_y_rad, guide.range_m), strict=True):
        yield link.named_value_float_encode(boot_ms, name, float(value))


def status_text(link: common.MAVLink, state: str, *, warning: bool) -> common.MAVLink_message:
    """A line for the operator, cut to what one message holds."""
    severity = common.MAV_SEVERITY_WARNING if warning else common.MAV_SEVERITY_INFO
    return link.statustext_encode(severity, state.encode()[:_TEXT_BYTES])


def roll_pitch_yaw(R: Array) -> tuple[float, float, float]:
    """Angles of R (3, 3) = Rz(yaw) Ry(pitch) Rx(roll), rad."""
    pitch = math.asin(max(-1.0, min(1.0, -float(R[2, 0]))))
    return math.atan2(float(R[2, 1]), float(R[2, 2])), pitch, math.atan2(float(R[1, 0]), float(R[0, 0]))


def covariance_of_body(
    covariance: Array, lever_dock: Array, pitch: float, yaw: float, R_local_dock: Array = R_LOCAL_DOCK
) -> Array:
    """Covariance (6, 6) of position (local axes) and roll, pitch, yaw of the body.

    `covariance` (6, 6) is that of [t, w] of cam in dock axes, `lever_dock` (3,) m leads from cam to body. A rotation
    error w moves the body by w x lever; w = E (d_roll, d_pitch, d_yaw), which has no inverse where pitch is 90 degrees.
    """
    J = np.zeros((6, 6))
    J[:3, :3] = R_local_dock
    J[:3, 3:] = -R_local_dock @ skew(lever_dock)
    cy, sy, cp, sp = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    E = np.array([[cy * cp, -sy, 0.0], [sy * cp, cy, 0.0], [-sp, 0.0, 1.0]])
    J[3:, 3:] = np.linalg.pinv(E) @ R_local_dock
    return np.asarray(J @ covariance @ J.T)
