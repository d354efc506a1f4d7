"""Each baseline shows a property that its own paper states, before it is compared with anything."""

import math
from itertools import permutations

import numpy as np
import pytest
from bench import learned_matcher
from bench.shipped import shipped_camera, shipped_station

from lumidock.baselines import (
    ASSOCIATIONS,
    BaselineLocalizer,
    cpd,
    hungarian,
    learned,
    neighbours,
    p3p,
    plain_pso,
    pnp,
    ransac,
    vote,
)
from lumidock.baselines.view import view_of
from lumidock.config import Config
from lumidock.datatypes import Detections
from lumidock.geometry import se3_exp, se3_inverse, se3_log, transform_points
from lumidock.methods import BASELINES
from lumidock.pose import project_lights

STATION, CAMERA = shipped_station(), shipped_camera()
FRONT = STATION.lights_of("front")


def head_on(z, x=0.0, turn=(0.0, 0.0, 0.0)):
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[0, 3], T[2, 3] = x, z
    return T @ se3_exp(np.array([0.0, 0.0, 0.0, *turn]))


def view_from(T, lights=FRONT, spurious=(), noise=None):
    uv = project_lights(CAMERA, T, STATION.p_dock[lights])
    uv = np.concatenate([uv, np.array(spurious, float).reshape(-1, 2)])
    uv = uv if noise is None else uv + noise
    return view_of(CAMERA, STATION.p_dock[FRONT], STATION.axis[FRONT], uv)


# Perspective three points


def test_p3p_finds_the_true_pose_among_at_most_four(rng):
    """Grunert: up to four solutions; the pose that made the rays is one of them."""
    found, counts = 0, []
    for _ in range(300):
        T_cam_dock = se3_exp(np.array([*rng.uniform(-1, 1, 2), rng.uniform(3, 12), *rng.normal(0, 0.8, 3)]))
        p_dock = rng.uniform(-1, 1, (3, 3))
        p_cam = transform_points(T_cam_dock, p_dock)
        ray = p_cam / np.linalg.norm(p_cam, axis=1, keepdims=True)
        poses = p3p.solve(ray[None], p_dock[None])
        counts.append(len(poses))
        errors = [
            np.linalg.norm(se3_log(se3_inverse(poses.T_dock_cam(k)) @ se3_inverse(T_cam_dock)))
            for k in range(len(poses))
        ]
        found += bool(errors) and min(errors) < 1e-3
    assert max(counts) <= 4
    assert max(counts) >= 3  # several are common
    assert found >= 297


def test_every_p3p_solution_reprojects_onto_its_three_rays(rng):
    p_dock, ray = rng.uniform(-1, 1, (500, 3, 3)), rng.normal(0, 0.3, (500, 3, 3)) + np.array([0, 0, 1])
    ray /= np.linalg.norm(ray, axis=2, keepdims=True)
    poses = p3p.solve(ray, p_dock)
    assert len(poses) > 100
    for k, row in enumerate(poses.problem):
        p_cam = transform_points(se3_inverse(poses.T_dock_cam(k)), p_dock[row])
        np.testing.assert_allclose(p_cam / np.linalg.norm(p_cam, axis=1, keepdims=True), ray[row], atol=2e-3)


# Hungarian


def test_hungarian_is_as_cheap_as_the_best_of_all_permutations(rng):
    """Kuhn: the assignment is the optimum; and without a search it only bears small shifts."""
    view = view_from(head_on(9.0, 0.2))
    assert hungarian.associate(view, rng).tolist() == list(range(7))
    gap = np.linalg.norm(
        hungarian.normalized(view.xy_up)[:, None] - hungarian.normalized(view.p_dock[:, :2])[None], axis=2
    )
    cheapest = min(sum(gap[i, j] for i, j in enumerate(order)) for order in permutations(range(7)))
    assert sum(gap[i, i] for i in range(7)) == pytest.approx(cheapest)


def test_hungarian_alone_fails_where_half_the_array_is_missing(rng):
    light = hungarian.associate(view_from(head_on(9.0), FRONT[:4]), rng)
    assert light.tolist() != [0, 1, 2, 3]


# Plain PSO


def test_constricted_swarm_solves_the_sphere_function_in_the_published_number_of_iterations():
    """Eberhart and Shi, 2000: 30 particles, 30 dimensions, +-100, error under 0.01 after 530 iterations on average."""
    bounds = (np.full(30, -100.0), np.full(30, 100.0))
    needed = []
    for seed in range(6):
        found = plain_pso.minimize(lambda x: (x**2).sum(axis=1), bounds, (30, 1200), np.random.default_rng(seed))
        needed.append(int(np.argmax(found.values < 0.01)))
        assert found.values[-1] < 0.01
    assert 400 < np.mean(needed) < 700


def test_plain_swarm_finds_a_rolled_and_scaled_view(rng):
    right = [
        plain_pso.associate(view_from(head_on(9.0, 0.3, (0.0, 0.0, 0.1)), FRONT[:6]), rng).tolist() == [*range(6)]
        for _ in range(8)
    ]
    assert sum(right) >= 7


# Exhaustive P3P with a vote


@pytest.mark.parametrize(("n", "m"), [(4, 7), (7, 7), (9, 7)])
def test_vote_tries_as_many_poses_as_its_paper_says(n, m):
    """Faessler et al., section III-C: C(n, 3) times m! / (m - 3)! combinations."""
    seen, lights = vote.problems(n, m)
    assert len(seen) == len(lights) == math.comb(n, 3) * math.perm(m, 3)
    assert len(np.unique(np.concatenate([seen, lights], axis=1), axis=0)) == len(seen)


def test_vote_survives_false_detections_and_occluded_lights_together(rng):
    """The same paper: the initialisation bears false detections and occlusions, which one-to-one methods do not."""
    right = 0
    for _ in range(10):
        T = head_on(rng.uniform(4, 10), rng.uniform(-0.5, 0.5), rng.normal(0, 0.05, 3))
        lights = np.delete(FRONT, rng.integers(7))
        light = vote.associate(view_from(T, lights, rng.uniform([300, 300], [2100, 1700], (2, 2))), rng)
        right += light is not None and light.tolist() == [*lights, -1, -1]
    assert right >= 9


# Neighbours


def test_neighbour_search_is_linear_where_the_vote_is_not_and_finds_the_same(rng):
    for n in (7, 9):
        spurious = rng.uniform([300, 300], [2100, 1700], (n - 7, 2))
        view = view_from(head_on(6.0, 0.2), spurious=spurious)
        seen, _ = neighbours.problems(view)
        assert len(seen) == n * math.comb(neighbours.NEAR_DETECTIONS, 2) * 7 * math.perm(neighbours.NEAR_LIGHTS, 2)
        assert len(seen) < 0.4 * len(vote.problems(n, 7)[0])
        assert neighbours.associate(view, rng).tolist() == [*range(7), *[-1] * (n - 7)]


def test_a_light_that_shines_away_is_not_visible():
    T_cam_dock = se3_inverse(head_on(6.0))
    poses = p3p.Poses(T_cam_dock[None, :3, :3], T_cam_dock[None, :3, 3], np.zeros(1, np.int64))
    view = view_from(head_on(6.0))
    view.axis[2] *= -1.0
    assert neighbours.visible(view, poses).tolist() == [[True, True, False, True, True, True, True]]


# RANSAC


def test_ransac_draws_as_often_as_fischler_and_bolles_say(rng):
    """Their section II-B: k = log(1 - z) / log(1 - b); after so many draws a good one is missing in 1 - z of cases."""
    good = 0.05
    k = ransac.draws_wanted(good, 0.95)
    assert k == math.ceil(math.log(0.05) / math.log(0.95))
    missed = (rng.random((4000, k)) >= good).all(axis=1).mean()
    assert missed == pytest.approx(0.05, abs=0.012)
    assert ransac.share_of_good_draws(7, 7, 0) == pytest.approx(1 / 210)


def test_ransac_finds_the_lights_among_spurious_detections(rng):
    right = 0
    for _ in range(10):
        view = view_from(head_on(6.0, 0.3), spurious=rng.uniform([300, 300], [2100, 1700], (2, 2)))
        light = ransac.associate(view, rng)
        right += light is not None and light.tolist() == [*range(7), -1, -1]
    assert right >= 8


# Coherent point drift


def test_drift_never_raises_its_objective_and_recovers_a_similarity_among_outliers(rng):
    """Myronenko and Song: expectation maximisation, so the objective falls; w accounts for outliers."""
    model = rng.normal(size=(60, 2))
    a = np.deg2rad(40.0)
    R = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    data = np.concatenate([1.3 * model @ R.T + [0.4, -0.2], rng.uniform(-4, 4, (15, 2))])
    found = cpd.register(data, model, 0.3)
    assert (np.diff(found.objective) <= 1e-6).all()
    np.testing.assert_allclose(found.R, R, atol=0.02)
    assert found.scale == pytest.approx(1.3, rel=0.02)


def test_drift_is_local_and_misses_a_half_turn(rng):
    """The same paper, section 7.1: rigid registration holds to some 70 degrees of rotation."""
    model = rng.normal(size=(60, 2)) * [2.0, 1.0]
    found = cpd.register(-model @ np.array([[0.98, -0.2], [0.2, 0.98]]).T, model)
    assert found.R[0, 0] > 0.5


# A learned matcher


def test_embeddings_do_not_depend_on_the_order_of_the_points(rng):
    """Zaheer et al.: a sum over the set, so that a permutation of the points permutes their embeddings alike."""
    net, xy, order = learned_matcher.begun(rng), rng.normal(size=(1, 9, 2)), rng.permutation(9)
    first = learned.encode(net, xy, np.ones((1, 9))).out
    np.testing.assert_allclose(learned.encode(net, xy[:, order], np.ones((1, 9))).out, first[:, order], atol=1e-12)


def test_padding_changes_no_embedding(rng):
    net, xy = learned.network(), rng.normal(size=(1, 9, 2))
    there = np.array([[1.0] * 6 + [0.0] * 3])
    alone = learned.encode(net, xy[:, :6], there[:, :6]).out
    np.testing.assert_allclose(learned.encode(net, xy, there).out[:, :6], alone, atol=1e-12)


def test_gradient_of_the_training_is_the_slope_of_its_loss(rng):
    net = learned_matcher.begun(rng)
    shifted = {f"b{k}": rng.normal(0, 0.03, getattr(net, f"b{k}").shape) for k in (1, 2, 3, 4)}  # off the kinks at 0
    net = net._replace(**shifted)
    batch = learned_matcher.batch_of([learned_matcher.drawn(rng, 1, 2) for _ in range(5)])
    _, gradient = learned_matcher.loss_and_gradient(net, batch)
    for name in net._fields:
        step = np.zeros_like(getattr(net, name))
        place = tuple(rng.integers(size) for size in step.shape)
        step[place] = 1e-5
        beside = [net._replace(**{name: getattr(net, name) + sign * step}) for sign in (1, -1)]
        high, low = (learned_matcher.loss_and_gradient(one, batch)[0] for one in beside)
        assert getattr(gradient, name)[place] == pytest.approx((high - low) / 2e-5, rel=1e-4, abs=1e-8), name


def test_trained_network_holds_on_layouts_that_it_was_not_trained_on():
    assert learned_matcher.held_out(0, 0) > 0.9


# Poses from identified lights


def test_solvers_are_exact_on_exact_pixels_and_ippe_gives_both_poses_of_a_plane():
    T = head_on(8.0, 0.4, (0.1, -0.1, 0.05))
    for solver in pnp.SOLVERS:  # OpenCV's EPnP has no case for planes: there its first pose may be the other one
        p_dock = STATION.p_dock[FRONT] if solver != "EPnP" else STATION.p_dock
        first, *others = pnp.solutions(solver, CAMERA, p_dock, project_lights(CAMERA, T, p_dock))
        assert np.linalg.norm(se3_log(se3_inverse(first) @ T)) < 1e-3, solver
        assert len(others) == (solver == "IPPE")
    assert pnp.solutions("IPPE", CAMERA, STATION.p_dock, project_lights(CAMERA, T, STATION.p_dock)) == []


def test_sqpnp_never_leaves_more_than_epnp(rng):
    """Terzakis and Lourakis: the global optimum; EPnP is a linear relaxation."""
    for _ in range(40):
        T = head_on(rng.uniform(4, 16), rng.uniform(-1, 1), rng.normal(0, 0.1, 3))
        p, uv = STATION.p_dock, project_lights(CAMERA, T, STATION.p_dock) + rng.normal(0, 0.5, (13, 2))
        left = {s: pnp.solutions(s, CAMERA, p, uv)[0] for s in ("SQPnP", "EPnP")}
        rms = {s: np.sqrt(((project_lights(CAMERA, pose, p) - uv) ** 2).mean()) for s, pose in left.items()}
        assert rms["SQPnP"] <= rms["EPnP"] * 1.02


# Behind the two entries


def test_methods_know_every_baseline():
    assert tuple(ASSOCIATIONS) == BASELINES


@pytest.mark.parametrize("name", BASELINES)
def test_baseline_gives_the_exact_pose_of_a_clean_frame_and_refuses_too_few(name):
    localizer = BaselineLocalizer(ASSOCIATIONS[name], STATION, CAMERA, Config())
    T = head_on(9.0, 0.2)
    uv = project_lights(CAMERA, T, STATION.p_dock)
    p_rear = (STATION.layer == STATION.layers.index("rear")).astype(float)
    fix = localizer.process_detections(Detections.from_uv("0", 0, uv, p_rear=p_rear))
    assert fix.valid
    assert fix.match.light.tolist() == list(range(13))
    assert np.linalg.norm(se3_log(se3_inverse(fix.T_dock_cam) @ T)) < 1e-3
    assert localizer.process_detections(Detections.from_uv("1", 1, uv[:3])).reason == "too_few"
    assert localizer.process_detections(Detections.from_uv("2", 2, uv[:0])).reason == "no_lights"


@pytest.mark.parametrize("name", BASELINES)
def test_baseline_repeats_itself_after_it_forgets(name, rng):
    localizer = BaselineLocalizer(ASSOCIATIONS[name], STATION, CAMERA, Config())
    uv = project_lights(CAMERA, head_on(9.0), STATION.p_dock[FRONT]) + rng.normal(0, 0.5, (7, 2))
    first = localizer.process_detections(Detections.from_uv("0", 0, uv))
    localizer.forget()
    second = localizer.process_detections(Detections.from_uv("0", 0, uv))
    np.testing.assert_array_equal(first.match.light, second.match.light)
