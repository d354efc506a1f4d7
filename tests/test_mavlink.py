"""Fixes to an autopilot: the pose of the body, its covariance, and what is not sent."""

import socket
import time

import numpy as np
from commandline import AHEAD
from conftest import assert_close, numeric_jacobian, transforms
from hypothesis import given, settings
from pymavlink.dialects.v20 import common
from scipy.spatial.transform import Rotation

from lumidock.datatypes import Fix, Frame
from lumidock.geometry import se3_exp, se3_inverse
from lumidock.streams.mavlink import R_LOCAL_DOCK, Mavlink, covariance_of_body, estimate, roll_pitch_yaw
from lumidock.streams.vehicle import Vehicle

IMAGE = np.zeros((8, 8), np.uint8)


def test_head_on_the_body_looks_along_the_local_frame():
    T_dock_cam = np.diag([1.0, -1, -1, 1])
    T_dock_cam[:3, 3] = [0.3, 0.2, 6.0]
    message = estimate(
        common.MAVLink(None), Fix("a", 7_000, "tracking", "rear", T_dock_cam=T_dock_cam), Vehicle(AHEAD), 3
    )
    # the camera is 0.8 m before and 0.1 m above the body; right of the dock's middle is right, above it is negative
    assert_close([message.x, message.y, message.z], [-6.8, 0.3, -0.1], atol=1e-12)
    assert_close([message.roll, message.pitch, message.yaw], [0, 0, 0], atol=1e-12)
    assert (message.usec, message.reset_counter, np.isnan(message.covariance[0])) == (7, 3, True)


@given(transforms(), transforms(1.0))
def test_position_and_angles_are_those_of_the_body(T_dock_cam, T_body_cam):
    fix = Fix("a", 0, "tracking", "rear", T_dock_cam=T_dock_cam)
    message = estimate(common.MAVLink(None), fix, Vehicle(T_body_cam), 0)
    T_dock_body = T_dock_cam @ np.linalg.inv(T_body_cam)
    assert_close([message.x, message.y, message.z], R_LOCAL_DOCK @ T_dock_body[:3, 3], atol=1e-9)
    wanted = R_LOCAL_DOCK @ T_dock_body[:3, :3] @ np.diag([1, -1, -1])
    found = Rotation.from_euler("ZYX", [message.yaw, message.pitch, message.roll]).as_matrix()
    assert_close(found, wanted, atol=1e-6)


@settings(max_examples=50)
@given(transforms(), transforms(1.0))
def test_the_covariance_is_carried_to_the_body(T_dock_cam, T_body_cam):
    def pose(error):
        moved = T_dock_cam.copy()
        moved[:3, 3] += error[:3]
        moved[:3, :3] = se3_exp(np.concatenate([np.zeros(3), error[3:]]))[:3, :3] @ T_dock_cam[:3, :3]
        T_dock_body = moved @ se3_inverse(T_body_cam)
        R = R_LOCAL_DOCK @ T_dock_body[:3, :3] @ np.diag([1, -1, -1])
        return np.concatenate([R_LOCAL_DOCK @ T_dock_body[:3, 3], roll_pitch_yaw(R)])

    _, pitch, yaw = pose(np.zeros(6))[3:]
    if abs(pitch) > 1.2:
        return  # angles are no coordinates there
    J = numeric_jacobian(pose, np.zeros(6))
    if np.abs(J).max() > 100:
        return  # an angle that turns over at pi between two steps
    A = np.arange(36.0).reshape(6, 6) / 36 + np.eye(6)
    lever_dock = (T_dock_cam @ se3_inverse(T_body_cam))[:3, 3] - T_dock_cam[:3, 3]
    found = covariance_of_body(A @ A.T, lever_dock, pitch, yaw)
    np.testing.assert_allclose(found, J @ A @ A.T @ J.T, rtol=1e-4, atol=1e-4)


def test_only_measured_valid_fixes_are_sent_and_jumps_counted(listener):
    link = Mavlink("127.0.0.1", listener.port, Vehicle(AHEAD))
    T = np.diag([1.0, -1, -1, 1])
    for status in ("acquired", "tracking", "coasting", "acquired", "tracking"):
        link.add(Frame("a", 5, IMAGE), Fix("a", 5, status, "rear", T_dock_cam=T), 7)
    link.add(Frame("a", 5, IMAGE), Fix("a", 5, "tracking", "rear", reason="protection"), 7)
    link.tick()
    link.tick()
    found = listener.read()
    assert [m.get_type() for m in found] == ["VISION_POSITION_ESTIMATE"] * 4 + ["HEARTBEAT"]
    assert [m.reset_counter for m in found[:4]] == [0, 0, 1, 1]
    assert {(m.get_srcSystem(), m.get_srcComponent()) for m in found} == {(1, 197)}
    link.close()


def test_nobody_listening_is_no_error():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as port:
        port.bind(("127.0.0.1", 0))
        free = port.getsockname()[1]
    link = Mavlink("127.0.0.1", free, Vehicle(AHEAD))
    for _ in range(5):
        link.add(Frame("a", 5, IMAGE), Fix("a", 5, "tracking", "rear", T_dock_cam=np.diag([1.0, -1, -1, 1])), 7)
        time.sleep(0.01)
    link.close()
