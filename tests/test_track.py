"""The filter: prediction, update, and what it holds of survey and calibration."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from conftest import assert_close, called, numeric_jacobian
from numpy.testing import assert_array_equal
from tracks import (
    BOTH,
    CAMERA,
    CONFIG,
    FRONT,
    PLAN,
    PRIOR,
    STATION,
    STEP_NS,
    M,
    begun,
    frames_of,
    head_on,
    named,
    pixels,
    spots_at,
)

from lumidock import integrity, match, track
from lumidock._kernels.tracking import track as kernel
from lumidock._kernels.tracking.levels import outputs
from lumidock.datatypes import Attitude
from lumidock.evaluation import claims
from lumidock.geometry import bearing_and_range, se3_adjoint, se3_exp, se3_inverse, so3_exp, so3_log
from lumidock.localizer import Localizer


@cache
def followed():
    """The first belief of a localizer after each of 100 frames of the approach in which the second layer appears."""
    settings = ("path.start_z_m=18", "path.end_z_m=11", "path.frame_interval_s=0.0666667", "detections.survey=true")
    localizer, beliefs = Localizer(STATION, CAMERA), []
    for frame in frames_of("approach", *settings)[:100]:
        localizer.process_detections(frame.detections)
        beliefs.append(localizer.beliefs[0] if localizer.locked else None)
    return [belief for belief in beliefs if belief is not None]


def known_rows(P):
    """The states that are not fixed at zero: without an attitude sensor there is no bias."""
    return np.flatnonzero(np.diagonal(P) > 0.0)


def correlation(P):
    rows = known_rows(P)
    s = np.sqrt(np.diagonal(P)[rows])
    return P[np.ix_(rows, rows)] / np.outer(s, s)


def jacobian(belief, lights):
    """H (2 K, n) of the filter's pixels by central differences, state by state."""
    n = len(belief.P)

    def function(dx):
        x = belief.x + np.concatenate([np.zeros(6), dx[6:]])
        return pixels(belief.T_cam_dock @ se3_exp(dx[:6]), x, lights).ravel()

    return numeric_jacobian(function, np.zeros(n), step=1e-5)


def claimed(belief):
    """Covariance (6, 6) in dock axes and the pose of a belief."""
    bound = integrity.bounds([belief], CONFIG.integrity)
    return bound.covariance, bound.T_dock_cam


def test_predict_agrees_with_the_group_and_with_dense_algebra(rng):
    belief = begun(head_on(), BOTH, rng)
    x = belief.x.copy()
    x[6:12] = [0.4, -0.2, 0.8, 0.02, -0.05, 0.1]
    P = belief.P + 1e-6 * (lambda A: A @ A.T)(rng.normal(size=belief.P.shape))
    belief = replace(belief, x=x, P=P)
    dt = 0.07
    later = track.predict(belief, 70_000_000, CONFIG.track)
    assert later.t_ns == 70_000_000
    assert_close(later.T_cam_dock, se3_exp(-dt * x[6:12]) @ belief.T_cam_dock, atol=1e-5)  # translation to second order
    assert_array_equal(later.x, x)
    A = se3_adjoint(se3_inverse(later.T_cam_dock))
    F = np.eye(len(P))
    F[:6, 6:12] = -dt * A
    q = np.diag(np.repeat([CONFIG.track.accel_m_s2**2, CONFIG.track.accel_rad_s2**2], 3))
    expected = F @ P @ F.T
    expected[:6, :6] += A @ q @ A.T * dt**3 / 3
    expected[:6, 6:12] -= A @ q * dt**2 / 2
    expected[6:12, :6] -= (A @ q).T * dt**2 / 2
    expected[6:12, 6:12] += q * dt
    assert_close(later.P, expected, rtol=1e-9, atol=1e-12)


def test_without_motion_the_pose_stays_and_its_covariance_grows(rng):
    belief = begun(head_on(), BOTH, rng)
    assert_array_equal(belief.x[6:12], np.zeros(6))
    before = belief
    for k in range(1, 6):
        after = track.predict(before, k * STEP_NS, CONFIG.track)
        assert_close(after.T_cam_dock, belief.T_cam_dock, atol=1e-12)
        grown = after.P[:12, :12] - before.P[:12, :12]
        assert np.linalg.eigvalsh(grown[:6, :6])[0] > -1e-12
        assert (np.diagonal(grown)[:6] > 0).all()
        assert_array_equal(after.P[12:, 12:], before.P[12:, 12:])
        before = after


@pytest.mark.parametrize("joint", [False, True])
def test_update_is_the_schmidt_kalman_filters(joint, rng):
    """Exact pixels move nothing, and the covariance is that of dense algebra with numeric derivatives."""
    belief = replace(begun(head_on(), BOTH, rng), joint=joint)
    slow, n = track.slow_states(STATION, None)[1], len(belief.P)
    P = slow.copy()
    P[:12, :12] = np.diag([0.04, 0.03, 0.09, 1e-4, 2e-4, 1e-4, *[0.01] * 3, *[1e-4] * 3])
    belief = replace(belief, P=P, joint=joint)
    lights = np.array([0, 2, 4, 6, 8, 11, 12]) if joint else np.array([0, 2, 4, 6, 8, 11])
    uv = pixels(belief.T_cam_dock, belief.x, lights)
    after = track.update(belief, named(lights), spots_at(uv), PLAN, CONFIG.track)
    assert_close(after.T_cam_dock, belief.T_cam_dock, atol=1e-9)
    assert after.joint == joint
    H, C = jacobian(belief, lights), np.eye(2 * len(lights)) * CONFIG.match.noise_px**2
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + C)
    K[n if joint else kernel.CALIBRATION :] = 0.0
    keep = np.eye(n) - K @ H
    expected = keep @ P @ keep.T + K @ C @ K.T
    scale = np.sqrt(np.diagonal(P)) + 1e-9
    assert_close(after.P / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-5)
    assert_close(after.nis, 0.0, atol=1e-9)


def test_nis_is_that_of_the_innovation(rng):
    belief = replace(begun(head_on(), BOTH, rng), joint=True)
    uv = pixels(belief.T_cam_dock, belief.x, BOTH) + rng.normal(0, 0.4, (M, 2))
    after = track.update(belief, named(BOTH), spots_at(uv), PLAN, CONFIG.track)
    H, C = jacobian(belief, BOTH), np.eye(2 * M) * CONFIG.match.noise_px**2
    nu = (uv - pixels(belief.T_cam_dock, belief.x, BOTH)).ravel()
    assert_close(after.nis, nu @ np.linalg.solve(H @ belief.P @ H.T + C, nu), rtol=0.01)
    moved = se3_inverse(belief.T_cam_dock) @ after.T_cam_dock
    expected = belief.P @ H.T @ np.linalg.solve(H @ belief.P @ H.T + C, nu)
    assert_close(moved[:3, 3], expected[:3], rtol=0.02, atol=1e-4)
    assert_close(so3_log(moved[:3, :3]), expected[3:6], rtol=0.02, atol=1e-5)


@pytest.mark.parametrize("lights", [BOTH, np.array([0, 2, 4, 6]), np.array([7, 9, 11])], ids=["both", "front", "rear"])
def test_an_update_never_adds_to_the_poses_covariance(lights, rng):
    belief = begun(head_on(), BOTH if len(lights) == M else FRONT, rng)
    for k in range(1, 10):
        before = track.predict(belief, k * STEP_NS, CONFIG.track)
        uv = pixels(before.T_cam_dock, before.x, lights) + rng.normal(0, 0.5, (len(lights), 2))
        belief = track.update(before, named(lights), spots_at(uv), PLAN, CONFIG.track)
        less = before.P[:6, :6] - belief.P[:6, :6]
        s = np.sqrt(np.diagonal(before.P)[:6])
        assert np.linalg.eigvalsh(less / np.outer(s, s))[0] > -1e-9


def test_the_covariance_stays_symmetric_and_positive_over_an_approach():
    beliefs = followed()
    assert len(beliefs) > 90
    for belief in beliefs:
        assert np.isfinite(belief.P).all()
        assert_close(correlation(belief.P), correlation(belief.P).T, atol=1e-9)
        assert np.linalg.eigvalsh(correlation(belief.P))[0] > 1e-12
        assert_close(belief.R @ belief.R.T, np.eye(3), atol=1e-9)


def test_survey_and_calibration_are_only_considered_before_both_layers_are_seen():
    prior = track.slow_states(STATION, None)[1][kernel.CALIBRATION :, kernel.CALIBRATION :]
    beliefs = followed()
    alone, joint = [b for b in beliefs if not b.joint], [b for b in beliefs if b.joint]
    assert len(alone) > 5
    assert len(joint) > 20
    for belief in alone:
        assert_array_equal(belief.P[kernel.CALIBRATION :, kernel.CALIBRATION :], prior)
        assert not belief.x[kernel.CALIBRATION :].any()
    sums = [np.trace(b.P[kernel.LIGHTS :, kernel.LIGHTS :]) for b in joint]
    focal = [b.P[kernel.CALIBRATION, kernel.CALIBRATION] for b in joint]
    assert sums[0] < np.trace(prior[3:, 3:])
    assert (np.diff(sums) <= 1e-15).all()
    assert (np.diff(focal) <= 1e-15).all()
    assert sums[-1] < 0.99 * np.trace(prior[3:, 3:])
    assert joint[-1].x[kernel.CALIBRATION :].any()
    # once joint, always joint
    assert [b.joint for b in beliefs] == sorted(b.joint for b in beliefs)


def test_cold_frames_are_as_far_off_as_they_say():
    """Both layers in view, lights and lens off by what the station allows: mean NEES of the pose."""
    settings = ("path.count=200", "detections.drop=0.0", "detections.survey=true", "detections.calibration=true")
    squares = []
    for frame in frames_of("joint", *settings, seed=8):
        name = np.full(M, -1, np.int64)
        name[frame.light[frame.light >= 0]] = np.flatnonzero(frame.light >= 0)
        seen = match.spots(frame.detections, PLAN, CONFIG.match)
        slow = track.slow_states(STATION, None)
        guess = se3_inverse(frame.T_dock_cam)
        belief = track.start(guess, name, 0, seen, PLAN, PRIOR, slow, CONFIG.track)
        P, T_dock_cam = claimed(belief)
        squares.append(claims.nees(claims.pose_error(T_dock_cam, frame.T_dock_cam)[None], P[None])[0])
    assert len(squares) == 200
    assert 5.0 < np.mean(squares) < 7.0


def test_leaving_a_light_out_does_what_apart_says(rng):
    """Solution separation from the posterior against the solution without the light, solved anew."""
    belief = replace(begun(head_on(), BOTH, rng), joint=True)
    before = track.predict(belief, STEP_NS, CONFIG.track)
    uv = pixels(before.T_cam_dock, before.x, BOTH) + rng.normal(0, 0.1, (M, 2))
    seen = spots_at(uv)
    full = track.update(before, named(BOTH), seen, PLAN, CONFIG.track)
    C = called(outputs)(full.R, full.t)

    def nine(b):
        return C @ b.P[:6, :6] @ C.T

    for c in range(M):
        name = named(BOTH)
        name[c] = -1
        less = track.update(before, name, seen, PLAN, CONFIG.track)
        T_full, T_less = se3_inverse(full.T_cam_dock), se3_inverse(less.T_cam_dock)
        guide = np.array(bearing_and_range(T_less)) - np.array(bearing_and_range(T_full))
        moved = np.concatenate([claims.pose_error(T_full, T_less), guide])  # an error is estimate minus truth
        sigma = np.sqrt(np.diagonal(nine(full)))
        assert_close(full.apart[c, :9] / sigma, moved / sigma, atol=0.02)
        added = np.diagonal(nine(less)) - np.diagonal(nine(full))
        assert_close(full.apart[c, 9:] / sigma**2, added / sigma**2, rtol=0.02, atol=1e-3)


def test_moving_dock_and_lights_together_changes_no_pixel(rng):
    belief = begun(head_on(), BOTH, rng)

    def look(b):
        foreseen = kernel.Foreseen(np.zeros((M, 2)), np.zeros((2 * M, 2 * M)), np.empty(M))
        kernel.look(PLAN.lens, kernel.State(b.R, b.t, b.x, b.P), PLAN.p_dock, PLAN.axis, foreseen)
        return foreseen

    expected, S, shown = look(belief)
    assert (shown > 0).all()
    assert_close(expected, pixels(belief.T_cam_dock, belief.x, BOTH), atol=1e-9)
    H = jacobian(belief, BOTH)
    assert_close(S, H @ belief.P @ H.T, rtol=1e-4, atol=1e-3)
    for _ in range(10):
        move = se3_exp(rng.normal(size=6) * [0.3, 0.3, 0.3, 0.1, 0.1, 0.1])
        T = belief.T_cam_dock @ se3_inverse(move)
        x = belief.x.copy()
        p = (STATION.p_dock + belief.x[kernel.LIGHTS :].reshape(-1, 3)) @ move[:3, :3].T + move[:3, 3]
        x[kernel.LIGHTS :] = (p - STATION.p_dock).ravel()
        moved = replace(belief, R=np.ascontiguousarray(T[:3, :3]), t=np.ascontiguousarray(T[:3, 3]), x=x)
        assert_close(look(moved)[0], expected, atol=1e-8)


def test_no_update_learns_where_dock_and_lights_are_together(rng):
    """Information gained along the six moves of everything at once is nothing."""
    belief = replace(begun(head_on(), BOTH, rng), joint=True)
    uv = pixels(belief.T_cam_dock, belief.x, BOTH)
    after = track.update(belief, named(BOTH), spots_at(uv), PLAN, CONFIG.track)
    rows = known_rows(belief.P)
    gained = np.linalg.inv(after.P[np.ix_(rows, rows)]) - np.linalg.inv(belief.P[np.ix_(rows, rows)])
    p = STATION.p_dock + belief.x[kernel.LIGHTS :].reshape(-1, 3)
    for k in range(6):
        direction = np.zeros(len(belief.P))
        direction[k] = -1.0
        turn = np.zeros(3)
        turn[k % 3] = 1.0
        direction[kernel.LIGHTS :] = (np.tile(turn, (M, 1)) if k < 3 else np.cross(turn, p)).ravel()
        g = direction[rows]
        alone = np.where(rows < 6, g, 0.0)  # the same move of the pose without its lights is seen well
        assert abs(g @ gained @ g) < 1e-6 * (alone @ gained @ alone)


def test_an_attitude_pulls_and_never_averages_away(rng):
    sigma = np.deg2rad(2.0)
    truth = head_on()
    attitude = Attitude(truth[:3, :3] @ so3_exp(np.array([0.01, -0.02, 0.015])), sigma)
    x, P = track.start_states(STATION, attitude, CONFIG.track)
    P[:6, :6] = np.diag([0.1, 0.1, 0.1, 0.04, 0.04, 0.04])
    first = replace(begun(truth, FRONT, rng), x=x, P=P)
    traces, belief = [], first
    for _ in range(300):
        after = track.attend(belief, attitude)
        s = np.sqrt(np.diagonal(belief.P)[:6])
        assert np.linalg.eigvalsh((belief.P - after.P)[:6, :6] / np.outer(s, s))[0] > -1e-9
        belief = after
        traces.append(np.diagonal(belief.P)[3:6].min() ** 0.5)
    assert traces[0] < 0.2
    assert traces[-1] > 0.95 * sigma  # the bias is as large and stays

    def apart(b):
        return np.linalg.norm(so3_log(attitude.R_dock_cam.T @ b.R.T))

    assert apart(belief) < apart(first)


def test_learned_keeps_survey_and_calibration_and_no_pose():
    last = followed()[-1]
    x, P = track.learned(last)
    cut = kernel.BIAS
    assert not x[:cut].any()
    assert not P[:cut].any()
    assert not P[:, :cut].any()
    assert_array_equal(x[cut:], last.x[cut:])
    assert_array_equal(P[cut:, cut:], last.P[cut:, cut:])


def test_joint_takes_enough_lights_of_two_layers():
    for lights, joint in (
        (FRONT, False),
        (np.array([0, 1, 2, 7, 8]), False),
        (np.array([0, 1, 7, 8, 9]), False),
        (np.array([0, 1, 2, 7, 8, 9]), True),
    ):
        assert track.is_joint(named(lights), PLAN, CONFIG.track) == joint


def test_two_beliefs_are_one_only_with_the_same_names_and_place(rng):
    belief = begun(head_on(), BOTH, rng)
    assert track.same(belief, replace(belief))
    assert not track.same(belief, replace(belief, name=named(FRONT)))
    for k in range(6):
        step = np.zeros(6)
        step[k] = np.sqrt(belief.P[k, k])
        T = belief.T_cam_dock @ se3_exp(step)
        moved = replace(belief, R=np.ascontiguousarray(T[:3, :3]), t=np.ascontiguousarray(T[:3, 3]))
        assert not track.same(belief, moved)


def test_a_start_does_not_depend_on_its_first_guess(rng):
    seed = rng.integers(2**32)
    exact = begun(head_on(), BOTH, np.random.default_rng(seed))
    off = begun(head_on(), BOTH, np.random.default_rng(seed), off=0.02)
    apart = se3_inverse(exact.T_cam_dock) @ off.T_cam_dock
    sigma = np.sqrt(np.diagonal(exact.P)[:6])
    assert (np.abs(apart[:3, 3]) < 0.05 * sigma[:3]).all()
    assert (np.abs(so3_log(apart[:3, :3])) < 0.05 * sigma[3:]).all()


def test_names_that_do_not_hold_together_have_a_large_surprise():
    T_cam_dock = se3_inverse(head_on())
    uv = pixels(T_cam_dock, np.zeros(kernel.LIGHTS + 3 * M), BOTH)
    swapped = named(BOTH)
    swapped[[0, 3]] = swapped[[3, 0]]
    slow = track.slow_states(STATION, None)
    wrong = track.start(T_cam_dock, swapped, 0, spots_at(uv), PLAN, PRIOR, slow, CONFIG.track)
    right = track.start(T_cam_dock, named(BOTH), 0, spots_at(uv), PLAN, PRIOR, slow, CONFIG.track)
    assert right.surprise < 0.0
    assert wrong is None or wrong.surprise > CONFIG.track.max_deviate
