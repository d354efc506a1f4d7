from dataclasses import replace

import numpy as np
import pytest
from conftest import assert_close
from numpy.testing import assert_array_equal
from scipy.spatial.transform import Rotation
from tracks import CAMERA, CONFIG, MODEL, STATION, M

from lumidock import match, verify
from lumidock.config import Config
from lumidock.datatypes import Attitude, Detections
from lumidock.geometry import se3_inverse
from lumidock.model import attitude_prior, light_of, measurements
from lumidock.pose import project_lights
from lumidock.sim.detections import simulated_frames
from lumidock.sim.scenario import load_scenario

HEAD_ON = np.diag([1.0, -1.0, -1.0])


def acquire(detections, config=CONFIG):
    found = measurements(detections, MODEL, config.match)
    return match.acquire(found, MODEL, CAMERA, attitude_prior(detections.attitude, config.prior), config.match)


def answer(found):
    return verify.is_answer(found, CONFIG.match)


def true_names(light):
    """The detection of each light (M,) from the light of each detection."""
    name = np.full(M, -1, np.int64)
    light = np.asarray(light)
    name[light[light >= 0]] = np.flatnonzero(light >= 0)
    return name


def wrong(name, light):
    """Names that are not the truth; a light that stays unnamed is none."""
    return int(((name >= 0) & (name != true_names(light))).sum())


def frames(scenario, *settings, seed=0):
    return list(simulated_frames(load_scenario(scenario, settings), STATION, CAMERA, seed))


def shuffled(detections, order):
    return replace(
        detections,
        **{key: getattr(detections, key)[order] for key in ("uv", "radius_px", "flux", "p_light", "p_rear")},
    )


def seen_from(T_dock_cam, lights, rng, *, noise_px=0.3, attitude=None):
    uv = project_lights(CAMERA, T_dock_cam, STATION.p_dock[lights]) + rng.normal(0, noise_px, (len(lights), 2))
    return replace(Detections.from_uv("f", 0, uv), attitude=attitude)


def pose(R_dock_cam, t):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R_dock_cam, t
    return T


def test_a_clear_view_is_named_beyond_doubt(rng):
    for frame in frames("missing-spurious", "path.count=25", "faults.missing=0", "faults.spurious=0"):
        order = rng.permutation(len(frame.light))
        found = acquire(shuffled(frame.detections, order))
        assert found.margin > CONFIG.match.margin
        assert answer(found)
        head = found.hypotheses[0]
        assert wrong(head.assignment, frame.light[order]) == 0
        assert (head.assignment >= 0).sum() == 7
        error = head.T_cam_dock @ frame.T_dock_cam
        assert np.linalg.norm(error[:3, 3]) < 0.05 * frame.T_dock_cam[2, 3]


def test_missing_and_spurious_lights_cost_no_wrong_name():
    accepted = 0
    for frame in frames("missing-spurious", "path.count=60", "faults.missing=3", "faults.spurious=3", seed=1):
        found = acquire(frame.detections)
        if answer(found):
            accepted += 1
            assert wrong(found.hypotheses[0].assignment, frame.light) == 0
    assert accepted >= 55


def test_the_order_of_detections_does_not_matter(rng):
    for frame in frames("missing-spurious", "path.count=20", "faults.missing=2", "faults.spurious=3", seed=2):
        order = rng.permutation(len(frame.light))
        one, other = acquire(frame.detections), acquire(shuffled(frame.detections, order))
        assert answer(one) == answer(other)
        assert_close(other.margin, one.margin, atol=1e-3)
        a, b = one.hypotheses[0].assignment, other.hypotheses[0].assignment
        assert_array_equal(np.where(b >= 0, order[b], -1), a)


def test_the_same_detections_give_the_same_bytes():
    for frame in frames("joint", "path.count=5"):
        one, other = acquire(frame.detections), acquire(frame.detections)
        assert one.margin == other.margin
        for a, b in zip(one.hypotheses, other.hypotheses, strict=True):
            assert_array_equal(a.assignment, b.assignment)
            assert_array_equal(a.T_cam_dock, b.T_cam_dock)
            assert a.log_evidence == b.log_evidence


def test_clutter_is_no_dock():
    found = [acquire(frame.detections) for frame in frames("clutter", "path.count=40")]
    assert not any(map(answer, found))


def test_the_mirror_image_of_the_dock_is_no_dock():
    seen = [frame.detections for frame in frames("mirror-only", "path.count=40")]
    assert np.mean([len(detections) for detections in seen]) > 8
    assert not any(answer(acquire(detections)) for detections in seen)


@pytest.mark.parametrize("label", ["wrong", "absent"])
def test_both_layers_are_named_without_their_colours(label):
    settings = (
        ["detections.wrong_layer=1.0"] if label == "wrong" else ["detections.wrong_layer=0.0", "detections.color=false"]
    )
    accepted = 0
    for frame in frames("joint", "path.count=30", "detections.drop=0.0", *settings, seed=3):
        found = acquire(frame.detections)
        if answer(found):
            accepted += 1
            assert wrong(found.hypotheses[0].assignment, frame.light) == 0
    assert accepted >= 25


def test_a_right_colour_is_evidence_and_a_wrong_one_is_against():
    def best(*settings):
        seen = frames("joint", "path.count=10", "detections.drop=0.0", *settings, seed=4)
        return np.array([acquire(frame.detections).hypotheses[0].log_evidence for frame in seen])

    right = best("detections.wrong_layer=0.0")
    assert (right > best("detections.wrong_layer=0.0", "detections.color=false")).all()
    assert (right > best("detections.wrong_layer=1.0") + 3.0).all()


@pytest.mark.parametrize("roll_deg", [-150, 75, 180])
def test_a_measured_attitude_names_a_rolled_camera(roll_deg, rng):
    lights, sigma = np.arange(7), np.deg2rad(2.0)
    for z in (5.0, 10.0, 16.0):
        turned = HEAD_ON @ Rotation.from_euler("z", roll_deg, degrees=True).as_matrix()
        R_dock_cam = turned @ Rotation.from_rotvec(rng.uniform(-0.04, 0.04, 3)).as_matrix()
        measured = R_dock_cam @ Rotation.from_rotvec(rng.normal(0, 0.5 * sigma, 3)).as_matrix()
        truth = pose(R_dock_cam, [0.2, -0.3, z])
        order = rng.permutation(7)
        seen = seen_from(truth, lights[order], rng, attitude=Attitude(measured, sigma))
        found = acquire(seen)
        assert answer(found)
        assert wrong(found.hypotheses[0].assignment, order) == 0
        assert (found.hypotheses[0].assignment >= 0).sum() == 7
        # without a sensor any roll is unlikely, but an array without symmetry fits in no other
        without = acquire(replace(seen, attitude=None))
        assert answer(without)
        assert wrong(without.hypotheses[0].assignment, order) == 0


@pytest.mark.parametrize("n", [0, 1, 2])
def test_fewer_than_three_detections_are_too_few(n, rng):
    found = acquire(seen_from(pose(HEAD_ON, [0, 0, 8.0]), np.arange(n), rng))
    assert (found.hypotheses, found.other_poses, found.reason) == ((), (), "too_few")
    assert not answer(found)
    assert not verify.is_answer(found, CONFIG.match)


def test_three_detections_alone_are_no_answer(rng):
    for lights in ([0, 2, 6], [0, 4, 5], [7, 9, 11]):
        assert not answer(acquire(seen_from(pose(HEAD_ON, [0, 0, 8.0]), np.array(lights), rng)))


def test_detections_that_hardly_look_like_lamps_stay_out(rng):
    for frame in frames("missing-spurious", "path.count=5", "faults.missing=0", "faults.spurious=0", seed=8):
        n, junk = len(frame.light), rng.uniform(0, 2000, (90, 2))
        uv = np.concatenate([frame.detections.uv, junk])
        order = rng.permutation(len(uv))
        p_light = np.where(np.arange(len(uv)) < n, 0.9, 0.2)
        found = acquire(replace(Detections.from_uv("f", 0, uv[order]), p_light=p_light[order]))
        light = np.concatenate([frame.light, np.full(len(junk), -1)])[order]
        assert answer(found)
        assert wrong(found.hypotheses[0].assignment, light) == 0


def test_a_frame_of_more_lamps_than_can_be_looked_at_is_no_answer(rng):
    found = acquire(Detections.from_uv("f", 0, rng.uniform(0, 2000, (199, 2))))
    assert (found.reason, found.hypotheses) == ("too_many", ())


@pytest.mark.parametrize("junk", [0, 12, 30])
def test_bounded_work_gives_the_answer_of_the_whole_search_or_none(junk, rng):
    """What is left unsearched never changes an answer that is given."""
    T_dock_cam = pose(HEAD_ON, [0.2, -0.3, 9.0])
    lights = np.flatnonzero(rng.random(M) < 0.8)
    uv = seen_from(T_dock_cam, lights, rng).uv
    seen = Detections.from_uv("f", 0, np.concatenate([uv, rng.uniform(0, 2000, (junk, 2))]))
    whole = acquire(seen, Config.model_validate({"match": {"max_work": 400_000}}))
    assert answer(whole)
    given = 0
    for work in (1, 30, 100, 300, 1000, 3000, 10_000, 30_000, 100_000):
        found = acquire(seen, Config.model_validate({"match": {"max_work": work}}))
        if answer(found):
            given += 1
            assert_array_equal(found.hypotheses[0].assignment, whole.hypotheses[0].assignment)
            assert_close(found.margin, whole.margin, atol=1e-9)
        else:
            assert found.reason == "too_many"
    assert given > 0


def test_detections_at_one_place_or_in_a_line_are_refused_quietly():
    for uv in (np.full((6, 2), 700.0), np.stack([np.linspace(200, 2200, 7), np.full(7, 900.0)], axis=1)):
        found = acquire(Detections.from_uv("f", 0, uv))
        assert not answer(found)
        assert np.isfinite(found.margin)


def test_centres_bring_their_covariance_or_get_the_configured_one():
    frame = frames("missing-spurious", "path.count=1", "faults.missing=0", "faults.spurious=0", seed=6)[0]
    cov = np.repeat(np.array([[[0.4, 0.1], [0.1, 0.2]]]), len(frame.light), axis=0)
    seen = measurements(replace(frame.detections, cov_px2=cov), MODEL, CONFIG.match)
    assert_array_equal(seen.cov, cov)
    assert_close(seen.var, 0.3)
    assert answer(acquire(replace(frame.detections, cov_px2=cov)))
    without = measurements(frame.detections, MODEL, CONFIG.match)
    assert_close(without.cov, np.repeat(np.eye(2)[None], len(frame.light), axis=0) * CONFIG.match.noise_px**2)


def test_likelihoods_are_of_the_right_layer():
    detections = replace(Detections.from_uv("f", 0, np.eye(3, 2)), p_rear=np.array([0.95, 0.05, np.nan]))
    like = measurements(detections, MODEL, CONFIG.match).like
    trusted = 0.5 + CONFIG.match.label_trust * 0.45
    high, low = np.log(2 * trusted), np.log(2 * (1 - trusted))
    assert_close(like, [[low, high], [high, low], [0.0, 0.0]])
    assert_array_equal(MODEL.is_rear, [0, 1])


def test_pairs_come_once_in_one_layer_and_count_down_what_is_unseen():
    for lights in map(STATION.lights_of, STATION.layers):
        mine = [tuple(sorted(pair)) for pair in MODEL.order.pairs.tolist() if pair[0] in lights]
        assert len(mine) == len(set(mine)) == len(lights) * (len(lights) - 1) // 2
        assert_array_equal(np.sort(MODEL.order.rank[lights]), np.arange(len(lights)))
    assert (STATION.layer[MODEL.order.pairs[:, 0]] == STATION.layer[MODEL.order.pairs[:, 1]]).all()
    assert (np.diff(MODEL.order.unseen) <= 0).all()
    # by definition: the most lights of one layer, no two of which are a pair before
    for k in (0, 5, 15, len(MODEL.order.pairs) - 1):
        before = {frozenset(pair) for pair in MODEL.order.pairs[:k].tolist()}
        most = 0
        for bits in range(1 << 7):
            for lights in map(STATION.lights_of, STATION.layers):
                some = [int(c) for j, c in enumerate(lights) if bits >> j & 1]
                if not any(frozenset((a, b)) in before for a in some for b in some if a < b):
                    most = max(most, len(some))
        assert MODEL.order.unseen[k] >= most


def test_planes_of_the_layers_hold_their_lights():
    for k, layer in enumerate(STATION.layers):
        point, normal = MODEL.planes[k, :3], MODEL.planes[k, 3:]
        assert_close(np.linalg.norm(normal), 1.0)
        assert_close((STATION.p_dock[STATION.lights_of(layer)] - point) @ normal, 0.0)


def test_the_best_pose_explains_its_names():
    for frame in frames("joint", "path.count=10", seed=7):
        found = acquire(frame.detections)
        for candidate in found.hypotheses[:1]:
            lights = np.flatnonzero(candidate.assignment >= 0)
            uv = project_lights(CAMERA, se3_inverse(candidate.T_cam_dock), STATION.p_dock[lights])
            off = uv - frame.detections.uv[candidate.assignment[lights]]
            assert np.sqrt((off**2).mean()) < 1.5


@pytest.mark.parametrize("scenario", ["missing-3", "joint"])
def test_every_pose_of_the_best_names_fits_them(scenario):
    """By reprojection alone: a second pose is one that the same pixels leave open."""
    seconds = 0
    for frame in frames(scenario, seed=6)[:150]:
        found = acquire(frame.detections)
        for other in found.other_poses:
            lights = np.flatnonzero(other.assignment >= 0)
            T_dock_cam = np.linalg.inv(other.T_cam_dock)
            off = (
                project_lights(CAMERA, T_dock_cam, STATION.p_dock[lights])
                - frame.detections.uv[other.assignment[lights]]
            )
            assert np.sqrt((off**2).mean()) < 3.0
            seconds += 1
    assert seconds > 20 or scenario == "joint"


def test_light_of_is_the_inverse_of_an_assignment(rng):
    for _ in range(20):
        n = 15
        name = np.where(rng.random(M) < 0.5, rng.permutation(n)[:M], -1)
        light = light_of(name, n)
        assert_array_equal(true_names(light), name)
        assert (light >= 0).sum() == (name >= 0).sum()


@pytest.mark.parametrize(
    ("a", "b", "expected"),
    [
        ([0, 1, -1], [0, 1, 2], False),
        ([0, 1, -1], [0, 2, -1], True),
        ([0, 1, -1], [-1, -1, 1], True),
        ([0, -1, -1], [-1, 1, -1], False),
        ([-1, -1, -1], [0, 1, 2], False),
    ],
)
def test_assignments_contradict_where_a_light_or_a_detection_has_two(a, b, expected):
    a, b = np.array(a), np.array(b)
    assert verify.contradict(a, b) == verify.contradict(b, a) == expected
