"""The flat port: against Snell's law traced by bisection, against finite differences, and the kernels against numpy."""

from dataclasses import replace

import numpy as np
import pytest
from bench.shipped import shipped_station
from hypothesis import given, settings
from hypothesis import strategies as st

from lumidock._kernels import lens as kernel
from lumidock.camera import Camera, load_camera, save_camera
from lumidock.errors import InputError
from lumidock.geometry import se3_exp, se3_inverse, se3_log
from lumidock.port import FlatPort
from lumidock.pose import project_lights, solve_pose, sqpnp
from lumidock.setup.calibration_files import write_calibration
from lumidock.streams.calibration_check import check

K = np.array([[1110.0, 0.0, 648.0], [0.0, 1105.0, 471.0], [0.0, 0.0, 1.0]])
PORT = FlatPort(0.06, 1.34, 0.012, 1.5)
CAMERAS = {
    "plumb_bob": Camera(1280, 960, K, "plumb_bob", np.array([-0.21, 0.06, 8e-4, -5e-4, 0.0]), PORT),
    "equidistant": Camera(1280, 960, K, "equidistant", np.array([-0.03, 0.01, -0.004, 0.001]), PORT),
}


def traced(port, a):
    """Where the ray of tangent `a` in air stands at 2 m from the pupil, by Snell's law at each plane."""
    r, z, sine = 0.0, 0.0, np.sin(np.arctan(a))
    for thickness, n in (*port.layers, (2.0 - port.distance_m - port.glass_m, port.index)):
        r += thickness * np.tan(np.arcsin(sine / n))
        z += thickness
    return np.array([r, 0.0, z])


@given(st.floats(0.0, 1.5), st.floats(0.0, 0.5), st.floats(0.0, 0.05), st.floats(1.0, 1.5), st.floats(0.0, 2 * np.pi))
@settings(max_examples=200, deadline=None)
def test_points_appear_at_the_angle_of_the_ray_that_snells_law_traces_to_them(a, distance, glass, index, turn):
    port = FlatPort(distance, index, glass)
    point = traced(port, a)
    direction = np.array([np.cos(turn), np.sin(turn)])
    xy, _ = port.in_air(np.array([[*(point[0] * direction), point[2]]]))
    np.testing.assert_allclose(xy[0], a * direction, atol=1e-9)


def test_water_of_index_one_is_no_port(rng):
    p = rng.normal(size=(20, 3)) + np.array([0, 0, 5])
    xy, J = FlatPort(0.1, 1.0, 0.0).in_air(p)
    np.testing.assert_allclose(xy, p[:, :2] / p[:, 2:], atol=1e-12)
    np.testing.assert_allclose(J[:, 0, 0], 1.0 / p[:, 2], atol=1e-12)


@pytest.mark.parametrize("model", CAMERAS)
def test_jacobian_is_the_slope_of_the_projection(model, rng):
    camera = CAMERAS[model]
    p = rng.uniform([-0.4, -0.3, 0.4], [0.4, 0.3, 4.0], (40, 3))
    _, J = camera.project_with_jacobian(p)
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        slope = (camera.project(p + step) - camera.project(p - step)) / 2e-6
        np.testing.assert_allclose(J[:, :, axis], slope, rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize("model", CAMERAS)
def test_the_kernel_projects_as_numpy_does(model, rng):
    camera = CAMERAS[model]
    p = np.concatenate([rng.uniform([-2, -2, -1], [2, 2, 6], (200, 3)), [[0.0, 0.0, 3.0], [0.0, 0.0, 0.05]]])
    uv, J = camera.project_with_jacobian(p)
    for k, point in enumerate(p):
        seen, u, v, *row = kernel.project(camera.lens(), *point)
        assert seen == np.isfinite(uv[k]).all()
        if seen:
            np.testing.assert_allclose([u, v], uv[k], atol=1e-7)
            np.testing.assert_allclose(np.reshape(row, (2, 3)), J[k], rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("model", CAMERAS)
def test_far_points_on_the_ray_of_a_pixel_are_seen_at_the_pixel(model, rng):
    camera = CAMERAS[model]
    uv = rng.uniform([100, 100], [1180, 860], (30, 2))
    ray, J = camera.unproject_with_jacobian(uv)
    np.testing.assert_allclose(camera.project(1e7 * ray), uv, atol=1e-4)
    step = np.array([0.01, 0.0])
    slope = (camera.unproject(uv + step) - camera.unproject(uv - step)) / 0.02
    np.testing.assert_allclose(J[:, :, 0], slope, atol=1e-7)


def test_what_stands_in_the_housing_or_beyond_the_critical_angle_is_not_seen():
    camera = CAMERAS["plumb_bob"]
    assert np.isnan(camera.project(np.array([[0.0, 0.0, 0.05], [0.1, 0.0, -1.0], [40.0, 0.0, 0.5]]))).all()


def test_poses_are_exact_behind_a_port_and_sqpnp_is_near():
    camera, station = CAMERAS["plumb_bob"], shipped_station()
    lights = np.arange(len(station))
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = 0.3, -0.2, 6.0
    T = T @ se3_exp(np.array([0, 0, 0, 0.05, -0.04, 0.03]))
    uv = project_lights(camera, T, station.p_dock)
    first, *_ = solve_pose(station, camera, lights, uv)
    assert np.linalg.norm(se3_log(se3_inverse(first.T_dock_cam) @ T)) < 1e-5
    assert np.linalg.norm(se3_log(se3_inverse(sqpnp(camera, station.p_dock, uv)) @ T)) < 0.01


def test_the_file_keeps_the_port(tmp_path):
    path = tmp_path / "camera.yaml"
    save_camera(CAMERAS["plumb_bob"], path)
    assert load_camera(path).port == PORT
    path.write_text(path.read_text().replace("kind: flat", "kind: dome"))
    with pytest.raises(InputError, match="port"):
        load_camera(path)


def test_formats_without_words_for_a_port_are_refused(tmp_path):
    for form in ("kalibr", "opencv"):
        with pytest.raises(InputError, match="flat port"):
            write_calibration(CAMERAS["plumb_bob"], tmp_path / "out.yaml", form)


def test_a_lens_in_air_behind_a_stated_port_is_no_calibration_in_air():
    in_air = Camera(1280, 960, K, "plumb_bob", np.array([-0.21, 0.06, 0.0, 0.0, 0.0]))
    assert any("air" in text for text in check(in_air).warnings)
    assert not check(replace(in_air, port=PORT)).warnings
