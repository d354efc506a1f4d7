"""The bank of states that never saw a light, against filters that truly did not; and what it bounds and proves."""

from dataclasses import replace

import numpy as np
import pytest
from tracks import BOTH, CONFIG, FRONT, MODEL, STEP_NS, M, assigned, head_on, measured, pixels, start

from lumidock import integrity, track
from lumidock._kernels.tracking import track as kernel
from lumidock.alert_limits import DEFAULT_ALERT_LIMITS
from lumidock.datatypes import Attitude
from lumidock.evaluation import claims
from lumidock.geometry import se3_exp, se3_inverse
from lumidock.track import open_bank

EXACT = np.zeros(kernel.LIGHTS + 3 * M)  # survey and calibration without an error
NOISE_PX = 0.5


def own(lights):
    """The assignment (M,) in which some lights have the detection of their own number."""
    assignment = np.full(M, -1, np.int64)
    assignment[lights] = lights
    return assignment


def approach(rng, frames, z=8.0):
    """True T_dock_cam and the noisy pixels (M, 2) of all lights, frame by frame."""
    T_cam_dock = se3_inverse(head_on(z))
    for _ in range(frames):
        yield se3_inverse(T_cam_dock), pixels(T_cam_dock, EXACT, BOTH) + rng.normal(0, NOISE_PX, (M, 2))
        T_cam_dock = se3_exp(np.array([0.01, 0.0, -0.06, 0.0, 0.002, 0.001])) @ T_cam_dock


def follow(history, lights, attitude=None):
    """A track through a history by the detections of some `lights`."""
    one = None
    for k, (T_dock_cam, uv) in enumerate(history):
        if one is None:
            one = start(se3_inverse(T_dock_cam), own(lights), measured(uv))
            continue
        one = track.predict(one, k * STEP_NS, CONFIG.track)
        one = one if attitude is None else track.update_attitude(one, attitude)
        one = track.update(one, own(lights), measured(uv), MODEL, CONFIG.track)
    return one


def blind(one, light):
    """Pose T_cam_dock (4, 4) and the pose's covariance (6, 6) of the state that never saw a light, nor its group."""
    s = MODEL.group[light]
    return one.T_cam_dock @ se3_exp(one.bank.offset[s, :6]), one.bank.P[s, :6, :6]


def without(lights, light):
    """Those `lights` that the state sees which is blind to `light`."""
    return lights[MODEL.group[lights] != MODEL.group[light]]


@pytest.mark.parametrize(("lights", "frames"), [(BOTH, 1), (BOTH, 25), (FRONT, 1)])
@pytest.mark.parametrize("sensor", [False, True])
def test_a_state_of_the_bank_is_a_filter_that_never_saw_its_light(lights, frames, sensor, rng):
    history = list(approach(rng, frames))
    attitude = Attitude(history[0][0][:3, :3] @ se3_exp(np.array([0, 0, 0, 0.02, -0.01, 0.03]))[:3, :3], 0.05)
    one = follow(history, lights, attitude if sensor else None)
    assert np.array_equal(np.flatnonzero(one.bank.used), lights)
    for light in lights[::3]:
        less = follow(history, without(lights, light), attitude if sensor else None)
        T_cam_dock, P = blind(one, light)
        sigma = np.sqrt(np.diagonal(less.state.P)[:6])
        apart = claims.pose_error(se3_inverse(T_cam_dock), se3_inverse(less.T_cam_dock))
        assert np.linalg.norm(apart / np.sqrt(np.diagonal(in_dock(less)))) < 0.35  # the linearisation differs
        assert np.abs(np.sqrt(np.diagonal(P)) / sigma - 1.0).max() < 0.15


def in_dock(one):
    """Covariance (6, 6) of a track's pose in dock axes."""
    return integrity.bounds([replace(one, bank=open_bank(MODEL))], MODEL, CONFIG.integrity).covariance


def test_lights_of_one_layer_share_no_state():
    for layer in range(MODEL.n_layers):
        group = MODEL.group[MODEL.layer == layer]
        assert len(set(group)) == len(group)


def test_a_light_that_is_used_late_is_left_out_from_then_on(rng):
    history = list(approach(rng, 6))
    one = follow(history[:-1], FRONT)
    assert one.bank.used[BOTH[7:]].sum() == 0
    later = track.predict(one, 5 * STEP_NS, CONFIG.track)
    both = track.update(later, own(BOTH), measured(history[-1][1]), MODEL, CONFIG.track)
    T_cam_dock, _ = blind(both, 7)
    less = track.update(
        track.predict(one, 5 * STEP_NS, CONFIG.track),
        own(without(BOTH, 7)),
        measured(history[-1][1]),
        MODEL,
        CONFIG.track,
    )
    apart = claims.pose_error(se3_inverse(T_cam_dock), se3_inverse(less.T_cam_dock))
    assert np.linalg.norm(apart / np.sqrt(np.diagonal(in_dock(less)))) < 0.35


def test_no_pose_is_used_beyond_its_levels_whatever_one_wrong_light_has_done(rng):
    """A glint stands beside a dead lamp from the first frame on, or was taken once and has gone again."""
    used = 0
    for lights in (FRONT[:4], FRONT[:5], FRONT, BOTH):
        for beside_px, frames, lasts in [(4.0, 1, 1), (15.0, 1, 1), (4.0, 12, 12), (4.0, 12, 1), (15.0, 12, 1)]:
            history, angle = list(approach(rng, frames)), rng.uniform(0, 2 * np.pi)
            for k in range(lasts):
                history[k][1][lights[0]] += beside_px * np.array([np.cos(angle), np.sin(angle)])
            one = follow(history, lights)
            bound = None if one is None else integrity.bounds([one], MODEL, CONFIG.integrity)
            if bound is None or not integrity.pose_holds(bound, DEFAULT_ALERT_LIMITS):
                continue
            error, level = claims.pose_error(bound.T_dock_cam, history[-1][0]), bound.protection
            assert np.hypot(*error[:2]) < level.lateral_m
            assert abs(error[2]) < level.axial_m
            assert np.linalg.norm(error[3:]) < level.angle_rad
            used += 1
    assert used > 5  # most of those with many lights


def test_geometry_proves_a_light_only_where_the_others_place_it(rng):
    near = follow(list(approach(rng, 3, z=6.0)), BOTH)
    assert near.bank.proven[BOTH].all()
    few = follow(list(approach(rng, 1, z=16.0)), FRONT[:4])
    assert not few.bank.proven.any()


def test_a_light_that_comes_back_where_nothing_places_it_is_not_proven(rng):
    history = list(approach(rng, 5, z=6.0))
    one = follow(history, BOTH)
    coasted = track.predict(one, 30 * STEP_NS, CONFIG.track)  # 1.7 s in the dark
    alone = track.update(coasted, assigned([0]), measured(history[-1][1]), MODEL, CONFIG.track)
    assert alone is not None
    assert alone.bank.proven[0] == 1  # one gap between two frames in which it was seen
    dark = replace(coasted, bank=coasted.bank._replace(seen=np.zeros(M, np.int64)))
    alone = track.update(dark, assigned([0]), measured(history[-1][1]), MODEL, CONFIG.track)
    assert alone is None or alone.bank.proven[0] == 0
