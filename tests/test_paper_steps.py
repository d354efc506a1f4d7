"""The steps of the paper's method one by one: normalisation, swarm, ratio filter, layers, guidance."""

import numpy as np
import pytest
from bench.shipped import shipped_camera, shipped_station
from hypothesis import given
from hypothesis import strategies as st

from lumidock.config import ConsistencyConfig, LayersConfig, PsoConfig
from lumidock.datatypes import Detections, Frame, LayerPose
from lumidock.paper.consistency import consistent
from lumidock.paper.guidance import Guidance
from lumidock.paper.layers import LayerDiscriminator, label_by_color, smaller_cluster
from lumidock.paper.normalize import normalize
from lumidock.paper.pso import register

FRONT = shipped_station().p_dock[:7, :2]


def similarity(xy, theta, s, shift):
    R = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    return s * xy @ R.T + shift


def test_normalize_is_undone_by_its_mean_and_scale(rng):
    xy = rng.normal(size=(9, 2)) * 300 + 50
    n = normalize(xy)
    np.testing.assert_allclose(n.mean + n.scale * n.points, xy)
    np.testing.assert_allclose(n.points.mean(axis=0), 0, atol=1e-12)
    assert np.abs(n.points).max() == pytest.approx(1.0)


@pytest.mark.parametrize("seen", [7, 6, 5, 4])
def test_swarm_identifies_the_lights_of_a_shifted_scaled_rolled_view(rng, seen):
    for _ in range(5):
        order = rng.permutation(7)[:seen]
        view = similarity(FRONT[order], rng.uniform(-0.15, 0.15), rng.uniform(10, 300), rng.uniform(-500, 500, 2))
        assert register(view, FRONT, None, PsoConfig(), rng).light.tolist() == order.tolist()


@pytest.mark.parametrize("spurious", [1, 2])
def test_swarm_gives_spurious_detections_no_light(rng, spurious):
    view = similarity(FRONT, 0.05, 100.0, np.array([20.0, -30.0]))
    view = np.concatenate([view, rng.uniform(-300, 300, (spurious, 2))])
    assert register(view, FRONT, None, PsoConfig(), rng).light.tolist() == [*range(7), *[-1] * spurious]


def test_residual_over_all_pairs_as_printed_has_no_minimum_at_the_alignment(rng):
    wrong = 0
    for _ in range(10):
        order = rng.permutation(7)[:5]
        view = similarity(FRONT[order], rng.uniform(-0.15, 0.15), 100.0, np.zeros(2))
        wrong += register(view, FRONT, None, PsoConfig(residual="all_pairs"), rng).light.tolist() != order.tolist()
    assert wrong >= 5


def test_swarm_is_repeatable_and_its_fitness_is_the_residual():
    view = similarity(FRONT, 0.1, 80.0, np.zeros(2))
    first, second = (register(view, FRONT, None, PsoConfig(), np.random.default_rng(5)) for _ in range(2))
    np.testing.assert_array_equal(first.transform, second.transform)
    residual = np.linalg.norm(first.placed - normalize(FRONT).points, axis=1).sum()
    assert first.fitness == pytest.approx(residual, rel=1e-9)


def test_a_roll_beyond_the_last_frames_costs_the_penalty_of_eq_7():
    config = PsoConfig(theta_deg=(-40.0, 40.0), w2=0.0)
    view = similarity(FRONT, np.deg2rad(-30.0), 80.0, np.zeros(2))
    free = register(view, FRONT, None, config, np.random.default_rng(1))
    held = register(
        view, FRONT, register(FRONT, FRONT, None, config, np.random.default_rng(1)), config, np.random.default_rng(1)
    )
    assert abs(np.rad2deg(free.transform[0])) == pytest.approx(30.0, abs=0.5)
    assert held.fitness > free.fitness + config.penalty


@given(theta=st.floats(-3, 3), s=st.floats(0.01, 100), x=st.floats(-1e3, 1e3), y=st.floats(-1e3, 1e3))
def test_ratio_filter_is_blind_to_similarities(theta, s, x, y):
    assert consistent(FRONT, similarity(FRONT, theta, s, np.array([x, y])), ConsistencyConfig())


@pytest.mark.parametrize("swap", [(0, 1), (0, 6), (3, 4), (2, 5)])
def test_ratio_filter_refuses_a_swapped_pair(swap):
    order = np.arange(7)
    order[list(swap)] = order[list(swap)[::-1]]
    assert not consistent(FRONT, 100.0 * FRONT[order], ConsistencyConfig())


def test_ratio_filter_refuses_mirror_images_clutter_and_coincident_detections():
    view = 100.0 * FRONT
    assert not consistent(FRONT, view[[0, 1, 2, 3, 4, 5, 5]], ConsistencyConfig())
    assert not consistent(FRONT, np.concatenate([view[:6], view[6:] + 40.0]), ConsistencyConfig())


@given(st.lists(st.floats(1, 100), min_size=2, max_size=12))
def test_smaller_cluster_is_the_least_variance_split(radii):
    x = np.array(radii)
    small = smaller_cluster(x)
    assert 0 < small.sum() < len(x)
    assert x[small].max() <= x[~small].min()

    def cost(members):
        return sum(part.var() * len(part) for part in (x[members], x[~members]) if len(part))

    every = [(np.arange(len(x)) < k)[np.argsort(np.argsort(x, kind="stable"))] for k in range(1, len(x))]
    assert cost(small) <= min(map(cost, every)) + 1e-6


def detections(radii, p_rear=None):
    d = Detections.from_uv("0", 0, np.zeros((len(radii), 2)))
    unknown = np.full(len(radii), np.nan)
    return Detections("0", 0, d.uv, np.array(radii, float), d.flux, d.p_light, unknown if p_rear is None else p_rear)


def test_radius_decides_the_layers_and_the_counter_the_last_group():
    discriminator = LayerDiscriminator(LayersConfig(dual_frames=2))
    assert not discriminator.rear(detections([8.0] * 5)).any()  # one group before any dual frame: front
    for _ in range(3):
        assert discriminator.rear(detections([8.0] * 5 + [3.0] * 6)).tolist() == [False] * 5 + [True] * 6
    assert discriminator.dual_frames == 3
    assert discriminator.rear(detections([8.0] * 5)).all()  # one group after enough of them: rear
    assert discriminator.rear(detections([8.0] * 9 + [3.0] * 3)).all()  # a cluster of three is no layer


def test_colour_decides_where_there_is_any_and_is_not_asked_when_told_so():
    p_rear = np.array([0.9, 0.1, 0.6])
    assert LayerDiscriminator(LayersConfig()).rear(detections([5, 5, 5], p_rear)).tolist() == [True, False, True]
    assert not LayerDiscriminator(LayersConfig(method="radius")).rear(detections([5, 5, 5], p_rear)).any()


def test_blue_is_read_from_the_ring_around_a_white_core():
    import cv2

    image = np.full((80, 160, 3), 15, np.uint8)
    for u, halo in ((40, (230, 90, 30)), (120, (180, 200, 190))):
        cv2.circle(image, (u, 40), 16, halo, -1)
        cv2.circle(image, (u, 40), 8, (255, 255, 255), -1)
    found = Detections.from_uv("0", 0, np.array([[40.0, 40.0], [120.0, 40.0]]))
    found = Detections("0", 0, found.uv, np.array([9.0, 9.0]), found.flux, found.p_light, found.p_rear)
    blue, white = label_by_color(Frame("0", 0, image), found, LayersConfig()).p_rear
    assert blue > 0.8
    assert white < 0.1
    assert np.isnan(label_by_color(Frame("0", 0, image[:, :, 0].copy()), found, LayersConfig()).p_rear).all()


def pose(layer, n_used):
    return LayerPose(layer, np.eye(4), n_used, "pso")


def test_guidance_goes_through_the_four_stages_and_hands_over_at_six_rear_lights():
    guidance = Guidance([("front", 7), ("rear", 6)])
    steps = [
        ({"front": 4}, "search", "front"),
        ({"front": 7}, "front", "front"),
        ({"front": 6, "rear": 5}, "transition", "front"),
        ({"front": 7, "rear": 6}, "transition", "rear"),
        ({"front": 5, "rear": 4}, "transition", "rear"),  # once handed over, it stays
        ({"front": 7, "rear": 3}, "transition", "front"),  # but not on three lights beside a better layer
        ({}, "transition", None),
        ({"front": 7}, "front", "front"),
        ({"front": 7, "rear": 5}, "transition", "rear"),
        ({"rear": 4}, "rear", "rear"),
        ({"rear": 6}, "rear", "rear"),
    ]
    for counts, stage, layer in steps:
        chosen = guidance.choose({name: pose(name, n) for name, n in counts.items()})
        assert guidance.stage == stage
        assert (chosen.layer if chosen else None) == layer


def test_camera_and_station_shipped_fit_the_paper():
    station, camera = shipped_station(), shipped_camera()
    assert [len(station.lights_of(name)) for name in ("front", "rear")] == [7, 6]
    assert (camera.width, camera.height) == (2448, 2048)
