"""The default method's detector and its colour labels, on pictures whose lights are known in closed form."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lumidock import detect, layers
from lumidock.config import DetectConfig, LabelConfig
from lumidock.datatypes import ENCODINGS, MOSAICS, Attitude, Frame

CONFIG = DetectConfig()
ROWS, COLUMNS = np.indices((240, 320)).astype(float)


def water(seed=0, level=20.0, noise=1.0, shape=(240, 320)):
    return np.random.default_rng(seed).normal(level, noise, shape)


def gauss(u, v, peak=100.0, sigma=1.5, sigma_v=None):
    return peak * np.exp(-0.5 * ((COLUMNS - u) / sigma) ** 2 - 0.5 * ((ROWS - v) / (sigma_v or sigma)) ** 2)


def disc(u, v, radius, peak=400.0):
    """A disc whose edge falls over two pixels."""
    return peak * np.clip(0.5 * (radius + 1.0 - np.hypot(COLUMNS - u, ROWS - v)), 0.0, 1.0)


def to_picture(image):
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def found(image, config=CONFIG, scan=None, predicted=None):
    image = image if image.dtype != np.float64 else to_picture(image)
    return detect.lights(Frame("f", 7, image), config, scan, predicted)


def nearest(detections, u, v):
    """Index of the detection nearest to a place, and its error."""
    error = detections.uv - (u, v)
    k = int(np.hypot(*error.T).argmin())
    return k, error[k]


@pytest.mark.parametrize("sigma", [0.8, 1.3, 2.0, 4.0, 9.0])
def test_the_centroid_of_a_gaussian_is_unbiased_and_near_the_cramer_rao_bound(sigma):
    """Of a Gaussian of height A in white noise s, no estimator has a variance below 2 s^2 / (pi A^2) per axis."""
    rng, errors, nees = np.random.default_rng(4), [], []
    for seed in range(30):
        u, v = rng.uniform(100.0, 140.0, 2)
        detections = found(water(seed, noise=2.0) + gauss(u, v, 40.0, sigma))
        k, error = nearest(detections, u, v)
        errors.append(error)
        nees.append(error @ np.linalg.solve(detections.cov_px2[k], error) / 2.0)
    errors = np.array(errors)
    bound = np.sqrt(2.0 / np.pi * (2.0**2 + 1.0 / 12.0)) / 40.0
    assert np.abs(errors.mean(axis=0)).max() < 4.0 * errors.std() / np.sqrt(len(errors))
    assert np.sqrt(np.mean(errors**2)) < 2.2 * bound
    assert np.mean(nees) < 1.6


@pytest.mark.parametrize("radius", [3.0, 6.0, 12.0, 25.0])
def test_an_overexposed_disc_has_its_centre_and_radius(radius):
    image = water() + disc(160.3, 120.7, radius)
    detections = found(image)
    k, error = nearest(detections, 160.3, 120.7)
    assert np.hypot(*error) < 0.1 + 0.01 * radius
    assert detections.radius_px[k] == pytest.approx(radius, rel=0.3, abs=0.7)


@settings(max_examples=12, deadline=None)
@given(du=st.integers(-3, 3), dv=st.integers(-3, 3))
def test_a_picture_moved_by_whole_tiles_moves_its_lights(du, dv):
    image = water(3) + gauss(160.2, 120.6, sigma=1.7) + gauss(120.1, 100.4, 60.0, 3.0)
    moved = np.roll(image, (8 * dv, 8 * du), axis=(0, 1))
    before, after = found(image), found(moved)
    for place in ((160.2, 120.6), (120.1, 100.4)):
        there = place[0] + 8 * du, place[1] + 8 * dv
        np.testing.assert_allclose(nearest(after, *there)[1], nearest(before, *place)[1], atol=0.02)


@settings(max_examples=12, deadline=None)
@given(gain=st.floats(0.4, 1.0), offset=st.floats(0.0, 60.0))
def test_gain_and_brightness_move_no_light(gain, offset):
    image = 40.0 + 0.0 * COLUMNS + gauss(160.2, 120.6, 120.0, 1.7) + gauss(80.1, 100.4, 80.0, 3.0)
    detections = found(gain * image + offset)
    for place in ((160.2, 120.6), (80.1, 100.4)):
        assert np.hypot(*nearest(detections, *place)[1]) < 2.0 * CONFIG.floor_px


@pytest.mark.parametrize("order", [(0, 2, 1), (1, 2, 0), (2, 1, 0)])
def test_planes_that_change_places_change_nothing(order):
    light = gauss(160.2, 120.6, 100.0, 2.0) + gauss(70.3, 60.8, 50.0, 1.3)
    image = to_picture(np.stack([water(k) + share * light for k, share in enumerate((1.0, 0.7, 0.3))], axis=2))
    one, other = found(image), found(np.ascontiguousarray(image[:, :, order]))
    assert len(one) == len(other)
    a, b = np.lexsort(one.uv.round(2).T), np.lexsort(other.uv.round(2).T)
    np.testing.assert_allclose(one.uv[a], other.uv[b], atol=1e-3)
    np.testing.assert_allclose(one.p_light[a], other.p_light[b], atol=1e-3)


@pytest.mark.parametrize("place", [(1.0, 60.0), (318.0, 200.0), (160.0, 1.0), (100.0, 238.0), (2.0, 2.0)])
def test_a_light_that_the_border_cuts_is_found(place):
    detections = found(water() + gauss(*place, 150.0, 3.0))
    k, error = nearest(detections, *place)
    assert np.hypot(*error) < 3.0
    assert error @ np.linalg.solve(detections.cov_px2[k], error) < 9.2


def test_halos_that_merge_leave_two_cores():
    image = water()
    for u in (150.3, 174.8):
        image += gauss(u, 120.6, 120.0, 2.5) + gauss(u, 120.6, 60.0, 14.0)
    detections = found(image)
    for u in (150.3, 174.8):
        assert np.hypot(*nearest(detections, u, 120.6)[1]) < 0.5


def test_a_compact_core_beside_a_white_panel_is_measured_in_the_plane_where_it_is_compact():
    """A blue lamp clips blue and green with its halo, over a lit panel; red shows the core alone."""
    panel = 120.0 * (COLUMNS > 172.0) * (np.abs(ROWS - 120.0) < 70.0)
    image = np.stack(
        [
            water(1) + gauss(160.3, 120.7, 900.0, 10.0) + panel,
            water(2) + gauss(160.3, 120.7, 300.0, 8.0) + panel,
            water(3) + gauss(160.3, 120.7, 200.0, 3.0) + panel,
        ],
        axis=2,
    )
    assert np.hypot(*nearest(found(to_picture(image)), 160.3, 120.7)[1]) < 0.8


def test_a_lamp_is_one_detection_in_all_planes_and_scales():
    light = gauss(160.2, 120.6, 200.0, 3.0) + gauss(160.2, 120.6, 50.0, 15.0)
    image = np.stack([water(k) + share * light for k, share in enumerate((1.0, 0.6, 0.3))], axis=2)
    detections = found(to_picture(image))
    assert (np.hypot(*(detections.uv - (160.2, 120.6)).T) < 10.0).sum() == 1


@pytest.mark.parametrize("noise", [1.0, 5.0, 30.0])
def test_noise_alone_gives_hardly_a_lamp(noise):
    detections = found(water(5, 100.0, noise, (512, 612, 3)))
    assert (detections.p_light > 0.5).sum() <= 1


@settings(max_examples=40, deadline=None)
@given(
    height=st.integers(1, 70),
    width=st.integers(1, 70),
    encoding=st.sampled_from(ENCODINGS),
    seed=st.integers(0, 99),
    flat=st.booleans(),
)
def test_pictures_of_any_size_and_kind_are_taken(height, width, encoding, seed, flat):
    rng, most = np.random.default_rng(seed), 255 if encoding.endswith("8") else 65535
    shape = (height, width, 3) if encoding.startswith("bgr") else (height, width)
    image = np.full(shape, seed * most // 99) if flat else rng.integers(0, most + 1, shape)
    image = image.astype(np.uint8 if most == 255 else np.uint16)
    image.flags.writeable = False
    frame = Frame("f", 7, image, encoding=encoding)
    for predicted in (None, np.array([[width / 2.0, height / 2.0, 9.0], [-50.0, 0.0, 3.0]])):
        detections = layers.label(frame, detect.lights(frame, CONFIG, None, predicted), LabelConfig())
        assert np.isfinite(detections.uv).all()
        assert (np.linalg.eigvalsh(detections.cov_px2) > 0.0).all()
        assert ((detections.p_light >= 0.0) & (detections.p_light <= 1.0)).all()
        assert (np.abs(detections.uv - (width / 2 - 0.5, height / 2 - 0.5)) <= (width / 2, height / 2)).all()
        assert not flat or len(detections) == 0


FORMATS = ("mono8", "mono16", "bgr8", "bgr16", *(f"{order}{bits}" for order in MOSAICS for bits in (8, 16)))


@pytest.mark.parametrize("kind", FORMATS)
def test_every_format_gives_the_same_lights(kind):
    places = np.array([[60.3, 70.6], [240.8, 120.1], [160.2, 190.7]])
    image = water()
    for (u, v), sigma, peak in zip(places, (1.3, 2.2, 6.0), (120.0, 150.0, 100.0), strict=True):
        image += gauss(u, v, peak, sigma)
    deep = kind.endswith("16")
    values = np.clip(np.rint(image * (257.0 if deep else 1.0)), 0, 65535 if deep else 255)
    values = values.astype(np.uint16 if deep else np.uint8)
    values = np.repeat(values[:, :, None], 3, axis=2) if kind.startswith("bgr") else values
    detections = detect.lights(Frame("f", 7, values, encoding=kind), CONFIG)
    for place in places:
        assert np.hypot(*nearest(detections, *place)[1]) < 0.12


def test_pixels_that_are_not_square_are_taken_into_account():
    """One field of interlaced video: half the rows, and lamps half as high as wide."""
    image = water() + gauss(160.2, 120.6, 120.0, 3.0, 1.5)
    frame = Frame("f", 7, to_picture(image))
    detections = detect.lights(frame, CONFIG, detect.Scan(frame, CONFIG, aspect=2.0))
    k, error = nearest(detections, 160.2, 120.6)
    assert np.hypot(*error) < 0.1
    assert detections.cov_px2[k, 0, 0] > 1.5 * detections.cov_px2[k, 1, 1]


def test_windows_give_what_the_whole_frame_gives_and_nothing_else():
    image = water() + gauss(160.2, 120.6, 100.0, 2.0) + gauss(60.2, 60.6, 100.0, 2.0)
    whole = found(image)
    part = found(image, predicted=np.array([[158.0, 122.0, 10.0]]))
    k, _ = nearest(whole, 160.2, 120.6)
    m, error = nearest(part, 160.2, 120.6)
    np.testing.assert_allclose(part.uv[m], whole.uv[k], atol=0.03)
    assert np.hypot(*error) < 0.1
    assert (np.abs(part.uv - (158.0, 122.0)) < 14.0).all()


def test_the_covariance_grows_with_noise_and_with_texture():
    rng, sigma = np.random.default_rng(8), {}
    bump = 15.0 * (np.sin(COLUMNS / 2.5) * np.sin(ROWS / 3.0) + 1.0)
    for name, image in (
        ("calm", water(1)),
        ("noisy", water(1, noise=4.0)),
        ("textured", water(1) + bump * (np.hypot(COLUMNS - 160, ROWS - 120) > 8)),
    ):
        drawn = []
        for _ in range(6):
            u, v = rng.uniform(158.0, 162.0, 2)
            detections = found(image + gauss(u, v, 60.0, 1.5) - 0.0)
            drawn.append(np.sqrt(detections.cov_px2[nearest(detections, u, v)[0], 0, 0]))
        sigma[name] = np.median(drawn)
    assert sigma["noisy"] > 1.3 * sigma["calm"]
    assert sigma["textured"] > 1.15 * sigma["calm"]


def test_video_that_does_not_use_the_whole_range_saturates_where_it_does():
    image = water(1) + sum(disc(u, v, 9.0) for u, v in ((80.3, 60.2), (240.6, 60.7), (160.2, 170.5)))
    for top, level in ((255.0, 250.0), (235.0, 229.0)):
        frame = Frame("f", 7, to_picture(np.minimum(image, top)))
        scan = detect.Scan(frame, CONFIG)
        detect.lights(frame, CONFIG, scan)
        assert scan.saturated == level


def test_lights_that_are_not_saturated_pile_up_nowhere():
    image = water(1) + sum(gauss(u, v, 190.0, 3.0) for u, v in ((80.3, 60.2), (240.6, 60.7), (160.2, 170.5)))
    frame = Frame("f", 7, to_picture(image))
    scan = detect.Scan(frame, CONFIG)
    detect.lights(frame, CONFIG, scan)
    assert scan.saturated == 250.0


def test_the_caps_keep_the_strongest():
    image = np.random.default_rng(1).normal(20.0, 1.0, (400, 400))
    rows, columns = np.indices(image.shape)
    for k in range(64):
        u, v = 30.0 + 48.0 * (k % 8), 30.0 + 48.0 * (k // 8)
        image += (60.0 + 2.0 * k) * np.exp(-0.5 * ((columns - u) ** 2 + (rows - v) ** 2) / 1.5**2)
    assert len(found(image)) >= 64
    kept = found(image, CONFIG.model_copy(update={"max_lights": 10}))
    assert len(kept) == 10
    assert kept.uv[:, 1].min() > 250.0
    crowd = to_picture(255.0 * (np.random.default_rng(2).random((512, 612)) < 0.01))
    assert len(found(crowd)) <= CONFIG.max_lights


def test_the_same_frame_gives_the_same_bytes():
    image = to_picture(np.stack([water(k) + gauss(160.2, 120.6) for k in range(3)], axis=2))
    first, second = found(image), found(image.copy())
    for name in ("uv", "radius_px", "flux", "p_light", "cov_px2"):
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes()


def test_name_stamp_and_attitude_pass_through():
    attitude = Attitude(np.eye(3), 0.01)
    detections = detect.lights(Frame("f", 7, to_picture(water()), attitude), CONFIG)
    assert (detections.frame, detections.t_ns, detections.attitude) == ("f", 7, attitude)
    assert np.isnan(detections.p_rear).all()


def test_a_scan_made_for_another_camera_is_not_used():
    small = Frame("a", 0, to_picture(water()))
    large = Frame("b", 1, to_picture(water(shape=(300, 320))))
    scan = detect.Scan(small, CONFIG)
    assert scan.fits(small)
    assert not scan.fits(large)
    detect.lights(large, CONFIG, scan, np.zeros((1, 3)))


@pytest.mark.parametrize("order", MOSAICS)
def test_a_mosaic_tells_blue_from_white(order):
    letters = np.array(list(order.removeprefix("bayer_"))).reshape(2, 2)
    blue = np.tile(np.where(letters == "b", 1.0, 0.1), (120, 160))
    white = np.tile(np.where(letters == "b", 0.5, 1.0), (120, 160))
    image = water() + gauss(80.2, 120.4, 120.0, 2.0) * white + gauss(240.7, 120.4, 120.0, 2.0) * blue
    frame = Frame("f", 7, to_picture(image), encoding=f"{order}8")
    detections = layers.label(frame, detect.lights(frame, CONFIG), LabelConfig())
    for u, rear in ((80.2, False), (240.7, True)):
        k, error = nearest(detections, u, 120.4)
        assert np.hypot(*error) < 0.3
        assert (detections.p_rear[k] > 0.5) == rear


def test_clear_water_makes_no_white_light_a_rear_one():
    image = water() + gauss(160.0, 120.0, 120.0, 3.0)
    linear = (np.clip(image, 0, 255) - 20.0)[:, :, None] * (1.1, 1.0, 0.6) + 20.0  # it has lost red, then green
    frame = Frame("0", 0, to_picture(255.0 * (np.clip(linear, 0.0, 255.0) / 255.0) ** (1.0 / 2.2)))
    detections = layers.label(frame, detect.lights(frame, CONFIG), LabelConfig())
    assert detections.p_rear[detections.flux.argmax()] < 0.5


def test_colour_without_light_says_nothing():
    frame = Frame("f", 7, to_picture(water(shape=(64, 64, 3))))
    detections = detect.Detections.from_uv("f", 7, np.array([[30.0, 30.0]]))
    detections = type(detections)("f", 7, detections.uv, np.array([1.5]), np.ones(1), np.ones(1), detections.p_rear)
    assert np.isnan(layers.label(frame, detections, LabelConfig()).p_rear[0])


def test_compression_and_saturation_leave_the_centre():
    rng = np.random.default_rng(3)
    for _ in range(4):
        radius = rng.uniform(10.0, 22.0)
        u, v = rng.uniform(100.0, 140.0, 2)
        away = np.hypot(COLUMNS - u, ROWS - v)
        halo = np.exp(-np.maximum(away - radius, 0.0) / (1.2 * radius))
        core = 400.0 * np.clip(0.5 * (radius + 1.0 - away), 0.0, 1.0)
        image = np.stack([70.0 + k * halo + core for k in (90.0, 130.0, 80.0)], axis=2)
        coded = cv2.imencode(".jpg", to_picture(image + rng.normal(0.0, 2.0, image.shape)))[1]
        assert np.hypot(*nearest(found(cv2.imdecode(coded, cv2.IMREAD_COLOR)), u, v)[1]) < 0.5
