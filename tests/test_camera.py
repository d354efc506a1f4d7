import cv2
import numpy as np
import pytest
import yaml
from conftest import assert_close, numeric_jacobian, refused
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from lumidock.camera import Camera, load_camera, save_camera

K = np.array([[632.0, 0.0, 365.5], [0.0, 628.0, 281.25], [0.0, 0.0, 1.0]])
MODELS = {
    "pinhole": ("plumb_bob", [0, 0, 0, 0, 0]),
    "four": ("plumb_bob", [-0.2, 0.05, 0.001, -0.002]),
    "barrel": ("plumb_bob", [-0.44, 0.149, 0.0137, 0.0024, 0]),
    "folding": ("plumb_bob", [-0.3, 0, 0, 0, 0]),
    "folding sideways": ("plumb_bob", [0, 0, 0.0137, 0, 0]),
    "rational": ("rational_polynomial", [0.8, -0.1, 0.001, -0.001, 0.01, 1.1, 0.1, 0.02]),
    "rational with a pole": ("rational_polynomial", [-0.1, 0, 0, 0, 0, -0.4, 0, 0]),
    "fisheye": ("equidistant", [0, 0, 0, 0]),
    "fisheye bent": ("equidistant", [0.05, -0.04, 0.01, -0.002]),
    "fisheye folding": ("equidistant", [-0.1, 0, 0, 0]),
}


def make(model, distortion):
    return Camera(720, 576, K, model, np.array(distortion, float))


@pytest.fixture(params=MODELS)
def camera(request):
    return make(*MODELS[request.param])


def ray(polar, azimuth):
    """Unit rays (N, 3) at the angle `polar` off the optical axis."""
    return np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1)


def hemisphere_and_more(polar_step_deg=0.25, azimuth_step_deg=5.0):
    polar, azimuth = np.meshgrid(np.arange(0.0, 180.0, polar_step_deg), np.arange(0.0, 360.0, azimuth_step_deg))
    return ray(np.deg2rad(polar.ravel()), np.deg2rad(azimuth.ravel()))


def pixel_grid(camera, step=12.0):
    u, v = np.meshgrid(np.arange(0.0, camera.width, step), np.arange(0.0, camera.height, step))
    return np.column_stack([u.ravel(), v.ravel()])


def rays_in_the_image(camera):
    rays = hemisphere_and_more()
    return rays[camera.contains(camera.project(rays))]


def points_in_the_image(camera, rng, n=20):
    """Points (n + 1, 3) at 1-30 m that the camera sees, the first one on its axis."""
    rays = rng.choice(rays_in_the_image(camera), n)
    return np.vstack([[0, 0, 1], rays]) * rng.uniform(1, 30, (n + 1, 1))


def test_projection_agrees_with_opencv(camera, rng):
    p_cam = points_in_the_image(camera, rng)
    none = np.zeros(3)
    if camera.model == "equidistant":
        uv, _ = cv2.fisheye.projectPoints(p_cam[:, None], none, none, K, camera.distortion)
    else:
        uv, _ = cv2.projectPoints(p_cam, none, none, K, camera.distortion)
    assert_close(camera.project(p_cam), uv[:, 0], atol=1e-9)


def test_unprojection_agrees_with_opencv(camera, rng):
    uv = camera.project(points_in_the_image(camera, rng))
    rays = camera.unproject(uv)
    if camera.model == "equidistant":
        xy = cv2.fisheye.undistortPoints(uv[:, None], K, camera.distortion)
    else:
        stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 1000, 1e-14)
        xy = cv2.undistortPoints(uv[:, None], K, camera.distortion, criteria=stop)
    assert_close(rays[:, :2] / rays[:, 2:], xy[:, 0], atol=1e-7)


def test_what_projects_into_the_image_unprojects_to_its_own_ray(camera):
    rays = rays_in_the_image(camera)
    assert len(rays) > 1000
    assert_close(camera.unproject(camera.project(rays)), rays, atol=1e-6)


def test_what_unprojects_projects_to_its_own_pixel(camera):
    uv = pixel_grid(camera)
    rays = camera.unproject(uv)
    assert_close(np.linalg.norm(rays, axis=1)[np.isfinite(rays[:, 0])], 1.0, atol=1e-12)
    back = camera.project(rays)
    seen = np.isfinite(back).all(axis=1)
    assert seen.mean() > 0.5
    assert_array_equal(seen, np.isfinite(rays).all(axis=1))
    assert_close(back[seen], uv[seen], atol=1e-4)


@given(
    st.tuples(*[st.floats(-0.6, 0.6)] * 2, *[st.floats(-0.03, 0.03)] * 2, st.floats(-0.3, 0.3)),
    st.tuples(*[st.floats(-0.3, 0.3)] * 3),
)
def test_no_lens_shows_one_pixel_two_rays(numerator, denominator):
    camera = make("rational_polynomial", [*numerator, *denominator])
    rays = rays_in_the_image(camera)
    assert_close(camera.unproject(camera.project(rays)), rays, atol=1e-5)


def test_projection_forgets_the_distance(camera, rng):
    p_cam = points_in_the_image(camera, rng)
    assert_close(camera.project(p_cam), camera.project(p_cam * rng.uniform(0.01, 100, (len(p_cam), 1))), atol=1e-9)


def test_projection_jacobian_agrees_with_differences(camera, rng):
    p_cam = points_in_the_image(camera, rng)
    expected = [numeric_jacobian(lambda p: camera.project(p[None])[0], p, 1e-5) for p in p_cam]
    uv, J_uv_p = camera.project_with_jacobian(p_cam)
    assert_array_equal(uv, camera.project(p_cam))
    assert_close(J_uv_p, expected, atol=1e-5, rtol=1e-6)


def test_unprojection_jacobian_agrees_with_differences(camera, rng):
    uv = camera.project(points_in_the_image(camera, rng))
    expected = [numeric_jacobian(lambda pixel: camera.unproject(pixel[None])[0], pixel, 1e-2) for pixel in uv]
    rays, J_ray_uv = camera.unproject_with_jacobian(uv)
    assert_array_equal(rays, camera.unproject(uv))
    known = np.isfinite(expected).all(axis=(1, 2))
    assert known.mean() > 0.9
    assert_close(J_ray_uv[known], np.array(expected)[known], atol=1e-7, rtol=1e-3)


@pytest.mark.parametrize(
    ("model", "fold"),
    [
        ("folding", np.arctan(np.sqrt(1 / 0.9))),  # d/dr (r - 0.3 r^3) = 0
        ("rational with a pole", np.arctan(np.sqrt(1 / 0.4))),
        ("fisheye folding", np.sqrt(1 / 0.3)),
    ],
)
def test_projection_ends_at_the_fold(model, fold):
    beyond = np.linspace(1.001 * fold, np.pi, 50)
    uv = make(*MODELS[model]).project(ray(np.append(0.998 * fold, beyond), 0.7))
    assert np.isfinite(uv[0]).all()
    assert np.isnan(uv[1:]).all()


def test_tangential_terms_fold_too():
    camera = make(*MODELS["folding sideways"])
    y = -1 / (3 * 0.0137)  # y + 3 p1 y^2 = 0: the polynomial puts this ray on the optical axis
    assert np.isnan(camera.project(np.array([[0, y, 1.0]]))).all()


def test_a_pixel_no_ray_reaches_is_nan():
    camera = make(*MODELS["folding"])
    reach = 632.0 * 2 / 3 * np.sqrt(1 / 0.9)  # r - 0.3 r^3 at the fold
    rays, J = camera.unproject_with_jacobian(
        camera.center_px + np.array([[0.99 * reach, 0], [1.01 * reach, 0], [np.nan, 0]])
    )
    assert np.isfinite(rays[0]).all()
    assert np.isnan(rays[1:]).all()
    assert np.isnan(J[1:]).all()


@pytest.mark.parametrize("p", [[0, 0, -1], [0, 0, 0], [np.nan, 0, 1]])
def test_a_point_without_a_direction_is_nan(camera, p):
    for value in camera.project_with_jacobian(np.array([p], float)):
        assert np.isnan(value).all()


@pytest.mark.parametrize("model", ["pinhole", "barrel", "rational"])
def test_a_point_behind_or_beside_a_perspective_camera_is_nan(model):
    for value in make(*MODELS[model]).project_with_jacobian(np.array([[0.1, 0.2, -5], [0.3, 0, 0], [1e-10, 0, 0]])):
        assert np.isnan(value).all()


def test_an_ideal_fisheye_sees_behind_and_beside_itself():
    uv = make(*MODELS["fisheye"]).project(np.array([[np.sin(2.0), 0, np.cos(2.0)], [1e-10, 0, 0]]))
    assert_close(uv, [[365.5 + 2.0 * 632.0, 281.25], [365.5 + np.pi / 2 * 632.0, 281.25]])


def test_no_points_give_no_pixels(camera):
    assert camera.project(np.empty((0, 3))).shape == (0, 2)
    assert camera.unproject(np.empty((0, 2))).shape == (0, 3)


@pytest.mark.parametrize(
    ("uv", "margin_px", "inside"),
    [
        ([-0.49, -0.49], 0, True),
        ([-0.51, 10], 0, False),
        ([719.49, 575.49], 0, True),
        ([719.51, 10], 0, False),
        ([10, 575.51], 0, False),
        ([4.4, 10], 5, False),
        ([4.6, 570.4], 5, True),
        ([np.nan, 10], 0, False),
    ],
)
def test_contains_counts_whole_pixels(uv, margin_px, inside):
    assert make(*MODELS["pinhole"]).contains(np.array([uv]), margin_px=margin_px).tolist() == [inside]


@pytest.mark.parametrize(("model", "n"), [("plumb_bob", 3), ("rational_polynomial", 5), ("equidistant", 5)])
def test_a_wrong_number_of_coefficients_is_refused(model, n):
    with pytest.raises(ValueError, match="coefficients"):
        make(model, np.zeros(n))


def test_a_camera_survives_its_file(camera, tmp_path):
    save_camera(camera, tmp_path / "camera.yaml", name="left")
    again = load_camera(tmp_path / "camera.yaml")
    assert (again.width, again.height, again.model) == (720, 576, camera.model)
    assert_array_equal(again.K, camera.K)
    assert_array_equal(again.distortion, camera.distortion)


REFUSALS = {
    "no width": (["image_width"], None, "image_width: Field required"),
    "zero height": (["image_height"], 0, "image_height"),
    "huge width": (["image_width"], 100_000, "image_width"),
    "no matrix": (["camera_matrix"], None, "camera_matrix"),
    "short matrix": (["camera_matrix", "data"], [1.0] * 8, "9 numbers"),
    "skewed matrix": (["camera_matrix", "data"], [600, 1, 360, 0, 600, 288, 0, 0, 1], "positive fx and fy"),
    "negative focal": (["camera_matrix", "data"], [-600, 0, 360, 0, 600, 288, 0, 0, 1], "positive fx and fy"),
    "odd last row": (["camera_matrix", "data"], [600, 0, 360, 0, 600, 288, 0, 0, 2], "positive fx and fy"),
    "nan focal": (["camera_matrix", "data"], [float("nan"), 0, 360, 0, 600, 288, 0, 0, 1], "finite"),
    "infinite center": (["camera_matrix", "data"], [600, 0, float("inf"), 0, 600, 288, 0, 0, 1], "finite"),
    "unknown key": (["camera_matrix", "dtype"], "d", "dtype: unknown key"),
    "unknown model": (["distortion_model"], "fov", "distortion model 'fov'"),
    "no coefficients": (["distortion_coefficients"], None, "distortion_coefficients"),
    "three coefficients": (["distortion_coefficients", "data"], [0.1] * 3, "takes 4 or 5 numbers"),
    "nan coefficient": (["distortion_coefficients", "data"], [float("nan")] * 5, "finite"),
    "huge coefficient": (["distortion_coefficients", "data"], [1e200] * 5, "no lens bends"),
}


@pytest.mark.parametrize(("keys", "value", "match"), REFUSALS.values(), ids=REFUSALS)
def test_a_bad_camera_file_is_refused(keys, value, match, tmp_path):
    path = tmp_path / "camera.yaml"
    save_camera(make(*MODELS["barrel"]), path)
    content = yaml.safe_load(path.read_text())
    place = content
    for key in keys[:-1]:
        place = place[key]
    place[keys[-1]] = value
    if value is None:
        del place[keys[-1]]
    path.write_text(yaml.safe_dump(content))
    with refused(path, match):
        load_camera(path)


def test_a_vanishing_coefficient_is_none_at_all(tmp_path):
    save_camera(make("plumb_bob", [-0.3, 0, 0, 0, 5e-324]), tmp_path / "camera.yaml")
    edge = ray(np.array([0.5]), np.array([1.0]))
    assert_array_equal(load_camera(tmp_path / "camera.yaml").project(edge), make(*MODELS["folding"]).project(edge))
