"""A fix as ROS 2 messages: frames with one parent, covariances that are known, poses as filters and nav2 take them."""

from itertools import count
from pathlib import Path

import numpy as np
import pytest
from commandline import AHEAD
from conftest import assert_close, numeric_jacobian, transforms
from hypothesis import given, settings
from scipy.spatial.transform import Rotation
from test_run import CAMERA

from lumidock.datatypes import Fix, Frame, Velocity
from lumidock.geometry import se3_exp, se3_inverse
from lumidock.go_no_go import Passage, Watch
from lumidock.streams.ros2 import Publication
from lumidock.streams.rostypes import TYPES, UNKNOWN_VARIANCE, typestore
from lumidock.streams.vehicle import Vehicle

HEAD_ON = np.diag([1.0, -1, -1, 1])
HEAD_ON[:3, 3] = [0.3, 0.2, 6.0]
SECOND = 10**9


def published(fix, vehicle=None, publication=None):
    """The messages of one frame by topic."""
    publication = publication or Publication(CAMERA, vehicle, ("A",))
    frame = Frame("a", fix.t_ns, np.zeros((256, 320), np.uint8))
    found = {}
    for message in publication.messages(frame, fix, 900, picture=False):
        found.setdefault(message.topic, []).append(typestore().deserialize_cdr(message.data, TYPES[message.topic]))
    return found


def fix_of(T_dock_cam, status="tracking", **more):
    return Fix("a", 5 * SECOND, status, "rear", T_dock_cam=T_dock_cam, **more)


def matrix(position, rotation):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([rotation.x, rotation.y, rotation.z, rotation.w]).as_matrix()
    T[:3, 3] = [position.x, position.y, position.z]
    return T


@pytest.mark.parametrize("way", ["camera_to_dock", "dock_to_camera", "none"])
@pytest.mark.parametrize("mounting", [True, False])
def test_no_frame_has_two_parents(way, mounting):
    vehicle = Vehicle(AHEAD, transform=way, mounting_transform=mounting)
    found = published(fix_of(HEAD_ON), vehicle)
    told = [t for topic in ("/tf", "/tf_static") for m in found.get(topic, []) for t in m.transforms]
    urdf = [("base_link", "camera_link"), ("camera_link", "camera_optical")]
    urdf = [] if mounting or way == "dock_to_camera" else urdf
    edges = [(t.header.frame_id, t.child_frame_id) for t in told] + urdf
    children = [child for _, child in edges]
    assert len(children) == len(set(children))
    assert len(told) == (way != "none") + mounting
    paths = {("", "base_link"): np.eye(4)}
    for t in told:
        paths[t.header.frame_id, t.child_frame_id] = matrix(t.transform.translation, t.transform.rotation)
    if way == "camera_to_dock":
        assert_close(paths["camera_optical", "dock"], se3_inverse(HEAD_ON), atol=1e-12)
    if way == "dock_to_camera":
        assert_close(paths["dock", "camera_optical"], HEAD_ON, atol=1e-12)
    if mounting and way == "dock_to_camera":
        assert_close(paths["camera_optical", "base_link"], se3_inverse(AHEAD), atol=1e-12)
    elif mounting:
        assert_close(paths["base_link", "camera_optical"], AHEAD, atol=1e-12)


@settings(max_examples=30)
@given(transforms(), transforms(1.0))
def test_the_body_is_where_the_camera_and_its_mounting_say_with_the_covariance_carried_along(T_dock_cam, T_body_cam):
    A = np.arange(36.0).reshape(6, 6) / 36 + np.eye(6)
    found = published(fix_of(T_dock_cam, covariance=A @ A.T), Vehicle(T_body_cam))
    pose = found["/lumidock/body_pose"][0].pose
    T_dock_body = T_dock_cam @ np.linalg.inv(T_body_cam)
    assert_close(matrix(pose.pose.position, pose.pose.orientation), T_dock_body, atol=1e-7)

    def body(error):
        moved = T_dock_cam.copy()
        moved[:3, 3] += error[:3]
        moved[:3, :3] = se3_exp(np.concatenate([np.zeros(3), error[3:]]))[:3, :3] @ T_dock_cam[:3, :3]
        T = moved @ np.linalg.inv(T_body_cam)
        return np.concatenate([T[:3, 3], Rotation.from_matrix(T[:3, :3] @ T_dock_body[:3, :3].T).as_rotvec()])

    J = numeric_jacobian(body, np.zeros(6))
    assert_close(np.reshape(pose.covariance, (6, 6)), J @ A @ A.T @ J.T, atol=1e-4)
    odometry = found["/lumidock/odometry"][0]
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("dock", "base_link")
    assert list(odometry.pose.covariance) == list(pose.covariance)


def test_what_is_not_known_has_no_zero_covariance():
    found = published(fix_of(HEAD_ON), Vehicle(AHEAD))
    covariances = [
        found["/lumidock/pose"][0].pose.covariance,
        found["/lumidock/body_pose"][0].pose.covariance,
        found["/lumidock/odometry"][0].pose.covariance,
        found["/lumidock/odometry"][0].twist.covariance,
    ]
    for covariance in covariances:
        assert (np.diag(np.reshape(covariance, (6, 6))) == UNKNOWN_VARIANCE).all()


def test_a_known_velocity_is_the_twist_of_the_body():
    velocity = Velocity(np.array([0.0, 0.0, 0.5]), np.array([0.0, 0.2, 0.0]), np.eye(6) * 0.01)
    fix = fix_of(HEAD_ON, velocity=velocity)
    twist = published(fix, Vehicle(AHEAD))["/lumidock/odometry"][0].twist
    # the camera turns right about its y, which is down, so the body turns by -0.2 rad/s about up; its origin, 0.8 m
    # behind the camera, swings left
    assert_close([twist.twist.linear.x, twist.twist.linear.y, twist.twist.linear.z], [0.5, 0.16, 0.0], atol=1e-9)
    assert_close([twist.twist.angular.x, twist.twist.angular.y, twist.twist.angular.z], [0, 0, -0.2], atol=1e-9)
    variances = np.diag(np.reshape(twist.covariance, (6, 6)))
    assert (variances > 0).all()
    assert variances[3] == pytest.approx(0.01)


def test_the_dock_of_nav2_lies_ahead_with_x_into_it():
    (pose,) = published(fix_of(HEAD_ON), Vehicle(AHEAD))["/detected_dock_pose"]
    assert pose.header.frame_id == "camera_optical"
    T_body_entry = AHEAD @ matrix(pose.pose.position, pose.pose.orientation)
    wanted = np.eye(4)
    wanted[:3, 3] = [6.8, 0.3, -0.1]  # 0.8 m before the body, 0.3 m right of the dock's middle, 0.2 m above it
    assert_close(T_body_entry, wanted, atol=1e-9)


@pytest.mark.parametrize("status", ["coasting", "none"])
def test_what_is_predicted_only_is_no_measurement_for_a_filter(status):
    found = published(fix_of(HEAD_ON, status=status), Vehicle(AHEAD))
    assert not {"/lumidock/body_pose", "/lumidock/odometry", "/detected_dock_pose"} & set(found)


def test_diagnostics_come_once_a_second_and_tell_what_is_wrong():
    publication, levels = Publication(CAMERA, None, ("A",)), []
    fixes = [("none", "no_lights"), ("tracking", ""), ("none", "bad_frame")]
    for k, t_ns in zip(range(30), count(0, SECOND // 10), strict=False):
        status, reason = fixes[k // 10]
        fix = Fix("a", t_ns, status, "front", T_dock_cam=None if reason else HEAD_ON, reason=reason)
        told = published(fix, publication=publication).get("/diagnostics", [])
        levels += [(message.status[0].level, message.status[0].message) for message in told]
    assert levels == [(1, "no lights"), (0, "pose"), (2, "bad frame")]


def test_diagnostics_say_go_or_no_go_where_a_watch_is_kept():
    passage = Passage(opening_m=1.0, vehicle_m=0.3)
    beside = HEAD_ON.copy()
    beside[:3, 3] = 1.5, 0.0, 2.5
    said = []
    for T_dock_cam in (HEAD_ON, beside):
        fix = Fix("a", SECOND, "tracking", "front", T_dock_cam=T_dock_cam)
        publication = Publication(CAMERA, None, ("A",), Watch(passage))
        (message,) = published(fix, publication=publication)["/diagnostics"]
        told = message.status[1]
        said.append((told.name, told.level, {one.key: one.value for one in told.values}["verdict"]))
    assert said == [("lumidock: go / no-go", 0, "go"), ("lumidock: go / no-go", 1, "hold")]


def test_the_page_lists_every_topic():
    page = (Path(__file__).parents[1] / "docs" / "ros.md").read_text()
    for topic, kind in TYPES.items():
        assert f"`{topic}`" in page
        line = next(line for line in page.splitlines() if f"`{topic}`" in line)
        assert kind.rpartition("/")[2] in line or "displays" in line
