from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import assert_close, numeric_jacobian, transform
from scipy.spatial.transform import Rotation

from lumidock.camera import Camera, load_camera
from lumidock.evaluation.claims import pose_error
from lumidock.geometry import se3_exp
from lumidock.pose import project_lights, project_lights_with_jacobian, reprojection_rms_px, solve_pose, sqpnp
from lumidock.station import load_station

ROOT = Path(__file__).parents[1]
K = np.array([[1400.0, 0.0, 1000.0], [0.0, 1400.0, 800.0], [0.0, 0.0, 1.0]])
PLANE = np.array([[-1, 0.6, 0], [1, 0.5, 0], [0.9, -0.6, 0], [-0.8, -0.5, 0], [0.1, 0.9, 0]])
DEEP = np.vstack([PLANE[:3], [[-0.6, 0.4, -5], [0.6, 0.5, -5], [0.0, -0.7, -5]]])


@pytest.fixture(
    params=[
        ("plumb_bob", [-0.28, 0.12, 0.001, -0.002, -0.02]),
        ("rational_polynomial", [0.8, -0.1, 0.001, -0.001, 0.01, 1.1, 0.1, 0.02]),
        ("equidistant", [0.05, -0.04, 0.01, -0.002]),
    ],
    ids=lambda lens: lens[0],
)
def camera(request):
    model, distortion = request.param
    return Camera(2000, 1600, K, model, np.array(distortion))


@pytest.fixture
def T_dock_cam(rng):
    """A camera 3-25 m before the dock, up to 0.3 rad off its axis."""
    z = rng.uniform(3, 25)
    R_dock_cam = np.diag([1.0, -1.0, -1.0]) @ Rotation.from_rotvec(rng.uniform(-0.17, 0.17, 3)).as_matrix()
    return transform([*rng.uniform(-0.1 * z, 0.1 * z, 2), z], Rotation.from_matrix(R_dock_cam).as_rotvec())


def test_lights_project_as_in_opencv(camera, T_dock_cam):
    T_cam_dock = np.linalg.inv(T_dock_cam)
    rvec = Rotation.from_matrix(T_cam_dock[:3, :3]).as_rotvec()
    project = cv2.fisheye.projectPoints if camera.model == "equidistant" else cv2.projectPoints
    uv, _ = project(DEEP[:, None], rvec, T_cam_dock[:3, 3], K, camera.distortion)
    assert_close(project_lights(camera, T_dock_cam, DEEP), uv[:, 0], atol=1e-9)


def test_pose_jacobian_agrees_with_differences(camera, T_dock_cam):
    uv, J_uv_pose = project_lights_with_jacobian(camera, T_dock_cam, DEEP)
    expected = numeric_jacobian(lambda xi: project_lights(camera, T_dock_cam @ se3_exp(xi), DEEP), np.zeros(6))
    assert_close(uv, project_lights(camera, T_dock_cam, DEEP))
    assert_close(J_uv_pose, expected, atol=1e-4)


def test_no_lights_give_no_rows(camera):
    uv, J_uv_pose = project_lights_with_jacobian(camera, np.eye(4), np.empty((0, 3)))
    assert (uv.shape, J_uv_pose.shape) == ((0, 2), (0, 2, 6))


@pytest.mark.parametrize("p_dock", [PLANE, PLANE[:4], DEEP, np.repeat(DEEP, 2, axis=0)[::2]], ids=lambda p: p.shape[0])
def test_sqpnp_recovers_the_pose(p_dock, camera, T_dock_cam):
    assert_close(sqpnp(camera, p_dock, project_lights(camera, T_dock_cam, p_dock)), T_dock_cam, atol=1e-5)


def test_sqpnp_with_noise_agrees_with_opencv(T_dock_cam, rng):
    camera = Camera(2000, 1600, K)
    uv = project_lights(camera, T_dock_cam, DEEP) + rng.normal(0, 0.5, (len(DEEP), 2))
    _, rvec, tvec = cv2.solvePnP(DEEP, uv, K, None, flags=cv2.SOLVEPNP_SQPNP)
    T_cam_dock = transform(tvec.ravel(), rvec.ravel())
    assert_close(sqpnp(camera, DEEP, uv), np.linalg.inv(T_cam_dock), atol=1e-5)


@pytest.mark.parametrize(
    "p_dock",
    [np.zeros((0, 3)), PLANE[:2], np.outer(np.linspace(-1, 1, 5), [1, 0.5, 0]), np.tile(PLANE[:1], (4, 1))],
    ids=["none", "two", "in a line", "at one place"],
)
def test_sqpnp_has_no_pose_for_too_little(p_dock, camera, T_dock_cam):
    assert sqpnp(camera, p_dock, project_lights(camera, T_dock_cam, p_dock)) is None


def test_sqpnp_has_no_pose_for_pixels_without_a_ray_ahead(T_dock_cam):
    fisheye = Camera(2000, 1600, K, "equidistant", np.zeros(4))
    uv = project_lights(fisheye, T_dock_cam, PLANE)
    assert sqpnp(fisheye, PLANE, uv) is not None
    for spoilt in (
        [np.nan, 0],
        [1000 + 1.6 * 1400, 800],
        [1000 + 3.2 * 1400, 800],
    ):  # none, 1.6 rad, 3.2 rad off axis
        assert sqpnp(fisheye, PLANE, np.vstack([spoilt, uv[1:]])) is None


def test_sqpnp_has_no_pose_with_a_light_behind_the_camera():
    camera = Camera(2000, 1600, K)
    R_dock_cam = Rotation.from_euler("xy", [175, 10], degrees=True)
    T_dock_cam = transform([0.1, -0.2, -3], R_dock_cam.as_rotvec())
    p_cam = (DEEP - T_dock_cam[:3, 3]) @ T_dock_cam[:3, :3]
    assert (p_cam[:, 2] < 0).any()
    uv = 1400 * p_cam[:, :2] / p_cam[:, 2:] + K[:2, 2]  # as a pinhole without a front would see them
    assert sqpnp(camera, DEEP, uv) is None


def test_reprojection_rms_is_in_pixels(camera, T_dock_cam):
    uv = project_lights(camera, T_dock_cam, DEEP)
    assert reprojection_rms_px(camera, T_dock_cam, DEEP, uv) == 0.0
    assert_close(reprojection_rms_px(camera, T_dock_cam, DEEP, uv + np.array([3, -4])), 5.0)
    one_off = uv + 6.0 * np.eye(len(DEEP))[:, :1] * [1, 0]
    assert_close(reprojection_rms_px(camera, T_dock_cam, DEEP, one_off), 6.0 / np.sqrt(len(DEEP)))


STATION = load_station(ROOT / "src" / "lumidock" / "stations" / "cage-2x2x5.yaml")
CAMERA = load_camera(ROOT / "src" / "lumidock" / "cameras" / "imx264-60deg.yaml")
FRONT, ALL = np.arange(7), np.arange(13)


def drawn(rng, T_dock_cam, lights, *, pixels=0.5):
    """Pixels of the lights of a dock that is not where the survey says, through a lens that is not as calibrated."""
    p_dock = STATION.p_dock + rng.normal(0, STATION.sigma_light_m, (13, 3))
    p_dock += rng.normal(0, STATION.sigma_layer_m, (2, 3))[STATION.layer]
    uv = project_lights(CAMERA, T_dock_cam, p_dock[lights])
    uv = (uv - CAMERA.center_px) * (1 + rng.normal(0, STATION.sigma_focal)) + CAMERA.center_px
    return uv + rng.normal(0, STATION.sigma_center_px, 2) + rng.normal(0, pixels, uv.shape)


def head_on(rng, z, tilt=0.1):
    """A camera about head-on at `z`."""
    turn = Rotation.from_rotvec(rng.uniform(-tilt, tilt, 3)).as_matrix()
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.diag([1.0, -1.0, -1.0]) @ turn, [*rng.uniform(-0.05, 0.05, 2) * z, z]
    return T


@pytest.mark.parametrize(("z", "lights"), [(3.0, FRONT), (6.0, ALL), (15.0, ALL), (-2.0, np.arange(7, 13))])
def test_covariances_of_solutions_hold_with_survey_and_calibration_errors_in(z, lights, rng):
    squares = []
    for _ in range(200):
        T_dock_cam = head_on(rng, z)
        best = solve_pose(STATION, CAMERA, lights, drawn(rng, T_dock_cam, lights))[0]
        e = pose_error(best.T_dock_cam, T_dock_cam)
        squares.append(e @ np.linalg.solve(best.covariance, e))
    assert 5.3 < np.mean(squares) < 6.8  # chi-square, 6 dof, mean of 200: 99 % lie here


def test_exact_pixels_give_back_the_pose(rng):
    for z in (3.0, 9.0, 18.0):
        T_dock_cam = head_on(rng, z)
        found = solve_pose(STATION, CAMERA, ALL, project_lights(CAMERA, T_dock_cam, STATION.p_dock))
        assert len(found) == 1
        assert_close(found[0].T_dock_cam, T_dock_cam, atol=1e-6)
        assert found[0].chi2 < 1e-6


def test_a_plane_far_away_has_two_poses_and_two_layers_have_one(rng):
    two = 0
    for _ in range(40):
        T_dock_cam = head_on(rng, 26.0, 0.3)
        uv = drawn(rng, T_dock_cam, ALL)
        found = solve_pose(STATION, CAMERA, FRONT, uv[:7])
        assert [one.chi2 for one in found] == sorted(one.chi2 for one in found)
        two += len(found) == 2
        assert len(solve_pose(STATION, CAMERA, ALL, uv)) == 1
    assert two > 8


def test_lights_that_leave_the_pose_open_give_none():
    line = STATION.p_dock[[0, 0, 0]] + np.array([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]])
    crooked = replace(STATION, p_dock=np.concatenate([line, STATION.p_dock[3:]]))
    uv = project_lights(CAMERA, head_on(np.random.default_rng(0), 8.0), line)
    assert solve_pose(crooked, CAMERA, np.arange(3), uv) == ()
    assert solve_pose(STATION, CAMERA, np.arange(2), uv[:2]) == ()
