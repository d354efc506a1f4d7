"""The default method's detector and its colour labels, on hand-made and rendered pictures."""

import time

import cv2
import numpy as np
import pytest
from bench.shipped import shipped_camera, shipped_station

from lumidock import detect, layers
from lumidock._kernels.detection.detect import see
from lumidock.config import DetectConfig, LabelConfig
from lumidock.datatypes import MOSAICS, Attitude, Frame
from lumidock.sim.scenario import load_scenario, trajectory
from lumidock.sim.sequence import render_frame

CONFIG = DetectConfig()
STATION, CAMERA = shipped_station(), shipped_camera()


def canvas(rng, size=(240, 320), level=20.0, noise=1.0):
    return rng.normal(level, noise, size)


def add_spot(image, u, v, peak=100.0, sigma=1.5):
    rows, columns = np.indices(image.shape)
    image += peak * np.exp(-0.5 * ((columns - u) ** 2 + (rows - v) ** 2) / sigma**2)


def add_disc(image, u, v, radius, peak=150.0):
    """A disc whose edge falls over two pixels."""
    rows, columns = np.indices(image.shape)
    image += peak * np.clip(0.5 * (radius + 1.0 - np.hypot(columns - u, rows - v)), 0.0, 1.0)


def to_picture(image):
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def found(image, config=CONFIG):
    image = image if image.dtype == np.uint8 else to_picture(image)
    return detect.lights(Frame("f", 7, image), config)


def in_color(image):
    """The same picture (H, W, 3) with the largest channel in green."""
    return np.stack([image // 2, image, image // 3], axis=2).astype(np.uint8)


@pytest.fixture(scope="module")
def rendered():
    """Frames of the approach, by z: picture, lamps and their signal-to-noise ratios."""
    scenario = load_scenario("approach")
    poses = trajectory(scenario, np.random.default_rng([3, 0]))[1]
    pictures = {}
    for z in (22.0, 14.0, 5.0, -2.0):
        T_dock_cam = poses[np.argmin(np.abs(poses[:, 2, 3] - z))]
        rng = np.random.default_rng(3)
        pictures[z] = render_frame(scenario, STATION, CAMERA, T_dock_cam, np.empty((0, 2)), np.empty(0, int), rng)
    return pictures


def test_finds_the_lights_of_the_approach_and_knows_their_error_and_layer(rendered):
    nees, false = [], 0
    for image, seen, snr in rendered.values():
        frame = Frame("0", 0, image)
        spots = layers.label(frame, detect.lights(frame, CONFIG), LabelConfig())
        sure = np.flatnonzero(snr > 20.0)
        distance = np.linalg.norm(spots.uv[:, None] - seen.uv[None, sure], axis=2)
        assert (distance.min(axis=0) < 0.5).all()
        nearest = distance.argmin(axis=0)
        error = spots.uv[nearest] - seen.uv[sure]
        nees += np.einsum("ni,nij,nj->n", error, np.linalg.inv(spots.cov_px2[nearest]), error).tolist()
        assert ((spots.p_rear[nearest] > 0.5) == (sure >= 7)).all()
        assert (spots.p_light[nearest] > 0.4).all()
        false += int((spots.p_light > 0.5).sum()) - len(set(nearest))
    assert false <= 3
    assert 0.5 < np.mean(nees) < 4.0


@pytest.mark.parametrize("sigma", [1.0, 1.5, 3.0, 6.0])
def test_centres_follow_a_spot_through_the_pixel(sigma, rng):
    errors, nees = [], []
    for du, dv in rng.uniform(-0.5, 0.5, (12, 2)):
        image = canvas(rng)
        add_spot(image, 160 + du, 120 + dv, sigma=sigma)
        spots = found(image)
        lamps = np.flatnonzero(spots.p_light > 0.5)
        assert len(lamps) == 1
        errors.append(spots.uv[lamps[0]] - (160 + du, 120 + dv))
        nees.append(errors[-1] @ np.linalg.solve(spots.cov_px2[lamps[0]], errors[-1]))
    assert np.sqrt(np.mean(np.square(errors))) < 0.06
    assert np.mean(nees) < 4.0


def test_the_covariance_grows_with_the_noise(rng):
    config = DetectConfig(signal_noise=1e-9, floor_px=1e-9)
    sigmas = []
    for noise in (1.0, 4.0):
        drawn = []
        for _ in range(12):  # the noise around one spot is known to a tenth
            image = canvas(rng, noise=noise)
            add_spot(image, 160.2, 120.4)
            drawn.append(np.sqrt(np.linalg.eigvalsh(found(image, config).cov_px2[0])))
        sigmas.append(np.median(drawn, axis=0))
    assert sigmas[1] / sigmas[0] == pytest.approx([4.0, 4.0], rel=0.15)


@pytest.mark.parametrize("radius", [4.0, 10.0, 30.0])
def test_a_disc_has_its_centre_and_radius(radius, rng):
    image = canvas(rng, (600, 800))
    add_disc(image, 400.3, 300.7, radius)
    spots = found(image)
    assert len(spots) == 1
    assert np.linalg.norm(spots.uv[0] - (400.3, 300.7)) < 0.1
    assert spots.radius_px[0] == pytest.approx(radius, abs=0.5)
    assert spots.flux[0] == pytest.approx(150.0 * np.pi * radius**2, rel=0.15)


@pytest.mark.parametrize("color", [False, True])
def test_a_saturated_core_with_a_wide_halo_is_one_light(color, rng):
    image = canvas(rng, (600, 800))
    add_spot(image, 400.3, 300.7, peak=2000.0, sigma=5.0)
    add_spot(image, 400.3, 300.7, peak=60.0, sigma=50.0)
    picture = to_picture(image)
    spots = found(in_color(picture) if color else picture)
    assert len(spots) == 1
    assert np.linalg.norm(spots.uv[0] - (400.3, 300.7)) < 0.15
    assert spots.p_light[0] > 0.5


@pytest.mark.parametrize("part", range(8))
def test_a_near_light_clipped_in_all_channels_is_found_whole_through_compression(part, rng):
    rows, columns = np.indices((480, 640))
    radius = rng.uniform(12.0, 30.0)
    u, v = rng.uniform(1.6 * radius, 640 - 1.6 * radius), rng.uniform(1.6 * radius, 480 - 1.6 * radius)
    away = np.hypot(columns - u, rows - v)
    halo = np.exp(-np.maximum(away - radius, 0.0) / (1.2 * radius))
    core = 400.0 * np.clip(0.5 * (radius + 1.0 - away), 0.0, 1.0)
    image = np.stack([70.0 + k * halo + core for k in (90.0, 130.0, 80.0)], axis=2)
    image = to_picture(image + rng.normal(0.0, 2.0, image.shape))
    coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 92])[1]
    spots = found(cv2.imdecode(coded, cv2.IMREAD_COLOR))
    best = np.hypot(*(spots.uv - (u, v)).T).argmin()
    assert np.hypot(*(spots.uv[best] - (u, v))) < 0.5, f"part {part}"
    assert 0.7 < spots.radius_px[best] / radius < 1.35


def test_two_lights_are_two_when_apart_and_one_when_merged(rng):
    for apart, count in ((24.0, 2), (3.0, 1)):
        image = canvas(rng)
        add_spot(image, 150.0, 120.0, sigma=2.5)
        add_spot(image, 150.0 + apart, 120.0, sigma=2.5)
        assert len(found(image)) == count


def test_a_faint_spot_beside_a_strong_one_is_a_glint(rng):
    image = canvas(rng)
    add_spot(image, 150.0, 120.0, peak=200.0, sigma=8.0)
    add_spot(image, 182.0, 120.0, peak=60.0, sigma=1.5)
    add_spot(image, 220.0, 120.0, peak=60.0, sigma=1.5)
    spots = found(image)
    order = np.argsort(spots.uv[:, 0])
    assert spots.uv[order, 0].round().tolist() == [150.0, 182.0, 220.0]
    strong, glint, alone = spots.p_light[order]
    assert min(strong, alone) > 0.5 > 4.0 * glint


def test_a_rope_looks_less_like_a_lamp_than_a_disc(rng):
    image = canvas(rng, (600, 800))
    add_disc(image, 200.0, 300.0, 8.0)
    image[270:330, 598:604] += 120.0
    spots = found(image)
    is_lamp = np.abs(spots.uv[:, 0] - 200.0) < 2.0
    assert is_lamp.sum() == 1
    assert spots.p_light[is_lamp].min() > 2.0 * spots.p_light[~is_lamp].max(initial=0.02)


@pytest.mark.parametrize("noise", [1.0, 5.0, 30.0])
def test_noise_alone_gives_hardly_a_spot(noise, rng):
    assert len(found(canvas(rng, (1024, 1224, 3), 100.0, noise))) <= 2


def test_a_gradient_hides_no_light_and_makes_none(rng):
    image = canvas(rng, (600, 800)) + np.linspace(0, 150, 800)
    for u in (80.0, 400.0, 720.0):
        add_spot(image, u, 300.0, peak=60.0)
    assert sorted(found(image).uv[:, 0].round()) == [80.0, 400.0, 720.0]


@pytest.mark.parametrize("size", [(1, 1), (5, 40), (32, 32), (33, 47), (2048, 2448)])
@pytest.mark.parametrize("channels", [(), (3,)])
@pytest.mark.parametrize("level", [0, 255])
def test_flat_frames_of_any_size_give_nothing(size, channels, level):
    spots = found(np.full((*size, *channels), level, np.uint8))
    assert len(spots) == 0


def test_a_light_in_the_smallest_frame(rng):
    image = canvas(rng, (32, 32))
    add_spot(image, 14.3, 17.6)
    assert np.linalg.norm(found(image).uv - (14.3, 17.6), axis=1) == pytest.approx([0.0], abs=0.15)


def test_lights_at_the_border_are_uncertain(rng):
    image = canvas(rng)
    for u, v in ((0.0, 60.0), (319.0, 200.0), (160.0, 0.0), (100.0, 239.0), (0.0, 0.0), (319.0, 239.0), (160.0, 120.0)):
        add_disc(image, u, v, 6.0)
    spots = found(image)
    inside = np.abs(spots.uv - (160.0, 120.0)).max(axis=1) < 5.0
    assert len(spots) == 7
    sigma = np.sqrt(spots.cov_px2[:, 0, 0])
    assert sigma[~inside].min() > 5.0 * sigma[inside].max()


def test_colour_and_mono_agree(rng):
    image = canvas(rng)
    for u, v in ((50.2, 60.4), (160.0, 120.0), (250.7, 200.1)):
        add_spot(image, u, v)
    picture = to_picture(image)
    mono, color = found(picture), found(in_color(picture))
    np.testing.assert_allclose(mono.uv, color.uv, atol=0.02)
    assert np.isnan(layers.label(Frame("f", 7, picture), mono, LabelConfig()).p_rear).all()


def test_the_cap_keeps_the_strongest(rng):
    image = canvas(rng, (400, 400))
    for k in range(64):
        add_spot(image, 30.0 + 48.0 * (k % 8), 30.0 + 48.0 * (k // 8), peak=60.0 + 2.0 * k)
    assert len(found(image)) == 64
    kept = found(image, DetectConfig(max_detections=10))
    assert len(kept) == 10
    assert kept.uv[:, 1].min() > 250.0


def test_a_frame_full_of_points_ends_at_the_cap(rng):
    image = to_picture(255.0 * (rng.random((1024, 1224)) < 0.002))
    assert len(found(image)) <= CONFIG.max_detections


def test_the_same_frame_gives_the_same_bytes(rendered):
    image = rendered[5.0][0]
    first, second = found(image), found(image.copy())
    for name in ("uv", "radius_px", "flux", "p_light", "cov_px2"):
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes()


def test_name_stamp_and_attitude_pass_through(rng):
    attitude = Attitude(np.eye(3), 0.01)
    spots = detect.lights(Frame("f", 7, to_picture(canvas(rng)), attitude), CONFIG)
    assert (spots.frame, spots.t_ns, spots.attitude) == ("f", 7, attitude)
    assert np.isnan(spots.p_rear).all()


def test_colour_without_light_says_nothing(rng):
    frame = Frame("f", 7, to_picture(canvas(rng, (64, 64, 3))))
    dark = found(frame.image)
    spot = type(dark).from_uv("f", 7, np.array([[30.0, 30.0], [0.0, 0.0]]))
    spot = type(dark)("f", 7, spot.uv, np.array([1.5, 1.5]), np.ones(2), np.ones(2), spot.p_rear)
    assert np.isnan(layers.label(frame, spot, LabelConfig()).p_rear[0])


def as_format(image, kind):
    """A linear grey picture as mono, BGR or a mosaic of 8 or 16 bits."""
    deep = kind.endswith("16")
    values = np.clip(np.rint(image * (257.0 if deep else 1.0)), 0, 65535 if deep else 255)
    values = values.astype(np.uint16 if deep else np.uint8)
    if kind.startswith("bgr"):
        return Frame("f", 7, np.repeat(values[:, :, None], 3, axis=2))
    return Frame("f", 7, values, encoding=kind)


FORMATS = ("mono8", "mono16", "bgr8", "bgr16", *(f"{order}{bits}" for order in MOSAICS for bits in (8, 16)))


@pytest.mark.parametrize("kind", FORMATS)
def test_every_format_gives_the_same_lights(kind, rng):
    image = canvas(rng, (400, 480))
    places = np.array([[60.3, 70.6], [240.8, 200.1], [400.2, 320.7]])
    for (u, v), sigma, peak in zip(places, (1.3, 2.2, 6.0), (120.0, 150.0, 100.0), strict=True):
        add_spot(image, u, v, peak=peak, sigma=sigma)
    spots = detect.lights(as_format(image, kind), CONFIG)
    lamps = spots.uv[spots.p_light > 0.5]
    distance = np.linalg.norm(lamps[:, None] - places[None], axis=2)
    assert len(lamps) == 3
    assert distance.min(axis=0).max() < 0.12


def test_one_compiled_search_takes_every_type_of_pixels(rng):
    image = canvas(rng, (64, 80))
    add_spot(image, 40.3, 30.6)
    for kind in FORMATS:
        for writeable in (True, False):  # as pictures from files are, and those in messages
            frame = as_format(image, kind)
            frame.image.flags.writeable = writeable
            assert len(detect.lights(frame, CONFIG)) == 1, kind
    assert len(see.signatures) == 1


@pytest.mark.parametrize("order", MOSAICS)
@pytest.mark.parametrize("sigma", [3.0, 6.0, 10.0])
def test_a_saturated_light_of_a_mosaic_is_not_shifted_by_its_planes(order, sigma, rng):
    letters = np.array(list(order.removeprefix("bayer_"))).reshape(2, 2)
    gain = np.select([letters == "g", letters == "b"], [1.0, 0.45], 0.3)
    errors = []
    for _ in range(8):
        image, place = canvas(rng, (240, 320)), rng.uniform(110.0, 130.0, 2)
        light = np.zeros_like(image)
        add_spot(light, *place, peak=900.0, sigma=sigma)
        frame = Frame("f", 7, to_picture(image + light * np.tile(gain, (120, 160))), encoding=f"{order}8")
        spots = detect.lights(frame, CONFIG)
        errors.append(spots.uv[np.linalg.norm(spots.uv - place, axis=1).argmin()] - place)
    assert np.abs(np.mean(errors, axis=0)).max() < 0.05
    assert np.sqrt(np.mean(np.square(errors))) < 0.08


def test_a_glint_in_the_flank_of_a_small_light_widens_its_covariance_toward_it(rng):
    sigmas = []
    for glint in (0.0, 45.0):
        image = canvas(rng)
        add_spot(image, 150.2, 120.4, peak=150.0, sigma=1.8)
        add_spot(image, 154.7, 120.4, peak=glint, sigma=1.2)
        spots = found(image)
        sigmas.append(np.sqrt(np.diag(spots.cov_px2[np.linalg.norm(spots.uv - (150.2, 120.4), axis=1).argmin()])))
    alone, beside = sigmas
    assert beside[0] > 2.0 * alone[0]
    assert beside[0] > beside[1]


def test_texture_around_a_light_widens_its_covariance(rng):
    sigmas = []
    for texture in (0.0, 40.0):
        image = canvas(rng)
        rows, columns = np.mgrid[0:240, 0:320]
        image += (
            texture * (np.sin(columns / 5.0) * np.sin(rows / 6.0) + 1.0) * (np.hypot(columns - 150, rows - 120) > 18)
        )
        add_disc(image, 150.3, 120.6, 6.0)
        spots = found(image)
        sigmas.append(np.sqrt(spots.cov_px2[np.linalg.norm(spots.uv - (150.3, 120.6), axis=1).argmin(), 0, 0]))
    assert sigmas[1] > 1.5 * sigmas[0]


@pytest.mark.parametrize("order", MOSAICS)
def test_a_mosaic_tells_blue_from_white(order, rng):
    image = canvas(rng, (240, 320))
    letters = np.array(list(order.removeprefix("bayer_"))).reshape(2, 2)
    share = np.tile(np.where(letters == "b", 1.0, 0.1), (120, 160))
    white = np.tile(np.where(letters == "b", 0.5, 1.0), (120, 160))
    for u, color in ((80.2, white), (240.7, share)):
        spot = np.zeros_like(image)
        add_spot(spot, u, 120.4, peak=120.0, sigma=2.0)
        image += spot * color
    frame = Frame("f", 7, to_picture(image), encoding=f"{order}8")
    spots = layers.label(frame, detect.lights(frame, CONFIG), LabelConfig())
    for u, rear in ((80.2, False), (240.7, True)):
        k = np.argmin(np.linalg.norm(spots.uv - (u, 120.4), axis=1))
        assert np.linalg.norm(spots.uv[k] - (u, 120.4)) < 0.2
        assert (spots.p_rear[k] > 0.5) == rear


def test_clear_water_makes_no_white_light_a_rear_one(rng):
    image = canvas(rng)
    add_spot(image, 160.0, 120.0, 120.0, 3.0)
    linear = (np.clip(image, 0, 255) - 20.0)[:, :, None] * (1.1, 1.0, 0.6) + 20.0  # it has lost red, then green
    frame = Frame("0", 0, to_picture(255.0 * (np.clip(linear, 0.0, 255.0) / 255.0) ** (1.0 / 2.2)))
    spots = layers.label(frame, detect.lights(frame, CONFIG), LabelConfig())
    assert spots.p_rear[spots.flux.argmax()] < 0.5


def test_a_dim_blue_light_shows_before_a_brighter_green_background(rng):
    image = np.stack([canvas(rng), canvas(rng, level=60.0), canvas(rng, level=10.0)], axis=2)
    add_spot(image[:, :, 0], 150.3, 120.6, peak=12.0)
    spots = found(image)
    assert np.linalg.norm(spots.uv[spots.p_light > 0.5] - (150.3, 120.6), axis=1) == pytest.approx([0.0], abs=0.5)


@pytest.mark.parametrize(
    ("sigma", "peak"), [(1.2, 12.0), (1.2, 60.0), (1.8, 30.0), (3.5, 60.0), (6.0, 120.0), (4.0, 900.0)]
)
def test_covariances_are_those_of_the_errors(sigma, peak, rng):
    nees = []
    for _ in range(6):
        image, places = canvas(rng, (400, 400), noise=2.0), []
        for k in range(9):
            u, v = 70.0 + 130.0 * (k % 3) + rng.uniform(-0.5, 0.5), 70.0 + 130.0 * (k // 3) + rng.uniform(-0.5, 0.5)
            add_spot(image, u, v, peak=peak, sigma=sigma)
            places.append((u, v))
        spots = found(image, DetectConfig(floor_px=1e-3, saturated_px=1e-3, signal_noise=1e-9))
        for place in places:
            k = np.argmin(np.linalg.norm(spots.uv - place, axis=1))
            error = spots.uv[k] - place
            nees.append(error @ np.linalg.solve(spots.cov_px2[k], error) / 2.0)
    assert 0.25 < np.mean(nees) < 1.6
    assert np.median(nees) < 1.2


@pytest.mark.parametrize("radius", [2.5, 3.5, 5.6])
def test_the_centre_of_an_overexposed_light_does_not_follow_the_grid(radius, rng):
    """A disc before a lens and a clipped mosaic, as a camera develops it: its edge is narrower than a sample."""
    errors, nees = [], []
    rows, columns = (np.mgrid[0:800, 0:800] - 2.0) / 5.0
    for _ in range(40):
        u, v = rng.uniform(79.0, 81.0, 2)
        fine = cv2.GaussianBlur((np.hypot(columns - u, rows - v) < radius).astype(float), (0, 0), 0.65 * 5.0)
        light = rng.uniform(20.0, 60.0) * fine.reshape(160, 5, 160, 5).mean(axis=(1, 3)) + 0.005
        raw = np.clip(rng.normal(4095.0 * light, 10.0), 0.0, 4095.0).astype(np.uint16)
        image = to_picture(255.0 * (cv2.demosaicing(raw, cv2.COLOR_BayerRG2BGR) / 4095.0) ** (1.0 / 2.2))
        coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1]
        spots = found(cv2.imdecode(coded, cv2.IMREAD_COLOR))
        k = np.linalg.norm(spots.uv - (u, v), axis=1).argmin()
        errors.append(spots.uv[k] - (u, v))
        nees.append(errors[-1] @ np.linalg.solve(spots.cov_px2[k], errors[-1]) / 2.0)
    assert np.sqrt(np.mean(np.square(errors))) < 0.033
    assert np.mean(nees) < 1.3


def test_what_may_be_two_lights_is_unsure_along_them(rng):
    image = canvas(rng, (400, 400))
    for shift in (-7.0, 7.0):
        add_disc(image, 200.0 + shift, 200.0, 8.0, peak=400.0)
    spots = found(image)
    if len(spots) == 1:
        sigma_u, sigma_v = np.sqrt(np.diag(spots.cov_px2[0]))
        assert sigma_u > 2.0 > 4.0 * sigma_v


def test_a_neighbour_halo_moves_no_centre(rng):
    image = canvas(rng, (600, 800))
    add_spot(image, 300.0, 300.0, peak=2000.0, sigma=5.0)
    add_spot(image, 300.0, 300.0, peak=100.0, sigma=40.0)
    add_spot(image, 360.4, 310.7, peak=60.0, sigma=1.6)
    spots = found(image)
    near = np.linalg.norm(spots.uv - (360.4, 310.7), axis=1)
    assert near.min() < 0.15


def drifting(rng, k, appeared):
    """Spots that drift by two pixels a frame; one comes up at frame `appeared`."""
    image = canvas(rng, (800, 1000))
    places = [(200.3 + 2.0 * k, 200.6), (700.2 + 2.0 * k, 250.9), (400.8 + 2.0 * k, 600.1)]
    for u, v in places:
        add_spot(image, u, v)
    if k >= appeared:
        add_spot(image, 850.4, 720.2)
    return Frame(str(k), k, to_picture(image)), np.array(places)


def test_a_tracked_search_keeps_its_lights_and_sees_a_new_one_within_a_sweep(rng):
    first, places = drifting(rng, 0, 5)
    scan = detect.Scan(first, CONFIG)
    detect.lights(first, CONFIG, scan)
    since = 0
    for k in range(1, 5 + detect.SWEEP + 4):
        frame, places = drifting(rng, k, 5)
        foretold = np.column_stack([places, np.full(3, 12.0)])
        spots = detect.lights(frame, CONFIG, scan, foretold)
        full = detect.lights(frame, CONFIG)
        for place in places:
            i, j = (np.argmin(np.linalg.norm(s.uv - place, axis=1)) for s in (spots, full))
            np.testing.assert_allclose(spots.uv[i], full.uv[j], atol=0.02)
        new = len(spots) and np.linalg.norm(spots.uv - (850.4, 720.2), axis=1).min() < 1.0
        since = since + 1 if k >= 5 and not new else since
        assert new or k < 5 + detect.SWEEP
    assert since < detect.SWEEP


def test_a_scan_made_for_another_camera_is_not_used(rng):
    small, large = (
        Frame("a", 0, to_picture(canvas(rng, (240, 320)))),
        Frame("b", 1, to_picture(canvas(rng, (300, 320)))),
    )
    scan = detect.Scan(small, CONFIG)
    assert scan.fits(small)
    assert not scan.fits(large)
    assert len(detect.lights(large, CONFIG, scan, np.zeros((1, 3)))) <= 1


@pytest.mark.parametrize("blobs", [0, 10_000])
def test_no_frame_takes_long(blobs, rng):
    """Work is capped: in pure noise, and in more blobs than any dock has."""
    image = canvas(rng, (2048, 2448), noise=30.0 if blobs == 0 else 2.0)
    for u, v in rng.integers(8, 2040, (blobs, 2)):
        image[v - 2 : v + 3, u - 2 : u + 3] += 100.0
    crowded, easy = Frame("0", 0, to_picture(image)), Frame("1", 1, to_picture(canvas(rng, (2048, 2448))))
    times = {}
    for name, frame in (("crowded", crowded), ("easy", easy)):
        scan = detect.Scan(frame, CONFIG)
        detect.lights(frame, CONFIG, scan)
        runs = []
        for _ in range(5):
            start = time.thread_time()
            spots = detect.lights(frame, CONFIG, scan)
            runs.append(time.thread_time() - start)
        times[name] = np.median(runs)
        assert len(spots) <= CONFIG.max_detections
    assert times["crowded"] < 20.0 * times["easy"]


@pytest.mark.parametrize("kind", ["mono8", "mono16", *(f"{order}8" for order in MOSAICS)])
def test_a_bad_pixel_is_no_lamp_and_the_sharpest_spot_of_a_lens_is_one(kind, rng):
    image = canvas(rng, (400, 480))
    lamps, bad = rng.uniform(40.0, 360.0, (4, 2)), rng.integers(40, 360, (8, 2))
    for k, (u, v) in enumerate(lamps):
        lamps[k] = 60.0 + 100.0 * k + u / 40.0, 60.0 + v / 40.0
        add_spot(image, *lamps[k], peak=90.0, sigma=0.9)
    for k, (u, v) in enumerate(bad):
        bad[k] = 40 + 55 * k + u % 4, 200 + v % 4
        image[bad[k, 1], bad[k, 0]] += rng.uniform(40.0, 200.0)
    spots = detect.lights(as_format(image, kind), CONFIG)
    distance = np.linalg.norm(spots.uv[:, None] - np.concatenate([lamps, bad])[None], axis=2)
    near = np.where(distance.min(axis=1) < 1.5, distance.argmin(axis=1), -1)
    assert set(near[spots.p_light > 0.5]) == {0, 1, 2, 3}
    assert spots.p_light[near >= 4].max(initial=0.0) < 0.1


@pytest.mark.parametrize("way", [(5.0, 0.0), (4.0, 1.0)])
def test_a_light_between_the_fields_of_interlaced_video_is_unsure_along_its_way(way, rng):
    fields = []
    for share in (-0.5, 0.5):
        image = canvas(rng, (200, 200))
        add_spot(image, 100.3 + share * way[0], 100.6 + share * way[1], peak=180.0, sigma=4.0)
        fields.append(image)
    woven = fields[0].copy()
    woven[1::2] = fields[1][1::2]
    still, moving = found(fields[0]), found(woven)
    k = np.argmin(np.linalg.norm(moving.uv - (100.3, 100.6), axis=1))
    along = np.array(way) / np.hypot(*way)
    before, after = (np.sqrt(along @ cov @ along) for cov in (still.cov_px2[0], moving.cov_px2[k]))
    assert after > 4.0 * before
    assert 0.5 < after / (np.hypot(*way) / np.sqrt(12.0)) < 2.5


def test_covariances_hold_in_noise_that_neighbours_share(rng):
    """As after demosaicing: every sample is an average of four, and noise averages out less than that of any one."""
    nees = []
    for _ in range(8):
        noise = rng.normal(0.0, 3.0, (401, 401))
        image = 60.0 + 0.5 * (noise[1:, 1:] + noise[:-1, 1:] + noise[1:, :-1] + noise[:-1, :-1])
        places = 70.0 + 130.0 * np.stack(np.divmod(np.arange(9), 3), axis=1) + rng.uniform(-0.5, 0.5, (9, 2))
        for u, v in places:
            add_spot(image, u, v, peak=60.0, sigma=1.3)
        spots = found(image, DetectConfig(floor_px=1e-3, signal_noise=1e-9))
        for place in places:
            k = np.argmin(np.linalg.norm(spots.uv - place, axis=1))
            error = spots.uv[k] - place
            nees.append(error @ np.linalg.solve(spots.cov_px2[k], error) / 2.0)
    assert 0.6 < np.mean(np.sort(nees)[:-1]) < 1.45


def test_a_faint_wide_light_is_as_unsure_as_it_is_wrong(rng):
    nees = []
    for _ in range(6):
        image, place = canvas(rng, (300, 300), noise=2.0), rng.uniform(140.0, 160.0, 2)
        add_spot(image, *place, peak=7.0, sigma=2.5)
        spots = found(image, DetectConfig(floor_px=1e-3))
        if len(spots):
            error = spots.uv[np.linalg.norm(spots.uv - place, axis=1).argmin()] - place
            k = np.linalg.norm(spots.uv - place, axis=1).argmin()
            nees.append(error @ np.linalg.solve(spots.cov_px2[k], error) / 2.0)
    assert len(nees) >= 3
    assert np.median(nees) < 3.0
