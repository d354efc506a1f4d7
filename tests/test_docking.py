"""The closed loop: the vehicle against closed forms, the cage against a brute force, dockings against the truth."""

import math
from dataclasses import replace

import numpy as np
import pytest
from bench.shipped import shipped_camera, shipped_station
from hypothesis import given, settings
from hypothesis import strategies as st

from lumidock.docking.cage import Frame
from lumidock.docking.control import Controller, Wanted
from lumidock.docking.instruments import Instruments
from lumidock.docking.loop import Docking, run
from lumidock.docking.navigation import Navigator
from lumidock.docking.states import Machine
from lumidock.docking.vehicle import (
    AUV,
    R_DOCK_APPROACH,
    ROV,
    VEHICLES,
    Current,
    Motion,
    T_dock_cam_of,
    body_drag,
)
from lumidock.errors import InputError
from lumidock.go_no_go import Passage
from lumidock.sim.course import course_of
from lumidock.sim.point_camera import point_camera
from lumidock.sim.rendered_camera import RenderedCamera, scaled
from lumidock.sim.scenario import load_scenario

MODELS = pytest.mark.parametrize("model", VEHICLES.values(), ids=list(VEHICLES))
STILL = (0.0, 0.0, 0.0)


def docking(scenario, *changes, vehicle=ROV, method="lumidock", seed=0):
    return Docking(load_scenario(scenario, changes), shipped_station(), shipped_camera(), vehicle, method, seed)


# The vehicle


@MODELS
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_constant_thrust_ends_where_drag_equals_it(model, axis):
    thrust = [0.0] * 4
    thrust[axis] = 0.3 * min(model.thrust[axis], model.shared_n)
    motion = Motion(replace(model, added=(0.0, 0.0, 0.0, 0.0)), (0.0, 0.0, 0.0), 0.0)  # no moment across the flow
    for _ in range(4000):
        motion.step(tuple(thrust), STILL, 0.05)
    assert body_drag(model, axis, motion.through_water[axis]) == pytest.approx(thrust[axis], rel=1e-3)


@MODELS
def test_a_vehicle_without_thrust_goes_with_the_water(model):
    motion = Motion(model, (0.0, 0.0, 0.0), 0.3)
    for _ in range(100):
        motion.step((0.0, 0.0, 0.0, 0.0), (0.2, -0.1, 0.05), 0.05)
    np.testing.assert_allclose(motion.position, [1.0, -0.5, 0.25], atol=1e-9)


@settings(max_examples=30)
@given(st.tuples(*[st.floats(-300.0, 300.0)] * 4))
def test_thrust_stays_within_its_limits_and_its_direction_in_the_plane(wanted):
    given_ = ROV.within_limits(wanted)
    assert all(abs(force) <= most + 1e-9 for force, most in zip(given_, ROV.thrust, strict=True))
    assert abs(given_[0]) + abs(given_[1]) + abs(given_[3]) / ROV.yaw_arm_m <= ROV.shared_n + 1e-9
    assert all(a * b >= 0.0 for a, b in zip(given_, wanted, strict=True))


def test_head_on_the_camera_looks_into_the_dock():
    T_dock_cam = T_dock_cam_of(ROV, (-5.0, 0.5, 0.2), (0.0, 0.0, 0.0))
    np.testing.assert_allclose(T_dock_cam[:3, :3], np.diag([1.0, -1.0, -1.0]), atol=1e-12)
    np.testing.assert_allclose(T_dock_cam[:3, 3], [-0.5, 0.2, 5.0 - ROV.half_m[0]], atol=1e-12)


@settings(max_examples=30)
@given(st.tuples(*[st.floats(-0.5, 0.5)] * 3))
def test_rotations_are_rotations(angles):
    R = T_dock_cam_of(AUV, (0.0, 0.0, 0.0), angles)[:3, :3]
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)


def test_turbulence_has_its_sigma_and_its_memory():
    water = Current((0.3, 0.0, 0.0), 0.05, np.random.default_rng(1))
    x = np.array([water.step(0.5)[0] for _ in range(20_000)]) - 0.3
    assert x.std() == pytest.approx(0.05, rel=0.1)
    assert np.corrcoef(x[:-6], x[6:])[0, 1] == pytest.approx(math.exp(-1.0), abs=0.08)  # 3 s later


@MODELS
def test_the_loops_hold_a_velocity_and_find_the_current(model):
    motion, controller, rng = Motion(model, (0.0, 0.0, 0.0), 0.1), Controller(model), np.random.default_rng(3)
    instruments, current = Instruments.drawn(rng), (0.15, 0.2, 0.0)
    for _ in range(1200):
        reading = instruments.read(motion, (0.0, 0.0))
        thrust = controller.step(Wanted((0.3, 0.0, 0.0), 0.0), reading, motion.heading_rad, 0.05)
        motion.step(thrust, current, 0.05)
    assert motion.heading_rad == pytest.approx(0.0, abs=0.03)
    np.testing.assert_allclose(motion.over_ground[:3], [0.3, 0.0, 0.0], atol=0.04)
    np.testing.assert_allclose(controller.current[:2], current[:2], atol=0.08)


def test_reckoning_stays_within_its_level():
    rng = np.random.default_rng(5)
    for _ in range(20):
        motion, instruments = Motion(ROV, (-3.0, 0.0, 0.0), 0.0), Instruments.drawn(rng)
        navigator = Navigator(ROV, (-3.0 + ROV.half_m[0], 0.0, 0.0), 0.0, 0.0, 0.0, heading_sigma_rad=0.002)
        for _ in range(300):
            reading = instruments.read(motion, (0.0, 0.0))
            motion.step((20.0, 3.0, 0.0, 0.3), STILL, 0.05)
            navigator.reckon(reading, 0.05)
        x, y, z = navigator.position
        nose = ROV.half_m[0] * math.cos(motion.heading_rad), ROV.half_m[0] * math.sin(motion.heading_rad)
        off = math.hypot(motion.position[1] + nose[1] - y, motion.position[2] - z)
        assert off < navigator.level_m
        assert abs(motion.position[0] + nose[0] - x) < navigator.level_z_m + 0.05


# The cage


@pytest.fixture(scope="module")
def frame():
    return Frame.of(load_scenario("docking"), shipped_station())


def box_distance(points, middle, R, half):
    """By sampling the box densely, as nobody would in earnest."""
    grid = np.stack(np.meshgrid(*[np.linspace(-h, h, 25) for h in half], indexing="ij"), -1).reshape(-1, 3)
    surface = grid @ R.T + middle
    return np.sqrt(((points[:, None] - surface[None]) ** 2).sum(axis=2)).min(axis=1)


@settings(max_examples=10, deadline=None)
@given(st.tuples(st.floats(-0.9, 0.9), st.floats(-0.9, 0.9), st.floats(-3.0, 1.0)), st.floats(-0.4, 0.4))
def test_room_is_the_distance_to_the_nearest_tube(frame, middle, yaw):
    c, s = math.cos(yaw), math.sin(yaw)
    R = R_DOCK_APPROACH @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    p_dock = np.array(middle)
    room = frame.room_m(ROV, R, p_dock)
    some = np.linalg.norm(frame.p_dock - p_dock, axis=1) < 1.2
    if not some.any():
        return
    brute = (box_distance(frame.p_dock[some], p_dock, R, ROV.half_m) - frame.radius_m[some]).min()
    assert room == pytest.approx(brute, abs=0.04)


def test_a_hull_on_the_axis_has_room_and_one_in_a_corner_has_none(frame):
    assert frame.room_m(ROV, R_DOCK_APPROACH, np.array([0.0, 0.0, -2.0])) > 0.5
    assert frame.room_m(ROV, R_DOCK_APPROACH, np.array([0.75, 0.0, -2.56])) < 0.0  # beside a ring of tubes


def test_another_dock_is_refused():
    with pytest.raises(InputError, match="cage only"):
        Frame.of(load_scenario("funnel"), shipped_station())


# The camera


def test_the_point_camera_sees_the_lights_where_they_project():
    still = ("detections.drop=0", "detections.clutter=0", "detections.survey=0", "detections.calibration=0")
    one = docking("docking", *still, "detections.noise_px=0")
    eye = point_camera(one.scenario, one.station, one.camera, 0, 10)
    T_dock_cam = course_of(load_scenario("approach"), one.station, one.camera, np.random.default_rng(0)).T_dock_cam[120]
    seen = eye.see(3, T_dock_cam)
    p_cam = (one.station.p_dock[seen.light] - T_dock_cam[:3, 3]) @ T_dock_cam[:3, :3]
    np.testing.assert_allclose(seen.detections.uv, one.camera.project(p_cam), atol=1e-9)
    assert len(seen.light) == 13


def test_the_rendered_camera_shows_lights_where_the_point_camera_sees_them():
    still = ("detections.drop=0", "detections.clutter=0", "detections.noise_px=0", "matter.dock=none")
    one = docking("docking", *still)
    camera = scaled(one.camera, 0.25)
    eye = point_camera(one.scenario, one.station, camera, 4, 10)
    T_dock_cam = T_dock_cam_of(ROV, (-8.0, 0.2, 0.1), (0.02, 0.0, 0.0))
    image = RenderedCamera(eye, 4).see(0, T_dock_cam).image.astype(float).max(axis=2)
    seen = eye.see(0, T_dock_cam)
    for u, v in np.round(seen.detections.uv[seen.light < 7]).astype(int):
        around = image[v - 25 : v + 26, u - 25 : u + 26]
        assert image[v - 1 : v + 2, u - 1 : u + 2].max() >= np.percentile(around, 98)


# Dockings


def test_dead_lamps_of_a_whole_layer_end_in_an_abort_without_contact():
    verdict, moments = run(docking("docking", "lamps.layers=rear", "docking.time_limit_s=100"))
    assert verdict.outcome != "docked"
    assert not verdict.contact
    assert all(moment.step.advice.word in ("no_fix", "approach", "clear", "level", "blind") for moment in moments)


@MODELS
def test_a_vehicle_docks(model):
    verdict, moments = run(docking("docking", vehicle=model, seed=5))
    assert (verdict.outcome, verdict.docked, verdict.misleading) == ("docked", True, 0), verdict.log
    assert verdict.miss_m < 0.15
    assert verdict.room_m > 0.1
    states = [change.state for change in verdict.log]
    assert (states[0], states[-2:]) == ("search", ["enter", "docked"])
    inside = [m for m in moments if m.T_dock_cam[2, 3] < 0.0 and m.step.state == "enter"]
    assert all(m.step.advice.verdict == "go" for m in inside)


def test_the_same_seed_gives_the_same_docking():
    first, second = (run(docking("docking", "docking.time_limit_s=12", seed=9))[1] for _ in range(2))
    assert [m.T_dock_cam.tolist() for m in first] == [m.T_dock_cam.tolist() for m in second]


def test_a_step_never_changes_the_machine():
    machine = Machine(Passage(0.94, 0.35), ROV, 3.0)
    before = replace(machine)
    navigator = Navigator(ROV, (-20.0, 0.0, 0.0), 0.0)
    after, step = machine.step(navigator, 100.0)
    assert machine == before
    assert (after.state, after.log[-1].why, step.advice.word) == ("abort", "no_dock", "no_fix")
