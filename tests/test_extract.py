"""Light extraction from pictures, rendered and hand-made."""

import cv2
import numpy as np
import pytest
from bench.shipped import shipped_camera, shipped_station

from lumidock.config import ExtractConfig
from lumidock.datatypes import Frame
from lumidock.paper import extract
from lumidock.sim.scenario import load_scenario, trajectory
from lumidock.sim.sequence import render_frame

STATION, CAMERA = shipped_station(), shipped_camera()
CONFIG = ExtractConfig()


def rendered(z, seed=0, config=CONFIG):
    scenario = load_scenario("approach")
    poses = trajectory(scenario, np.random.default_rng(seed))[1]
    T = poses[np.argmin(np.abs(poses[:, 2, 3] - z))]
    image, seen, _ = render_frame(scenario, STATION, CAMERA, T, np.empty((0, 2)), [], np.random.default_rng(seed))
    return extract.lights(Frame("0", 0, image), config), seen


def found_and_false(detections, uv):
    distance = np.linalg.norm(detections.uv[:, None] - uv[None], axis=2)
    return (distance.min(axis=0) < 2.0), int((distance.min(axis=1) >= 2.0).sum())


@pytest.mark.parametrize(
    ("z", "front", "rear"), [(19.0, 7, 0), (9.0, 7, 6), (4.0, 7, 6), (2.4, 5, 6), (0.5, 0, 6), (-3.0, 0, 6)]
)
def test_finds_the_lights_of_the_approach_and_nothing_else(z, front, rear):
    detections, seen = rendered(z)
    lit = seen.lit.copy()
    found, false = found_and_false(detections, seen.uv[lit])
    names = np.flatnonzero(lit)[found]
    assert (names < 7).sum() >= front
    assert (names >= 7).sum() >= rear
    assert false == 0


@pytest.mark.parametrize("gray", ["max", "luma"])
@pytest.mark.parametrize("seed", range(3))
def test_either_gray_image_has_all_lights_at_14_m(gray, seed):
    detections, seen = rendered(14.0, seed, ExtractConfig(gray=gray))
    assert found_and_false(detections, seen.uv)[0].all()


def canvas(size=(700, 900), level=20):
    noise = np.random.default_rng(0).normal(level, 2, size)
    return np.clip(noise, 0, 255).astype(np.uint8)


def lights_of(image):
    return extract.lights(Frame("0", 0, image), CONFIG)


def test_a_bar_and_a_rim_are_no_lights_and_a_disc_is_one():
    image = canvas()
    cv2.rectangle(image, (40, 40), (240, 52), 250, -1)
    cv2.ellipse(image, (350, 120), (60, 60), 0, 20, 220, 250, 4)
    cv2.circle(image, (120, 300), 14, 250, -1, cv2.LINE_AA)
    detections = lights_of(image)
    assert len(detections) == 1
    np.testing.assert_allclose(detections.uv[0], [120, 300], atol=0.2)
    assert detections.radius_px[0] == pytest.approx(14, abs=1)


def test_touching_halos_are_cut_apart():
    image = canvas()
    for u in (200, 239):
        cv2.circle(image, (u, 200), 20, 250, -1, cv2.LINE_AA)
    detections = lights_of(image)
    np.testing.assert_allclose(np.sort(detections.uv[:, 0]), [200, 239], atol=1.5)


def test_a_light_cut_by_the_edge_keeps_its_centre():
    image = canvas()
    cv2.circle(image, (889, 200), 24, 250, -1, cv2.LINE_AA)  # the centre is 10 px inside
    np.testing.assert_allclose(lights_of(image).uv, [[889, 200]], atol=0.5)


@pytest.mark.parametrize("radius", [8, 24, 60])
@pytest.mark.parametrize("at", [(6, 300), (893, 300), (400, 5), (400, 694)])
def test_a_blurred_light_cut_by_any_edge_is_found(at, radius):
    image = canvas()
    cv2.circle(image, at, radius, 250, -1, cv2.LINE_AA)
    np.testing.assert_allclose(lights_of(cv2.GaussianBlur(image, (0, 0), 2.0)).uv, [at], atol=0.7)


@pytest.mark.parametrize("level", [0, 20, 255])
def test_an_even_picture_has_no_lights(level):
    assert len(lights_of(np.full((300, 400), level, np.uint8))) == 0
    assert len(lights_of(canvas(level=level))) == 0


def test_noise_and_ten_thousand_specks_stay_bounded():
    image = np.random.default_rng(1).integers(0, 255, (600, 800)).astype(np.uint8)
    assert len(lights_of(image)) <= CONFIG.max_regions
    specks = canvas((1200, 1600))
    at = np.random.default_rng(2).integers(2, 1198, (10_000, 2))
    specks[at[:, 0], at[:, 1]] = 255
    assert len(lights_of(specks)) <= CONFIG.max_regions


def test_otsu_parts_two_levels_and_agrees_with_opencv(rng):
    levels = np.concatenate([rng.normal(60, 10, 5000), rng.normal(180, 15, 3000)]).clip(0, 255).astype(np.uint8)
    expected, _ = cv2.threshold(levels[None], 0, 255, cv2.THRESH_OTSU)
    assert extract.otsu(np.bincount(levels, minlength=256), 0) == expected
    assert extract.otsu(np.bincount([7], minlength=256), 7) == 7


def test_circle_fit_is_exact_on_a_circle_and_on_an_arc(rng):
    for reach in (2 * np.pi, 1.0):
        angle = rng.uniform(0, reach, 40)
        points = np.array([30.0, -12.0]) + 9.0 * np.stack([np.cos(angle), np.sin(angle)], 1)
        center, radius = extract.fit_circle(points)
        np.testing.assert_allclose(center, [30, -12], atol=1e-8)
        assert radius == pytest.approx(9.0)
