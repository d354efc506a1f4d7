"""Fixes to an autopilot: VISION_POSITION_ESTIMATE over UDP, as ArduPilot and ArduSub take it for external navigation.

The local frame is forward, right, down as the approaching vehicle sees the dock, its origin that of the dock: forward
is -z, right +x, down -y of the dock, which has to stand upright. The pose is that of the vehicle's body.
Source: mavlink.io, common.xml; ArduPilot, "Non-GPS Position Estimation".
"""

from __future__ import annotations

import math
import socket
import time

import numpy as np
from pymavlink.dialects.v20 import common

from lumidock.datatypes import Array, Detections, Fix, Frame, Unusable
from lumidock.geometry import se3_inverse, skew
from lumidock.streams.vehicle import Vehicle

R_LOCAL_DOCK = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_R_BODY_AERO = np.diag([1.0, -1.0, -1.0])  # of the body: REP-103 to aerospace axes
_SYSTEM, _HEARTBEAT_S = 1, 1.0
_UNKNOWN = float("nan")  # in the first entry of a covariance


class Mavlink:
    """Sends the valid fixes of frames that were measured, not predicted, and a heartbeat each second."""

    def __init__(self, host: str, port: int, vehicle: Vehicle) -> None:
        """Send to the UDP port `port` of `host`. Raises: OSError when there is no such host."""
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        self._socket = socket.socket(family, kind, protocol)
        self._socket.setblocking(False)
        self._socket.connect(address)
        component = common.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
        self._link = common.MAVLink(None, srcSystem=_SYSTEM, srcComponent=component)
        self._vehicle, self._resets, self._sent, self._beat = vehicle, 0, False, -math.inf

    def add(self, item: Frame | Detections | Unusable, fix: Fix, latency_us: int | None) -> None:
        """Send one fix, if it is valid and was measured in this frame. Raises: OSError when it cannot be sent."""
        del item, latency_us
        if fix.T_dock_cam is None or fix.status not in ("acquired", "tracking"):
            return
        if fix.status == "acquired" and self._sent:  # it may have jumped
            self._resets = (self._resets + 1) % 256
        self._send(estimate(self._link, fix, self._vehicle, self._resets))
        self._sent = True

    def tick(self) -> None:
        """Send a heartbeat when it is due."""
        if time.monotonic() - self._beat >= _HEARTBEAT_S:
            self._beat = time.monotonic()
            kind, autopilot = common.MAV_TYPE_ONBOARD_CONTROLLER, common.MAV_AUTOPILOT_INVALID
            self._send(self._link.heartbeat_encode(kind, autopilot, 0, 0, common.MAV_STATE_ACTIVE))

    def close(self) -> None:
        """Give the socket back."""
        self._socket.close()

    def _send(self, message: common.MAVLink_message) -> None:
        try:
            self._socket.send(message.pack(self._link))
        except ConnectionRefusedError:  # nobody listens yet; the kernel tells it of the datagram before
            pass
        except BlockingIOError:
            pass


def estimate(link: common.MAVLink, fix: Fix, vehicle: Vehicle, resets: int) -> common.MAVLink_message:
    """The message of a valid fix: position and roll, pitch, yaw of the body, and their covariance."""
    assert fix.T_dock_cam is not None
    T_dock_body = fix.T_dock_cam @ se3_inverse(vehicle.T_body_cam)
    position = R_LOCAL_DOCK @ T_dock_body[:3, 3]
    R = R_LOCAL_DOCK @ T_dock_body[:3, :3] @ _R_BODY_AERO
    roll, pitch, yaw = roll_pitch_yaw(R)
    covariance = [_UNKNOWN] + [0.0] * 20
    if fix.covariance is not None:
        lever_dock = T_dock_body[:3, 3] - fix.T_dock_cam[:3, 3]
        full = covariance_of_body(fix.covariance, lever_dock, pitch, yaw)
        covariance = [float(value) for value in full[np.triu_indices(6)]]
    numbers = (*map(float, position), roll, pitch, yaw)
    return link.vision_position_estimate_encode(max(fix.t_ns, 0) // 1000, *numbers, covariance, resets)


def roll_pitch_yaw(R: Array) -> tuple[float, float, float]:
    """Angles of R (3, 3) = Rz(yaw) Ry(pitch) Rx(roll), rad."""
    pitch = math.asin(max(-1.0, min(1.0, -float(R[2, 0]))))
    return math.atan2(float(R[2, 1]), float(R[2, 2])), pitch, math.atan2(float(R[1, 0]), float(R[0, 0]))


def covariance_of_body(covariance: Array, lever_dock: Array, pitch: float, yaw: float) -> Array:
    """Covariance (6, 6) of position (local FRD) and roll, pitch, yaw of the body.

    `covariance` (6, 6) is that of [t, w] of cam in dock axes, `lever_dock` (3,) m leads from cam to body. A rotation
    error w moves the body by w x lever; w = E (d_roll, d_pitch, d_yaw), which has no inverse where pitch is 90 degrees.
    """
    J = np.zeros((6, 6))
    J[:3, :3] = R_LOCAL_DOCK
    J[:3, 3:] = -R_LOCAL_DOCK @ skew(lever_dock)
    cy, sy, cp, sp = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    E = np.array([[cy * cp, -sy, 0.0], [sy * cp, cy, 0.0], [-sp, 0.0, 1.0]])
    J[3:, 3:] = np.linalg.pinv(E) @ R_LOCAL_DOCK
    return np.asarray(J @ covariance @ J.T)
