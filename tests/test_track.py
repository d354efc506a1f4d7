"""The filter: prediction, update, and what it holds of survey and calibration."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from conftest import assert_close, numeric_jacobian
from numpy.testing import assert_array_equal
from tracks import (
    BOTH,
    CAMERA,
    CONFIG,
    FRONT,
    MODEL,
    STATION,
    STEP_NS,
    M,
    assigned,
    begun,
    frames_of,
    head_on,
    measured,
    pixels,
    start,
    with_state,
)

from lumidock import integrity, track
from lumidock._kernels.tracking import track as kernel
from lumidock.datatypes import Attitude
from lumidock.evaluation import claims
from lumidock.geometry import se3_adjoint, se3_exp, se3_inverse, so3_exp, so3_log
from lumidock.localizer import Localizer
from lumidock.model import believed, measurements


@cache
def followed():
    """The first hypothesis after each of 100 frames of the approach in which the second layer appears."""
    settings = ("path.start_z_m=18", "path.end_z_m=11", "path.frame_interval_s=0.0666667", "detections.survey=true")
    localizer, tracks = Localizer(STATION, CAMERA), []
    for frame in frames_of("approach", *settings)[:100]:
        localizer.process_detections(frame.detections)
        tracks.append(localizer.state.first if localizer.state.confirmed else None)
    return [one for one in tracks if one is not None]


def known_rows(P):
    """The states that are not fixed at zero: without an attitude sensor there is no bias."""
    return np.flatnonzero(np.diagonal(P) > 0.0)


def correlation(P):
    rows = known_rows(P)
    s = np.sqrt(np.diagonal(P)[rows])
    return P[np.ix_(rows, rows)] / np.outer(s, s)


def jacobian(one, lights):
    """H (2 K, n) of the filter's pixels by central differences, state by state."""
    n = len(one.state.P)

    def function(dx):
        x = one.state.x + np.concatenate([np.zeros(6), dx[6:]])
        return pixels(one.T_cam_dock @ se3_exp(dx[:6]), x, lights).ravel()

    return numeric_jacobian(function, np.zeros(n), step=1e-5)


def claimed(one):
    """Covariance (6, 6) in dock axes and the pose of a track."""
    bound = integrity.bounds([one], MODEL, CONFIG.integrity)
    return bound.covariance, bound.T_dock_cam


def test_predict_agrees_with_the_group_and_with_dense_algebra(rng):
    one = begun(head_on(), BOTH, rng)
    x = one.state.x.copy()
    x[6:12] = [0.4, -0.2, 0.8, 0.02, -0.05, 0.1]
    P = one.state.P + 1e-6 * (lambda A: A @ A.T)(rng.normal(size=one.state.P.shape))
    one = with_state(one, x=x, P=P)
    dt = 0.07
    later = track.predict(one, 70_000_000, CONFIG.track)
    assert later.t_ns == 70_000_000
    assert_close(later.T_cam_dock, se3_exp(-dt * x[6:12]) @ one.T_cam_dock, atol=1e-5)  # translation to second order
    assert_array_equal(later.state.x, x)
    A = se3_adjoint(se3_inverse(later.T_cam_dock))
    F = np.eye(len(P))
    F[:6, 6:12] = -dt * A
    q = np.diag(np.repeat([CONFIG.track.accel_m_s2**2, CONFIG.track.accel_rad_s2**2], 3))
    expected = F @ P @ F.T
    expected[:6, :6] += A @ q @ A.T * dt**3 / 3
    expected[:6, 6:12] -= A @ q * dt**2 / 2
    expected[6:12, :6] -= (A @ q).T * dt**2 / 2
    expected[6:12, 6:12] += q * dt
    assert_close(later.state.P, expected, rtol=1e-9, atol=1e-12)


def test_without_motion_the_pose_stays_and_its_covariance_grows(rng):
    one = begun(head_on(), BOTH, rng)
    assert_array_equal(one.state.x[6:12], np.zeros(6))
    before = one
    for k in range(1, 6):
        after = track.predict(before, k * STEP_NS, CONFIG.track)
        assert_close(after.T_cam_dock, one.T_cam_dock, atol=1e-12)
        grown = after.state.P[:12, :12] - before.state.P[:12, :12]
        assert np.linalg.eigvalsh(grown[:6, :6])[0] > -1e-12
        assert (np.diagonal(grown)[:6] > 0).all()
        assert_array_equal(after.state.P[12:, 12:], before.state.P[12:, 12:])
        before = after


@pytest.mark.parametrize("both", [False, True])
def test_update_is_the_schmidt_kalman_filters(both, rng):
    """Exact pixels move nothing, and the covariance is that of dense algebra with numeric derivatives."""
    one = replace(begun(head_on(), BOTH, rng), estimates_calibration=both)
    prior, n = track.calibration_prior(STATION, None).P, len(one.state.P)
    P = prior.copy()
    P[:12, :12] = np.diag([0.04, 0.03, 0.09, 1e-4, 2e-4, 1e-4, *[0.01] * 3, *[1e-4] * 3])
    one = replace(with_state(one, P=P), estimates_calibration=both)
    lights = np.array([0, 2, 4, 6, 8, 11, 12]) if both else np.array([0, 2, 4, 6, 8, 11])
    uv = pixels(one.T_cam_dock, one.state.x, lights)
    after = track.update(one, assigned(lights), measured(uv), MODEL, CONFIG.track)
    assert_close(after.T_cam_dock, one.T_cam_dock, atol=1e-9)
    assert after.estimates_calibration == both
    H, C = jacobian(one, lights), np.eye(2 * len(lights)) * CONFIG.match.noise_px**2 * CONFIG.track.memory
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + C)
    K[n if both else kernel.CALIBRATION :] = 0.0
    keep = np.eye(n) - K @ H
    expected = keep @ P @ keep.T + K @ C @ K.T
    scale = np.sqrt(np.diagonal(P)) + 1e-9
    assert_close(after.state.P / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-5)
    assert_close(after.last.nis, 0.0, atol=1e-9)


def test_nis_is_that_of_the_innovation(rng):
    one = replace(begun(head_on(), BOTH, rng), estimates_calibration=True)
    uv = pixels(one.T_cam_dock, one.state.x, BOTH) + rng.normal(0, 0.4, (M, 2))
    after = track.update(one, assigned(BOTH), measured(uv), MODEL, CONFIG.track)
    memory = CONFIG.track.memory
    H, C = jacobian(one, BOTH), np.eye(2 * M) * CONFIG.match.noise_px**2 * memory
    nu = (uv - pixels(one.T_cam_dock, one.state.x, BOTH)).ravel()
    assert_close(after.last.nis, memory * nu @ np.linalg.solve(H @ one.state.P @ H.T + C, nu), rtol=0.01)
    moved = se3_inverse(one.T_cam_dock) @ after.T_cam_dock
    expected = one.state.P @ H.T @ np.linalg.solve(H @ one.state.P @ H.T + C, nu)
    assert_close(moved[:3, 3], expected[:3], rtol=0.02, atol=1e-4)
    assert_close(so3_log(moved[:3, :3]), expected[3:6], rtol=0.02, atol=1e-5)


@pytest.mark.parametrize("lights", [BOTH, np.array([0, 2, 4, 6]), np.array([7, 9, 11])], ids=["both", "front", "rear"])
def test_an_update_never_adds_to_the_poses_covariance(lights, rng):
    one = begun(head_on(), BOTH if len(lights) == M else FRONT, rng)
    for k in range(1, 10):
        before = track.predict(one, k * STEP_NS, CONFIG.track)
        uv = pixels(before.T_cam_dock, before.state.x, lights) + rng.normal(0, 0.5, (len(lights), 2))
        one = track.update(before, assigned(lights), measured(uv), MODEL, CONFIG.track)
        less = before.state.P[:6, :6] - one.state.P[:6, :6]
        s = np.sqrt(np.diagonal(before.state.P)[:6])
        assert np.linalg.eigvalsh(less / np.outer(s, s))[0] > -1e-9


def test_the_covariance_stays_symmetric_and_positive_over_an_approach():
    tracks = followed()
    assert len(tracks) > 90
    for one in tracks:
        assert np.isfinite(one.state.P).all()
        assert_close(correlation(one.state.P), correlation(one.state.P).T, atol=1e-9)
        assert np.linalg.eigvalsh(correlation(one.state.P))[0] > 1e-12
        assert_close(one.state.R @ one.state.R.T, np.eye(3), atol=1e-9)


def test_survey_and_calibration_are_only_considered_before_both_layers_are_seen():
    taken = believed(STATION, CONFIG.files)
    prior = track.calibration_prior(taken, None).P[kernel.CALIBRATION :, kernel.CALIBRATION :]
    tracks = followed()
    alone, both = [b for b in tracks if not b.estimates_calibration], [b for b in tracks if b.estimates_calibration]
    assert len(alone) > 5
    assert len(both) > 20
    for one in alone:
        assert_array_equal(one.state.P[kernel.CALIBRATION :, kernel.CALIBRATION :], prior)
        assert not one.state.x[kernel.CALIBRATION :].any()
    sums = [np.trace(b.state.P[kernel.LIGHTS :, kernel.LIGHTS :]) for b in both]
    focal = [b.state.P[kernel.CALIBRATION, kernel.CALIBRATION] for b in both]
    assert sums[0] < np.trace(prior[3:, 3:])
    assert (np.diff(sums) <= 1e-15).all()
    assert (np.diff(focal) <= 1e-15).all()
    assert sums[-1] < 0.99 * np.trace(prior[3:, 3:])
    assert both[-1].state.x[kernel.CALIBRATION :].any()
    # once both, always both
    assert [b.estimates_calibration for b in tracks] == sorted(b.estimates_calibration for b in tracks)


def test_cold_frames_are_as_far_off_as_they_say():
    """Both layers in view, lights and lens off by what the station allows: mean NEES of the pose."""
    settings = ("path.count=200", "detections.drop=0.0", "detections.survey=true", "detections.calibration=true")
    squares = []
    for frame in frames_of("joint", *settings, seed=8):
        assignment = np.full(M, -1, np.int64)
        assignment[frame.light[frame.light >= 0]] = np.flatnonzero(frame.light >= 0)
        frame_measured = measurements(frame.detections, MODEL, CONFIG.match)
        one = start(se3_inverse(frame.T_dock_cam), assignment, frame_measured)
        P, T_dock_cam = claimed(one)
        squares.append(claims.nees(claims.pose_error(T_dock_cam, frame.T_dock_cam)[None], P[None])[0])
    assert len(squares) == 200
    assert 5.0 < np.mean(squares) < 7.0


def test_moving_dock_and_lights_together_changes_no_pixel(rng):
    one = begun(head_on(), BOTH, rng)

    expected, S, shown = track.predict_measurements(one, MODEL)
    assert (shown > 0).all()
    assert_close(expected, pixels(one.T_cam_dock, one.state.x, BOTH), atol=1e-9)
    H = jacobian(one, BOTH)
    assert_close(S, H @ one.state.P @ H.T, rtol=1e-4, atol=1e-3)
    for _ in range(10):
        move = se3_exp(rng.normal(size=6) * [0.3, 0.3, 0.3, 0.1, 0.1, 0.1])
        T = one.T_cam_dock @ se3_inverse(move)
        x = one.state.x.copy()
        p = (STATION.p_dock + one.state.x[kernel.LIGHTS :].reshape(-1, 3)) @ move[:3, :3].T + move[:3, 3]
        x[kernel.LIGHTS :] = (p - STATION.p_dock).ravel()
        moved = with_state(one, R=np.ascontiguousarray(T[:3, :3]), t=np.ascontiguousarray(T[:3, 3]), x=x)
        assert_close(track.predict_measurements(moved, MODEL).uv, expected, atol=1e-8)


def test_no_update_learns_where_dock_and_lights_are_together(rng):
    """Information gained along the six moves of everything at once is nothing."""
    one = replace(begun(head_on(), BOTH, rng), estimates_calibration=True)
    uv = pixels(one.T_cam_dock, one.state.x, BOTH)
    after = track.update(one, assigned(BOTH), measured(uv), MODEL, CONFIG.track)
    rows = known_rows(one.state.P)
    gained = np.linalg.inv(after.state.P[np.ix_(rows, rows)]) - np.linalg.inv(one.state.P[np.ix_(rows, rows)])
    p = STATION.p_dock + one.state.x[kernel.LIGHTS :].reshape(-1, 3)
    for k in range(6):
        direction = np.zeros(len(one.state.P))
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
    x, P = track.open_states(track.calibration_prior(STATION, attitude), CONFIG.track)
    P[:6, :6] = np.diag([0.1, 0.1, 0.1, 0.04, 0.04, 0.04])
    first = with_state(begun(truth, FRONT, rng), x=x, P=P)
    traces, one = [], first
    for _ in range(300):
        after = track.update_attitude(one, attitude)
        s = np.sqrt(np.diagonal(one.state.P)[:6])
        assert np.linalg.eigvalsh((one.state.P - after.state.P)[:6, :6] / np.outer(s, s))[0] > -1e-9
        one = after
        traces.append(np.diagonal(one.state.P)[3:6].min() ** 0.5)
    assert traces[0] < 0.2
    assert traces[-1] > 0.95 * sigma  # the bias is as large and stays

    def apart(b):
        return np.linalg.norm(so3_log(attitude.R_dock_cam.T @ b.state.R.T))

    assert apart(one) < apart(first)


def test_learned_calibration_keeps_survey_and_calibration_and_no_pose():
    last = followed()[-1]
    x, P = track.learned_calibration(last)
    cut = kernel.BIAS
    assert not x[:cut].any()
    assert not P[:cut].any()
    assert not P[:, :cut].any()
    assert_array_equal(x[cut:], last.state.x[cut:])
    assert_array_equal(P[cut:, cut:], last.state.P[cut:, cut:])


def test_two_layers_take_enough_lights_of_each():
    for lights, both in (
        (FRONT, False),
        (np.array([0, 1, 2, 7, 8]), False),
        (np.array([0, 1, 7, 8, 9]), False),
        (np.array([0, 1, 2, 7, 8, 9]), True),
    ):
        assert track.sees_two_layers(MODEL.count(assigned(lights))) == both


def test_two_tracks_are_one_only_with_the_same_assignment_and_place(rng):
    one = begun(head_on(), BOTH, rng)
    assert track.same(one, replace(one))
    assert not track.same(one, replace(one, last=replace(one.last, assignment=assigned(FRONT))))
    for k in range(6):
        step = np.zeros(6)
        step[k] = np.sqrt(one.state.P[k, k])
        T = one.T_cam_dock @ se3_exp(step)
        moved = with_state(one, R=np.ascontiguousarray(T[:3, :3]), t=np.ascontiguousarray(T[:3, 3]))
        assert not track.same(one, moved)


def test_a_start_does_not_depend_on_its_first_guess(rng):
    seed = rng.integers(2**32)
    exact = begun(head_on(), BOTH, np.random.default_rng(seed))
    off = begun(head_on(), BOTH, np.random.default_rng(seed), off=0.02)
    apart = se3_inverse(exact.T_cam_dock) @ off.T_cam_dock
    sigma = np.sqrt(np.diagonal(exact.state.P)[:6])
    assert (np.abs(apart[:3, 3]) < 0.05 * sigma[:3]).all()
    assert (np.abs(so3_log(apart[:3, :3])) < 0.05 * sigma[3:]).all()


def test_lights_that_do_not_hold_together_have_a_large_innovation():
    T_cam_dock = se3_inverse(head_on())
    uv = pixels(T_cam_dock, np.zeros(kernel.LIGHTS + 3 * M), BOTH)
    swapped = assigned(BOTH)
    swapped[[0, 3]] = swapped[[3, 0]]
    wrong = start(T_cam_dock, swapped, measured(uv))
    right = start(T_cam_dock, assigned(BOTH), measured(uv))
    assert right.last.deviate < 0.0
    assert wrong is None or wrong.last.deviate > CONFIG.track.max_deviate
