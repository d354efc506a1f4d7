"""The backtracking filter: prediction, update and association with lights missing and spurious detections about."""

import numpy as np
import pytest
from bench.shipped import shipped_camera, shipped_station

from lumidock.config import BtekfConfig
from lumidock.geometry import se3_exp, se3_inverse, se3_log
from lumidock.paper import btekf
from lumidock.pose import project_lights

CAMERA = shipped_camera()
P_DOCK = shipped_station().p_dock[:7]
CONFIG = BtekfConfig()
DT_NS = 150_000_000


def pose(x, y, z):
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = x, y, z
    return T


def moving(rng, z, frames=12):
    """True poses of a camera at constant twist, and the track after it has seen all of them but the last."""
    twist = np.array([*rng.uniform(-0.2, 0.2, 2), 1.0, *rng.uniform(-0.03, 0.03, 3)])
    poses = [pose(0.3, -0.2, z) @ se3_exp(twist * k * DT_NS * 1e-9) for k in range(frames)]
    track = btekf.start(0, poses[0], CAMERA, P_DOCK, CONFIG)
    for k in range(1, frames - 1):
        uv = project_lights(CAMERA, poses[k], P_DOCK) + rng.normal(0, 0.3, (7, 2))
        track = btekf.update(btekf.predict(track, k * DT_NS, CONFIG), CAMERA, P_DOCK, uv, CONFIG)
    return poses[-1], btekf.predict(track, (frames - 1) * DT_NS, CONFIG)


def test_prediction_follows_constant_twist_and_grows(rng):
    twist = rng.normal(0, 0.3, 6)
    track = btekf.LayerTrack(0, pose(0, 0, 9), twist, 0.01 * np.eye(12))
    ahead = btekf.predict(track, DT_NS, CONFIG)
    np.testing.assert_allclose(ahead.T_dock_cam, track.T_dock_cam @ se3_exp(0.15 * twist))
    assert np.linalg.eigvalsh(ahead.cov).min() > 0
    assert np.trace(ahead.cov[:6, :6]) > np.trace(track.cov[:6, :6])


def test_prediction_covariance_agrees_with_sampling(rng):
    twist, cov = np.array([0.2, -0.1, 1.0, 0.1, -0.2, 0.3]), np.diag(np.repeat([0.02, 0.01, 0.1, 0.05], 3)) ** 2
    track = btekf.LayerTrack(0, pose(0, 0, 9), twist, cov)
    quiet = BtekfConfig(accel_m_s2=1e-9, accel_rad_s2=1e-9)
    ahead = btekf.predict(track, 10**9, quiet)
    samples = rng.multivariate_normal(np.zeros(12), cov, 4000)
    landed = [
        se3_log(se3_inverse(ahead.T_dock_cam) @ track.T_dock_cam @ se3_exp(s[:6]) @ se3_exp(twist + s[6:]))
        for s in samples
    ]
    np.testing.assert_allclose(np.cov(np.array(landed).T), ahead.cov[:6, :6], atol=6e-4)


@pytest.mark.parametrize("z", [4.0, 9.0, 18.0])
@pytest.mark.parametrize(("missing", "spurious"), [(0, 0), (3, 0), (2, 3), (3, 5), (4, 0)])
def test_history_identifies_the_lights_that_are_left(rng, z, missing, spurious):
    for _ in range(4):
        T_dock_cam, predicted = moving(rng, z + 1.65)
        true = np.concatenate([rng.permutation(7)[missing:], np.full(spurious, -1)])
        uv = project_lights(CAMERA, T_dock_cam, P_DOCK)[true]
        away = rng.uniform(0, 2 * np.pi, spurious)
        clutter_uv = uv[0] + rng.uniform(60, 400, spurious)[:, None] * np.stack([np.cos(away), np.sin(away)], 1)
        uv[true < 0] = clutter_uv
        nearest = np.linalg.norm(clutter_uv[:, None] - project_lights(CAMERA, T_dock_cam, P_DOCK)[None], axis=2)
        if spurious and nearest.min() < 20:
            continue  # clutter on top of a light is not what is asked here
        track, light = btekf.correct(predicted, CAMERA, P_DOCK, uv + rng.normal(0, 0.3, uv.shape), CONFIG)
        assert light.tolist() == true.tolist()
        error = se3_log(se3_inverse(T_dock_cam) @ track.T_dock_cam)
        assert error @ np.linalg.solve(track.cov[:6, :6], error) < 35  # chi-square, 6 dof, 5e-6


def test_backtracks_out_of_clutter_that_is_nearer_than_the_light(rng):
    T_dock_cam, predicted = moving(rng, 9.0)
    uv = project_lights(CAMERA, T_dock_cam, P_DOCK)
    bait = project_lights(CAMERA, predicted.T_dock_cam, P_DOCK)[2] + [5.0, -6.0]
    _, light = btekf.correct(predicted, CAMERA, P_DOCK, np.concatenate([uv, bait[None]]), CONFIG)
    assert light.tolist() == [*range(7), -1]


def test_two_lights_or_pure_clutter_give_no_match(rng):
    _, predicted = moving(rng, 9.0)
    two = project_lights(CAMERA, predicted.T_dock_cam, P_DOCK)[:2]
    assert btekf.correct(predicted, CAMERA, P_DOCK, two, CONFIG) is None
    assert btekf.correct(predicted, CAMERA, P_DOCK, np.empty((0, 2)), CONFIG) is None
    assert btekf.correct(predicted, CAMERA, P_DOCK, rng.uniform(0, 300, (8, 2)), CONFIG) is None


def test_search_is_bounded(rng):
    T_dock_cam, predicted = moving(rng, 9.0)
    uv = project_lights(CAMERA, T_dock_cam, P_DOCK)
    assert btekf.correct(predicted, CAMERA, P_DOCK, uv, CONFIG) is not None
    assert btekf.correct(predicted, CAMERA, P_DOCK, uv, BtekfConfig(max_nodes=5)) is None


def test_without_the_missing_branch_one_dark_light_with_clutter_in_its_gate_voids_the_frame(rng):
    T_dock_cam, predicted = moving(rng, 9.0)
    uv = project_lights(CAMERA, T_dock_cam, P_DOCK)
    uv[6] += [9.0, -9.0]
    _, light = btekf.correct(predicted, CAMERA, P_DOCK, uv, CONFIG)
    assert light.tolist() == [0, 1, 2, 3, 4, 5, -1]
    assert btekf.correct(predicted, CAMERA, P_DOCK, uv, BtekfConfig(missing_branch=False)) is None


def test_without_its_own_noise_in_the_gate_a_certain_track_refuses_every_light():
    T = pose(0.0, 0.0, 9.0)
    certain = btekf.LayerTrack(0, T, np.zeros(6), 1e-12 * np.eye(12))
    uv = project_lights(CAMERA, T, P_DOCK) + np.array([0.7, -0.5])
    assert btekf.correct(certain, CAMERA, P_DOCK, uv, CONFIG)[1].tolist() == list(range(7))
    assert btekf.correct(certain, CAMERA, P_DOCK, uv, BtekfConfig(noise_in_gate=False)) is None


def test_associate_is_one_to_one_nearest_first():
    projected = np.array([[0.0, 0.0], [3.0, 0.0], [np.nan, np.nan]])
    uv = np.array([[1.0, 0.0], [0.5, 0.0], [50.0, 0.0]])
    assert btekf.associate(projected, uv, 4.0).tolist() == [1, 0, -1]
