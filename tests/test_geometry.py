import numpy as np
import pytest
from conftest import (
    assert_close,
    numeric_jacobian,
    rotation_vectors,
    tangents,
    transform,
    transforms,
    vectors,
)
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from lumidock import geometry as g

HEAD_ON = np.diag([1.0, -1.0, -1.0])


def hat(xi):
    """The 4x4 matrix whose exponential is the transform of `xi`."""
    H = np.zeros((4, 4))
    H[:3, :3] = np.cross(np.eye(3), xi[3:])
    H[:3, 3] = xi[:3]
    return H


def left_jacobian(ad):
    """The integral of expm(s ad) over s = 0..1, from one exponential of a block matrix."""
    n = len(ad)
    return expm(np.block([[ad, np.eye(n)], [np.zeros((n, 2 * n))]]))[:n, n:]


def little_adjoint(xi):
    P, W = g.skew(xi[:3]), g.skew(xi[3:])
    return np.block([[W, P], [np.zeros((3, 3)), W]])


@given(vectors(10.0), vectors(10.0))
def test_skew_is_the_cross_product(v, w):
    assert_close(g.skew(v) @ w, np.cross(v, w), atol=1e-12)


@given(rotation_vectors())
def test_so3_exp_agrees_with_scipy(w):
    assert_close(g.so3_exp(w), Rotation.from_rotvec(w).as_matrix(), atol=1e-14)


@given(rotation_vectors())
def test_so3_log_inverts_exp(w):
    found = g.so3_log(g.so3_exp(w))
    turn = np.pi - np.linalg.norm(w) < 1e-7 and found @ w < 0  # half a turn either way is the same rotation
    assert_close(-found if turn else found, w, atol=1e-7 if turn else 1e-14)
    assert np.linalg.norm(found) <= np.pi + 1e-15


@given(rotation_vectors())
def test_so3_left_jacobian_is_the_integral_of_exp(w):
    assert_close(g.so3_left_jacobian(w), left_jacobian(g.skew(w)), atol=1e-13)


@given(tangents())
def test_se3_exp_agrees_with_expm(xi):
    assert_close(g.se3_exp(xi), expm(hat(xi)), atol=1e-12)


@given(transforms())
def test_se3_exp_inverts_log(T):
    assert_close(g.se3_exp(g.se3_log(T)), T, atol=1e-12)


@given(transforms())
def test_se3_inverse_agrees_with_linalg(T):
    assert_close(g.se3_inverse(T), np.linalg.inv(T), atol=1e-12)


@given(transforms(), tangents(limit_m=3.0))
def test_se3_adjoint_moves_exp_to_the_left(T, xi):
    assert_close(T @ g.se3_exp(xi), g.se3_exp(g.se3_adjoint(T) @ xi) @ T, atol=1e-10)


@given(tangents())
@example(np.array([30, -20, 10, 0.03, -0.02, 0.03]))  # just below and just above 0.05 rad, where the series ends
@example(np.array([30, -20, 10, 0.03, -0.03, 0.03]))
def test_se3_right_jacobian_is_the_integral_of_exp(xi):
    assert_close(g.se3_right_jacobian(xi), left_jacobian(little_adjoint(-xi)), atol=1e-11)


@given(tangents())
def test_se3_right_jacobian_agrees_with_differences(xi):
    def moved(d):
        return g.se3_log(g.se3_inverse(g.se3_exp(xi)) @ g.se3_exp(xi + d))

    assert_close(g.se3_right_jacobian(xi), numeric_jacobian(moved, np.zeros(6)), atol=1e-7)


@given(transforms(), st.lists(vectors(10.0), min_size=1, max_size=4).map(np.array))
def test_transform_points_is_the_matrix_product(T_a_b, p_b):
    homogeneous = np.column_stack([p_b, np.ones(len(p_b))])
    assert_close(g.transform_points(T_a_b, p_b), (T_a_b @ homogeneous.T).T[:, :3], atol=1e-12)


@given(rotation_vectors(), st.floats(1e-6, 1e6))
def test_quaternions_agree_with_scipy_at_any_length(w, length):
    rotation = Rotation.from_rotvec(w)
    quat = g.quat_xyzw_from_rotation(rotation.as_matrix())
    assert quat[3] >= 0
    assert_close(min(quat, -quat, key=lambda q: np.abs(q - rotation.as_quat()).max()), rotation.as_quat(), atol=1e-14)
    assert_close(g.rotation_from_quat_xyzw(-length * quat), rotation.as_matrix(), atol=1e-14)


@given(transforms())
def test_pose_from_quat_puts_a_transform_together(T):
    assert_close(g.pose_from_quat(T[:3, 3], g.quat_xyzw_from_rotation(T[:3, :3])), T, atol=1e-14)


@pytest.mark.parametrize("quat", [[0, 0, 0, 0], [0, 0, 0, 1e-13], [np.nan, 0, 0, 1], [0, np.inf, 0, 1]])
def test_a_quaternion_without_a_direction_is_refused(quat):
    with pytest.raises(ValueError, match="quaternion"):
        g.pose_from_quat(np.zeros(3), np.array(quat, float))


@given(transforms(limit_m=5.0), st.integers(0, 2**32 - 1))
def test_covariance_in_dock_axes_transports_to_first_order(T_dock_cam, seed):
    root = np.random.default_rng(seed).normal(size=(6, 6))
    R_dock_cam = T_dock_cam[:3, :3]

    def error_in_dock_axes(xi):
        T_est = T_dock_cam @ g.se3_exp(xi)
        w = Rotation.from_matrix(T_est[:3, :3] @ R_dock_cam.T).as_rotvec()
        return np.concatenate([T_est[:3, 3] - T_dock_cam[:3, 3], w])

    A = numeric_jacobian(error_in_dock_axes, np.zeros(6))
    assert_close(g.covariance_in_dock_axes(root @ root.T, R_dock_cam), A @ root @ root.T @ A.T, atol=1e-6)


@pytest.mark.parametrize(
    ("position", "bearing_x", "bearing_y", "distance"),
    [
        ([0, 0, 10], 0, 0, 10),
        (
            [1, 0, 1],
            -np.pi / 4,
            0,
            np.sqrt(2),
        ),  # the camera stands to the right: the dock appears on the left
        ([0, 1, 1], 0, np.pi / 4, np.sqrt(2)),  # the camera stands above: the dock appears below
        ([0, 0, -2], np.pi, np.pi, 2),  # the dock's entrance lies behind
    ],
)
def test_bearing_and_range_of_a_head_on_camera(position, bearing_x, bearing_y, distance):
    T_dock_cam = transform(position, Rotation.from_matrix(HEAD_ON).as_rotvec())
    found = np.array(g.bearing_and_range(T_dock_cam))
    assert_close(np.cos(found[:2]), np.cos([bearing_x, bearing_y]), atol=1e-12)
    assert_close(np.sin(found[:2]), np.sin([bearing_x, bearing_y]), atol=1e-12)
    assert_close(found[2], distance)
