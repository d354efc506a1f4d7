"""Faults at point level: each does what it says, and nothing else; every shipped one loads and runs."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from lumidock.camera import load_camera
from lumidock.errors import InputError
from lumidock.sim.course import mirror_image
from lumidock.sim.detections import simulated_frames
from lumidock.sim.fault_knobs import PointFaults
from lumidock.sim.point_faults import some_time, with_memory
from lumidock.sim.scenario import fault_scenarios, load_scenario, load_scenarios, shipped_scenarios
from lumidock.sim.sequence import require_possible
from lumidock.station import load_station

ROOT = Path(__file__).parents[1] / "src" / "lumidock"
STATION = load_station(ROOT / "stations" / "cage-2x2x5.yaml")
CAMERA = load_camera(ROOT / "cameras" / "imx264-60deg.yaml")
PATH = ("path.start_z_m=12", "path.end_z_m=4", "path.frame_interval_s=0.1", "detections.noise_px=0")


def frames_of(*settings, seed=0):
    return list(simulated_frames(load_scenario("approach", (*PATH, *settings)), STATION, CAMERA, seed))


def lit(frames, light):
    return np.array([light in frame.light for frame in frames])


def positions(frames):
    return np.array([frame.T_dock_cam[:3, 3] for frame in frames])


@pytest.mark.parametrize("name", fault_scenarios())
def test_every_shipped_fault_says_what_it_is_and_runs(name):
    scenario = load_scenario(name, ("path.frame_interval_s=0.5",))
    assert scenario.name == name
    assert scenario.about
    assert scenario.assumptions in ("inside", "edge", "outside")
    assert scenario.says in ("", "survey", "calibration")
    frames = list(simulated_frames(scenario, STATION, CAMERA, 1))
    assert sum(len(frame.light) for frame in frames) > len(frames)


def test_faults_stands_for_all_of_them_and_no_rendered_scenario_is_one():
    assert [one.name for one in load_scenarios(["faults"])] == fault_scenarios()
    assert not set(shipped_scenarios()) & set(fault_scenarios())
    with pytest.raises(InputError, match="--detections"):
        require_possible(load_scenario("faults/theft"))


def test_faults_need_a_path():
    with pytest.raises(InputError, match="faults"):
        load_scenario("missing-1", ("detections.faults.theft=1",))


def test_without_faults_nothing_is_drawn_for_them():
    plain, same = frames_of(), frames_of("detections.faults.frozen_px=1")
    for a, b in zip(plain, same, strict=True):
        assert_allclose(a.detections.uv, b.detections.uv)
        assert_allclose(a.T_dock_cam, b.T_dock_cam)


def test_a_stolen_light_goes_out_when_its_glint_comes_on():
    frames = frames_of("detections.faults.theft=1", "detections.glint_m=0.1")
    stolen = [k for k in range(len(STATION)) if lit(frames, k).any() and not lit(frames, k)[-1]]
    assert len(stolen) == 1
    gone = ~lit(frames, stolen[0])
    glint = np.array([(frame.light < 0).sum() for frame in frames])
    assert (glint == gone).all()
    last = frames[-1]
    off_px = np.linalg.norm(last.detections.uv[last.light < 0][0] - last.uv[stolen[0]])
    depth_m = last.T_dock_cam[2, 3] - STATION.p_dock[stolen[0], 2]
    assert_allclose(off_px, 0.1 * CAMERA.focal_px[0] / depth_m, rtol=0.05)


def test_a_dark_layer_comes_back():
    frames = frames_of("detections.faults.layer_off_s=2")
    front = np.array([(STATION.layer[frame.light[frame.light >= 0]] == 0).sum() for frame in frames])
    assert (front == 0).sum() == 20
    assert front[0] == front[-1] == 7


@pytest.mark.parametrize("mirror", ["surface", "wall", "floor"])
def test_an_image_is_that_of_the_dock(mirror):
    frames = frames_of(f"detections.faults.image={mirror}", "detections.faults.image_m=2")
    side = {"surface": [(2.0, 1)], "floor": [(-2.0, 1)], "wall": [(2.0, 0), (-2.0, 0)]}[mirror]
    frame = frames[0]
    extra = frame.detections.uv[frame.light < 0]
    worst = []
    for at, axis in side:
        order = [1, 0, 2] if axis == 0 else [0, 1, 2]  # a wall mirrors x as the surface does y
        p_dock = mirror_image(STATION.p_dock[None, :, order], np.array([at]))[0][:, order]
        uv = CAMERA.project((p_dock - frame.T_dock_cam[:3, 3]) @ frame.T_dock_cam[:3, :3])
        worst.append(np.linalg.norm(extra[:, None] - uv[None], axis=2).min(axis=1).max())
    assert len(extra) >= 6
    assert min(worst) < 1e-6


def test_a_second_dock_looks_like_the_first():
    frames = frames_of("detections.faults.twin_m=[3, 0, 0]")
    frame = frames[20]
    shifted = frame.T_dock_cam[:3, 3] - [3.0, 0.0, 0.0]
    uv = CAMERA.project((STATION.p_dock - shifted) @ frame.T_dock_cam[:3, :3])
    extra = frame.light < 0
    nearest = np.linalg.norm(frame.detections.uv[extra][:, None] - uv[None], axis=2)
    assert nearest.min(axis=1).max() < 1e-6
    assert ((frame.detections.p_rear[extra] > 0.5) == (STATION.layer[nearest.argmin(axis=1)] == 1)).all()


@pytest.mark.parametrize(
    ("knob", "share"), [("focal_error=[0.04, 0.04]", 0.04), ("distortion=-0.1", None), ("center_px=[30, 30]", None)]
)
def test_a_lens_is_not_as_calibrated(knob, share):
    frame, wrong = frames_of()[0], frames_of(f"detections.faults.{knob}")[0]
    off, r = wrong.uv - frame.uv, frame.uv - CAMERA.center_px
    if share is not None:
        assert_allclose(np.abs(off), share * np.abs(r), atol=1e-9)
    elif "center" in knob:
        assert_allclose(np.linalg.norm(off, axis=1), 30.0)
    else:
        r2 = (r**2).sum(axis=1, keepdims=True) / CAMERA.focal_px[0] ** 2
        assert_allclose(off, -0.1 * r2 * r, atol=1e-9)


def test_a_layer_is_off_and_the_others_are_not():
    frame, wrong = frames_of()[0], frames_of("detections.faults.layer_shift_m=0.05")[0]
    off = np.linalg.norm(wrong.uv - frame.uv, axis=1)
    rear = STATION.layer == 1
    assert_allclose(off[~rear], 0.0, atol=1e-9)
    assert_allclose(off[rear], 0.05 * CAMERA.focal_px[0] / 17.0, rtol=0.02)


def test_a_frozen_picture_is_the_same_again_while_the_truth_moves_on():
    frames = frames_of("detections.faults.frozen_s=[2, 2]", "detections.noise_px=0.5")
    same = [np.array_equal(a.detections.uv, b.detections.uv) for a, b in pairwise(frames)]
    assert sum(same) == 19
    first = same.index(True)
    assert np.ptp(positions(frames)[first : first + 19, 2]) > 1.5
    stamps = np.array([frame.detections.t_ns for frame in frames])
    assert (np.diff(stamps) > 0).all()


def test_jittered_stamps_keep_their_order():
    frames = frames_of("detections.faults.jitter_s=0.08")
    stamps = np.array([frame.detections.t_ns for frame in frames])
    off_s = stamps * 1e-9 - 0.1 * np.arange(len(frames))
    assert (np.diff(stamps) > 0).all()
    assert 0.05 < np.abs(off_s).max() < 0.09


def test_frames_that_do_not_arrive_leave_gaps():
    frames = frames_of("detections.faults.gap_s=[0.5, 1.0]")
    stamps = np.array([frame.detections.t_ns for frame in frames]) * 1e-9
    assert frames[0].step == 0
    assert 0.5 <= np.diff(stamps).max() <= 1.2


def test_an_error_with_memory_has_its_time_constant_and_size(rng):
    t_s = 0.1 * np.arange(20_000)
    x = with_memory(rng, t_s, 2.0, (3,))
    assert_allclose(x.std(axis=0), 1.0, atol=0.15)
    lag = (x[:-10] * x[10:]).mean(axis=0) / x.var(axis=0)
    assert_allclose(lag, np.exp(-0.5), atol=0.1)


def test_centroid_noise_with_memory_keeps_its_size():
    frames = frames_of("detections.noise_px=0.5", "detections.faults.memory_share=0.8", "path.end_z_m=2")
    off = np.concatenate([frame.detections.uv - frame.uv[frame.light] for frame in frames])
    assert_allclose(off.std(), 0.5, rtol=0.15)
    of_one = np.array([(frame.detections.uv - frame.uv[frame.light])[0] for frame in frames])
    assert np.corrcoef(of_one[:-1, 0], of_one[1:, 0])[0, 1] > 0.5


@pytest.mark.parametrize(
    ("knob", "least", "most"),  # m a frame of 0.1 s; three bumps may come together
    [
        ("jump_m=[2, 2]", 2.0, 2.0),
        ("bump_m_s=[0.5, 0.5]", 0.05, 0.15),
        ("turn_deg_s=30", 0.0, 0.0),
        ("roll_deg=[90, 90]", 0.0, 0.0),
    ],
)
def test_motion_is_added_to_the_path(knob, least, most):
    plain, moved = frames_of(), frames_of(f"detections.faults.{knob}")
    n = min(len(plain), len(moved))
    T, T_moved = (np.array([frame.T_dock_cam for frame in frames[:n]]) for frames in (plain, moved))
    steps = np.linalg.norm(np.diff(T_moved[:, :3, 3] - T[:, :3, 3], axis=0), axis=1)
    assert least - 1e-9 < steps.max() < most + 1e-9
    traces = np.trace(T[:, :3, :3].transpose(0, 2, 1) @ T_moved[:, :3, :3], axis1=1, axis2=2)
    turned = np.rad2deg(np.arccos(np.clip((traces - 1.0) / 2.0, -1.0, 1.0)))
    if "roll" in knob:
        assert_allclose(turned, 90.0, atol=1e-6)
    if "turn" in knob:
        assert_allclose(turned.max(), 20.0, atol=1e-6)


def test_a_time_lies_inside_the_run(rng):
    t_s = 0.1 * np.arange(300)
    for _ in range(20):
        when = np.flatnonzero(some_time(rng, t_s, 4.0))
        assert len(when) in (40, 41)
        assert t_s[when[0]] >= 3.0
        assert t_s[when[-1]] <= 27.0
    assert some_time(rng, t_s, 1e4).all()


def test_few_lamps_are_so_many():
    frames = frames_of("detections.faults.front_left=4")
    front = np.array([(STATION.layer[frame.light] == 0).sum() for frame in frames])
    assert (front == 4).all()


def test_any_tells_whether_there_is_a_fault():
    assert not PointFaults().any
    assert PointFaults(twin_m=(3.0, 0.0, 0.0)).any
