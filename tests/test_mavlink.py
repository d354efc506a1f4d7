"""Fixes to an autopilot: the pose of the body, its covariance, the dock for guidance, and what is not sent."""

import hashlib
import math
import re
import socket
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from commandline import AHEAD
from conftest import assert_close, numeric_jacobian, transforms
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common
from scipy.spatial.transform import Rotation

from lumidock.app.serve import Done, Taken, Worker
from lumidock.datatypes import Fix, Frame, Guide, Velocity
from lumidock.errors import InputError
from lumidock.geometry import bearing_and_range, se3_exp, se3_inverse
from lumidock.streams.mavlink import Identity, Mavlink, ResetCounter, signing_key
from lumidock.streams.mavlink_messages import (
    R_LOCAL_DOCK,
    Frames,
    covariance_of_body,
    dock_in_cam,
    estimate,
    landing_target,
    roll_pitch_yaw,
)
from lumidock.streams.vehicle import Vehicle

IMAGE = np.zeros((8, 8), np.uint8)


def test_head_on_the_body_looks_along_the_local_frame():
    T_dock_cam = np.diag([1.0, -1, -1, 1])
    T_dock_cam[:3, 3] = [0.3, 0.2, 6.0]
    message = estimate(
        common.MAVLink(None), Fix("a", 7_000, "tracking", "rear", T_dock_cam=T_dock_cam), Frames.of(Vehicle(AHEAD)), 3
    )
    # the camera is 0.8 m before and 0.1 m above the body; right of the dock's middle is right, above it is negative
    assert_close([message.x, message.y, message.z], [-6.8, 0.3, -0.1], atol=1e-12)
    assert_close([message.roll, message.pitch, message.yaw], [0, 0, 0], atol=1e-12)
    assert (message.usec, message.reset_counter, np.isnan(message.covariance[0])) == (7, 3, True)


@given(transforms(), transforms(1.0))
def test_position_and_angles_are_those_of_the_body(T_dock_cam, T_body_cam):
    fix = Fix("a", 0, "tracking", "rear", T_dock_cam=T_dock_cam)
    message = estimate(common.MAVLink(None), fix, Frames.of(Vehicle(T_body_cam)), 0)
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


HEAD_ON = np.diag([1.0, -1, -1, 1])
HEAD_ON[:3, 3] = [0.3, 0.2, 6.0]
GUIDE = Guide(*bearing_and_range(HEAD_ON), 0.01, 0.1)


def fix_of(status, *, pose=True, guide=None):
    reason = "" if pose else "protection"
    return Fix("a", 5_000, status, "rear", T_dock_cam=HEAD_ON if pose else None, reason=reason, guide=guide)


def of_type(messages, name):
    return [message for message in messages if message.get_type() == name]


def test_only_measured_fixes_are_sent_and_a_heartbeat(listener):
    link = Mavlink("127.0.0.1", listener.port, Vehicle(AHEAD), Identity(7, 191))
    for status in ("acquired", "tracking", "coasting"):
        link.add(Frame("a", 5, IMAGE), fix_of(status, guide=GUIDE), 7)
    link.add(Frame("a", 5, IMAGE), fix_of("tracking", pose=False), 7)
    link.tick()
    link.tick()
    found = listener.read()
    assert len(of_type(found, "VISION_POSITION_ESTIMATE")) == len(of_type(found, "LANDING_TARGET")) == 2
    assert len(of_type(found, "HEARTBEAT")) == 1
    assert {(m.get_srcSystem(), m.get_srcComponent()) for m in found} == {(7, 191)}
    assert [m.get_seq() for m in found] == list(range(len(found)))
    link.close()


STATUSES = st.sampled_from(["none", "acquired", "tracking", "coasting"])


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(STATUSES, st.booleans(), st.booleans()), max_size=12))
def test_the_reset_counter_rises_with_each_acquisition_whatever_is_sent_of_it(steps):
    """Each step: status, whether the pose is valid, and whether the fix is too old to be sent."""
    counter, wanted, anew, sent = ResetCounter(), 0, False, False
    for status, pose, stale in steps:
        counter.see(fix_of(status, pose=pose))
        anew |= status == "acquired"
        if pose and not stale and status in ("acquired", "tracking"):
            wanted += anew and sent
            anew, sent = False, True
            assert counter.of_pose() == wanted


def test_an_acquisition_that_only_guides_or_was_dropped_raises_the_counter(listener):
    link = Mavlink("127.0.0.1", listener.port, Vehicle(AHEAD))
    link.add(Frame("a", 5, IMAGE), fix_of("acquired"), 7)
    link.add(Frame("a", 5, IMAGE), fix_of("acquired", pose=False, guide=GUIDE), 7)
    link.add(Frame("a", 5, IMAGE), fix_of("tracking"), 7)
    link.skip(fix_of("acquired"))
    link.add(Frame("a", 5, IMAGE), fix_of("tracking"), 7)
    assert [m.reset_counter for m in of_type(listener.read(), "VISION_POSITION_ESTIMATE")] == [0, 1, 2]
    link.close()


def test_a_sink_takes_notice_of_what_was_dropped_or_stale():
    told, added = [], []
    sink = SimpleNamespace(
        add=lambda _item, fix, _us: added.append(fix.status), skip=lambda f: told.append(f.status), close=lambda: None
    )
    worker = Worker("w", lambda: sink, queue=1, stale_s=0.2)
    now = time.monotonic()
    for status, at_s in (("acquired", now), ("none", now - 9.0)):
        worker.offer(Done(Taken(Frame("a", 5, IMAGE), at_s), fix_of(status), 1))
    worker.start()
    while not worker.stale:
        time.sleep(0.001)
    worker.offer(Done(Taken(Frame("a", 5, IMAGE), time.monotonic()), fix_of("tracking"), 1))
    worker.finish()
    assert (told, added) == (["acquired", "none"], ["tracking"])


@given(transforms(), transforms(1.0))
def test_the_landing_target_is_the_docks_origin_seen_from_the_body(T_dock_cam, T_body_cam):
    bearing_x, bearing_y, range_m = bearing_and_range(T_dock_cam)
    p_cam = se3_inverse(T_dock_cam)[:3, 3]
    if range_m < 0.01 or abs(p_cam[2]) < 1e-3 * range_m:
        return  # beside the camera bearings say nothing
    guide = Guide(bearing_x, bearing_y, range_m, 0.01, 0.1)
    assert_close(dock_in_cam(guide), p_cam, atol=1e-6 * range_m / (abs(p_cam[2]) / range_m))
    fix = Fix("a", 5_000, "tracking", "rear", reason="protection", guide=guide)
    message = landing_target(common.MAVLink(None), fix, guide, Frames.of(Vehicle(T_body_cam)))
    place = np.array([message.x, message.y, message.z])
    wanted = np.diag([1, -1, -1]) @ (T_body_cam @ [*p_cam, 1.0])[:3]
    assert_close(place, wanted, atol=1e-5 * range_m / (abs(p_cam[2]) / range_m))
    assert math.isclose(message.distance, np.linalg.norm(place), rel_tol=1e-9)
    assert (message.frame, message.position_valid, message.type) == (common.MAV_FRAME_BODY_FRD, 1, 0)


def moving(T_dock_cam, velocity):
    return Fix("a", 5_000, "tracking", "rear", T_dock_cam=T_dock_cam, velocity=velocity)


def velocity_of(linear, angular, sigma=0.1):
    return Velocity(np.asarray(linear), np.asarray(angular), np.eye(6) * sigma**2)


@given(transforms(), transforms(1.0))
def test_a_known_velocity_goes_as_odometry_in_body_axes(T_dock_cam, T_body_cam):
    """Against the difference of two poses of the body, the camera having moved as its velocity says."""
    v_cam, w_cam, step_s = np.array([0.1, -0.2, 0.7]), np.array([0.02, 0.3, -0.1]), 1e-5
    frames = Frames.of(Vehicle(T_body_cam))
    message = estimate(common.MAVLink(None), moving(T_dock_cam, velocity_of(v_cam, w_cam)), frames, 4)
    assert (message.get_type(), message.reset_counter) == ("ODOMETRY", 4)
    assert (message.frame_id, message.child_frame_id) == (common.MAV_FRAME_LOCAL_FRD, common.MAV_FRAME_BODY_FRD)
    T_later = T_dock_cam @ se3_exp(np.concatenate([v_cam, w_cam]) * step_s)
    before, after = (T @ se3_inverse(T_body_cam) for T in (T_dock_cam, T_later))
    w, *xyz = message.q
    R_local_body = Rotation.from_quat([*xyz, w]).as_matrix()  # ArduPilot turns the velocity by it
    v_local = R_LOCAL_DOCK @ (after - before)[:3, 3] / step_s
    assert_close(R_local_body @ [message.vx, message.vy, message.vz], v_local, atol=1e-4)
    turned = Rotation.from_matrix(before[:3, :3].T @ after[:3, :3]).as_rotvec() / step_s
    assert_close([message.rollspeed, message.pitchspeed, message.yawspeed], turned * [1, -1, -1], atol=1e-4)
    lever = np.linalg.norm(T_body_cam[:3, 3])
    variances = np.array(message.velocity_covariance)[[0, 6, 11]]
    assert math.isclose(variances.sum(), 0.01 * (3 + 2 * lever**2), rel_tol=1e-6)


@pytest.mark.parametrize("velocity", [None, velocity_of(np.full(3, np.nan), np.zeros(3))])
def test_without_a_velocity_no_odometry_says_that_the_vehicle_stands(velocity):
    message = estimate(common.MAVLink(None), moving(HEAD_ON, velocity), Frames.of(Vehicle(AHEAD)), 0)
    assert message.get_type() == "VISION_POSITION_ESTIMATE"


def test_with_a_heading_the_local_frame_is_north_east_down():
    fix = Fix("a", 0, "tracking", "rear", T_dock_cam=HEAD_ON)
    message = estimate(common.MAVLink(None), fix, Frames.of(Vehicle(AHEAD), math.radians(90.0)), 0)
    # head-on the vehicle looks east; it is 6.8 m west of the dock, and 0.3 m right of its middle, which is south
    assert_close([message.x, message.y, message.z], [-0.3, -6.8, -0.1], atol=1e-6)
    assert_close([message.roll, message.pitch, message.yaw], [0, 0, math.pi / 2], atol=1e-6)


def test_a_change_of_state_is_told_once_and_not_too_often(listener, monkeypatch):
    clock = SimpleNamespace(s=100.0)
    monkeypatch.setattr("lumidock.streams.mavlink.time.monotonic", lambda: clock.s)
    link = Mavlink("127.0.0.1", listener.port, Vehicle(AHEAD))
    for k in range(40):  # flickers twenty times a second
        clock.s = 100.0 + 0.05 * k
        link.add(Frame("a", 5, IMAGE), fix_of("tracking", pose=k % 2 == 0), 7)
    clock.s += 5.0
    link.tick()
    link.tick()
    texts = [m.text for m in of_type(listener.read(), "STATUSTEXT")]
    assert texts == ["lumidock: pose, rear", "lumidock: no fix: protection"]
    link.close()


def test_named_values_are_bearings_and_range(listener):
    link = Mavlink("127.0.0.1", listener.port, Vehicle(AHEAD))
    link.add(Frame("a", 5, IMAGE), fix_of("tracking", pose=False, guide=GUIDE), 7)
    link.add(Frame("a", 5, IMAGE), fix_of("tracking", pose=False, guide=GUIDE), 7)
    found = {m.name: m.value for m in of_type(listener.read(), "NAMED_VALUE_FLOAT")}
    assert_close(list(found.values()), [GUIDE.bearing_x_rad, GUIDE.bearing_y_rad, GUIDE.range_m], atol=1e-6)
    assert list(found) == ["dock_brg_x", "dock_brg_y", "dock_range"]
    link.close()


def test_signed_messages_are_accepted_with_the_key_alone(tmp_path):
    (tmp_path / "key").write_text("correct horse battery\nand more\n")
    key = signing_key(tmp_path / "key")
    assert key == hashlib.sha256(b"correct horse battery").digest()
    assert "horse" not in repr(Identity(key=key))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as port:
        port.bind(("127.0.0.1", 0))
        port.settimeout(2)
        link = Mavlink("127.0.0.1", port.getsockname()[1], Vehicle(AHEAD), Identity(key=key))
        link.tick()
        link.add(Frame("a", 5, IMAGE), fix_of("tracking"), 7)
        received = [port.recv(4096) for _ in range(3)]
        link.close()
    reader = common.MAVLink(None)
    reader.signing.secret_key = key
    for content in received:
        reader.parse_buffer(content)
    assert reader.signing.goodsig_count == 3
    reader.signing.secret_key = bytes(32)
    with pytest.raises(common.MAVError, match="Invalid signature"):
        reader.parse_buffer(received[0])


@pytest.mark.parametrize("text", ["", "short\n", "\nlong enough but not in the first line"])
def test_a_key_file_without_a_passphrase_is_refused_without_showing_it(tmp_path, text):
    (tmp_path / "key").write_text(text)
    with pytest.raises(InputError, match="passphrase") as found:
        signing_key(tmp_path / "key")
    assert text.strip() == "" or text.strip() not in str(found.value)


def test_nobody_listening_is_no_error():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as port:
        port.bind(("127.0.0.1", 0))
        free = port.getsockname()[1]
    link = Mavlink("127.0.0.1", free, Vehicle(AHEAD))
    for _ in range(5):
        link.add(Frame("a", 5, IMAGE), Fix("a", 5, "tracking", "rear", T_dock_cam=np.diag([1.0, -1, -1, 1])), 7)
        time.sleep(0.01)
    link.close()


DOCS = Path(__file__).parents[1] / "docs"


@pytest.mark.parametrize("name", ["ardusub.param", "rover.param"])
def test_parameter_files_hold_the_parameters_that_the_page_explains(name):
    lines = [line for line in (DOCS / name).read_text().splitlines() if not line.startswith("#")]
    parameters = dict(line.split(",") for line in lines)
    assert len(parameters) == len(lines)
    assert all(math.isfinite(float(value)) for value in parameters.values())
    explained = set(re.findall(r"`([A-Z0-9]+_[A-Z0-9_]+)`", (DOCS / "ardupilot.md").read_text()))
    assert set(parameters) <= explained
    assert 0 <= float(parameters["VISO_DELAY_MS"]) <= 250  # ArduPilot's limits
