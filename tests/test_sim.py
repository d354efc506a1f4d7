"""The simulator: paths, scenarios and bare detections."""

import csv
import time
from dataclasses import replace

import numpy as np
import pytest
from bench.shipped import CAMERA_FILE, STATION_FILE, shipped_camera, shipped_station

from lumidock.errors import InputError
from lumidock.evaluation.campaign import plan
from lumidock.geometry import so3_exp, so3_log
from lumidock.pose import project_lights
from lumidock.sim.detections import simulated_frames
from lumidock.sim.scenario import (
    R_DOCK_CAM_HEAD_ON,
    load_scenario,
    rotations,
    shipped_scenarios,
    station_of,
    trajectory,
)
from lumidock.sim.sequence import write_detections
from lumidock.station import load_station

STATION, CAMERA = shipped_station(), shipped_camera()


def test_a_path_that_is_not_drawn_refuses_what_counts_draws():
    for knob in ("count=5", "hold=2", "z_m=[3, 5]"):
        with pytest.raises(InputError, match=rf"^approach: path: {knob.partition('=')[0]}: belongs to .* kind draws"):
            load_scenario("approach", (f"path.{knob}",))
    assert load_scenario("approach", ("path.kind=draws", "path.count=5")).path.count == 5


@pytest.mark.parametrize("seed", range(5))
def test_approach_is_the_papers(seed):
    t_ns, T = trajectory(load_scenario("approach"), np.random.default_rng(seed))
    assert np.diff(t_ns).tolist() == [150_000_000] * 220
    z, off = T[:, 2, 3], np.hypot(T[:, 0, 3], T[:, 1, 3])
    np.testing.assert_allclose(z, 30.0 - 0.15 * np.arange(221), atol=1e-9)
    turn = np.rad2deg([np.linalg.norm(so3_log(R_DOCK_CAM_HEAD_ON.T @ R)[:2]) for R in T[:, :3, :3]])
    assert off.max() <= 1.0
    assert off[z <= 2.0].max() <= 0.05
    assert turn.max() <= 3.0
    assert turn[z <= 2.0].max() <= 0.5
    assert np.abs(np.diff(T[:, :3, 3], axis=0)).max() < 0.2  # no jumps


def test_trials_are_section_4_1():
    t_ns, T = trajectory(load_scenario("trials"), np.random.default_rng(0))
    assert np.diff(t_ns).tolist() == [250_000_000] * (len(t_ns) - 1)
    np.testing.assert_allclose(np.diff(T[:, 2, 3]), -0.375)
    assert np.abs(T[:, :2, 3]).max() <= 1.0


def test_rectangle_is_seen_from_every_side():
    _, T = trajectory(load_scenario("rectangle"), np.random.default_rng(0))
    np.testing.assert_allclose(T[:, 2, 3], 15.0)
    np.testing.assert_allclose(T[:, :3, :3], np.broadcast_to(R_DOCK_CAM_HEAD_ON, (len(T), 3, 3)), atol=1e-12)
    assert {(x > 0, y > 0) for x, y in T[:, :2, 3]} == {(a, b) for a in (True, False) for b in (True, False)}


@pytest.mark.parametrize("name", shipped_scenarios())
def test_shipped_scenarios_load_and_say_what_they_are(name):
    scenario = load_scenario(name)
    assert scenario.name == name
    assert scenario.about


@pytest.mark.parametrize(
    "setting",
    [
        "path.frame_interval_s=1e-300",
        "path.speed_m_s=1e-9",
        "path.start_z_m=1e308",
        "path.sway_period_s=[9, 3]",
        "path.taper_z_m=[2, 2]",
        "faults.spurious=100000",
        "faults.missing=[3, 1]",
        "faults.missing=[1, 2, 3]",
        "detections.rear_range_m=-1",
        "detections.mirror=only",
        "detections.black_outs.at_s=[[3, 1]]",
        "path.speed_spread_m_s=1.0",
        "path={kind: draws, count: 100000, hold: 2}",
        "path={kind: draws, hold: 1000}",
        "path={kind: draws, turn_deg: [0, 0, 181]}",
        "path.speed",
        "nothing=1",
        "path.speed_m_s=-1",
        "path.speed_m_s=.nan",
        "name.x=1",
        "path=[",
        "=3",
    ],
)
def test_bad_settings_are_refused_in_one_line(setting):
    with pytest.raises(InputError) as caught:
        load_scenario("approach", (setting,))
    assert "\n" not in str(caught.value)


def test_detections_lie_where_their_lights_truly_are():
    scenario = load_scenario("trials", ("faults.missing=2", "faults.spurious=3", "detections.noise_px=0.0"))
    for frame in simulated_frames(scenario, STATION, CAMERA, 4):
        named = frame.light >= 0
        assert (~named).sum() == 3
        np.testing.assert_allclose(frame.detections.uv[named], frame.uv[frame.light[named]])
        front = frame.in_view[:7].sum()
        assert (frame.light[named] < 7).sum() == max(front - 2, 0)


# Bare detections


def frames_of(name, *settings, seed=0, station=STATION):
    return list(simulated_frames(load_scenario(name, settings), station, CAMERA, seed))


def named(frame):
    return frame.light[frame.light >= 0]


def turns(frames):
    """Pitch-yaw tilt and roll of each frame, degrees, by the order in which the camera is turned."""
    R = np.array([R_DOCK_CAM_HEAD_ON.T @ frame.T_dock_cam[:3, :3] for frame in frames])
    return np.rad2deg(np.arccos(R[:, 2, 2])), np.rad2deg(np.arctan2(R[:, 1, 0] - R[:, 0, 1], R[:, 0, 0] + R[:, 1, 1]))


def test_rotations_are_those_of_one_at_a_time(rng):
    w = np.concatenate([rng.normal(size=(50, 3)), 1e-9 * rng.normal(size=(5, 3)), np.zeros((1, 3))])
    np.testing.assert_allclose(rotations(w), [so3_exp(one) for one in w], atol=1e-14)


@pytest.mark.parametrize("name", ["nominal", "joint", "three-lights", "rectangle"])
def test_truth_of_detections_is_the_projection_from_the_true_pose(name):
    settings = ("detections.survey=false", "detections.calibration=false", "detections.noise_px=0")
    for frame in frames_of(name, *settings)[::7]:
        uv = project_lights(CAMERA, frame.T_dock_cam, STATION.p_dock)
        np.testing.assert_allclose(frame.uv, uv, atol=1e-9)
        np.testing.assert_allclose(frame.detections.uv[frame.light >= 0], uv[named(frame)], atol=1e-9)
        assert frame.in_view[named(frame)].all()
        assert (np.diff(named(frame)) > 0).all()


@pytest.mark.parametrize("name", shipped_scenarios())
def test_same_seed_same_frames(name):
    settings = ("path.count=20",) if load_scenario(name).path.kind == "draws" else ()
    one, two, other = (frames_of(name, *settings, seed=seed) for seed in (3, 3, 4))
    assert all(np.array_equal(a.detections.uv, b.detections.uv) for a, b in zip(one, two, strict=True))
    assert all(np.array_equal(a.T_dock_cam, b.T_dock_cam) for a, b in zip(one, two, strict=True))
    uv = [np.concatenate([frame.detections.uv for frame in frames]) for frames in (one, other)]
    assert not np.array_equal(*uv)


def test_faults_do_not_change_the_path():
    clean, faulty = frames_of("trials"), frames_of("trials", "faults.missing=[1, 3]", "faults.spurious=[1, 5]")
    for a, b in zip(clean, faulty, strict=True):
        assert np.array_equal(a.T_dock_cam, b.T_dock_cam)


def test_draws_are_spread_and_have_the_front_layer_in_view():
    frames = frames_of("missing-spurious", "path.count=2000", "detections.noise_px=0")
    z = np.array([frame.T_dock_cam[2, 3] for frame in frames])
    np.testing.assert_allclose(np.percentile(z, [0, 25, 50, 75, 100]), [3, 7, 11, 15, 19], atol=0.5)
    tilt, roll = turns(frames)
    assert 3.0 < tilt.max() <= np.hypot(3, 3) + 1e-6
    np.testing.assert_allclose(np.percentile(roll, [0, 50, 100]), [-3, 0, 3], atol=0.15)
    assert all(frame.in_view[:7].all() and not frame.in_view[7:].any() for frame in frames)
    spurious = np.concatenate([frame.detections.uv[frame.light < 0] for frame in frames])
    assert CAMERA.contains(spurious).all()
    np.testing.assert_allclose(spurious.mean(axis=0) / [CAMERA.width, CAMERA.height], 0.5, atol=0.02)
    shares = np.bincount([len(named(frame)) for frame in frames], minlength=8)[4:7] / len(frames)
    np.testing.assert_allclose(shares, 1 / 3, atol=0.04)
    shares = np.bincount([(frame.light < 0).sum() for frame in frames], minlength=6)[1:] / len(frames)
    np.testing.assert_allclose(shares, 0.2, atol=0.04)


def test_any_roll_is_any():
    tilt, roll = turns(frames_of("any-roll", "path.hold=1", "path.count=2000"))
    assert 3.0 < tilt.max() < 3.0 * 2**0.5 + 1e-3
    np.testing.assert_allclose(np.percentile(roll, [0, 25, 50, 75, 100]), [-180, -90, 0, 90, 180], atol=12)


def test_a_wide_tilt_is_wide_and_leaves_the_roll():
    tilt, roll = turns(frames_of("wide-tilt", "path.hold=1", "path.count=2000"))
    assert 29.0 < tilt.max() <= 30.0 + 1e-6
    assert np.abs(roll).max() < 3.0 + 1e-6


def test_held_frames_move_slowly_and_miss_the_same_lights():
    frames = frames_of("three-lights", "path.count=50")
    assert [frame.sequence for frame in frames] == np.repeat(np.arange(50), 5).tolist()
    assert [frame.step for frame in frames] == [0, 1, 2, 3, 4] * 50
    stamps = np.array([frame.detections.t_ns for frame in frames]).reshape(-1, 5)
    assert np.diff(stamps).tolist() == [[66_666_700] * 4] * 50
    assert np.diff(stamps[:, 0]).min() > 10e9
    seen = np.array([named(frame) for frame in frames]).reshape(50, 5, 3)
    assert (seen == seen[:, :1]).all()
    spurious = np.array([frame.detections.uv[3:] for frame in frames]).reshape(50, 5, -1)
    assert (spurious[:, 0] != spurious[:, 1]).all()
    T = np.array([frame.T_dock_cam for frame in frames]).reshape(50, 5, 4, 4)
    np.testing.assert_allclose(np.diff(T[:, :, 2, 3]), -0.5 / 15, rtol=1e-5)
    moved = np.linalg.norm(np.diff(T[:, :, :3, 3], axis=1), axis=2) * 15
    assert 0.5 <= moved.min() <= np.median(moved) < 0.6
    assert all(frame.in_view[:7].all() for frame in frames)


def test_beside_is_beside():
    for frame in frames_of("beside", "path.count=100", "detections.noise_px=0"):
        corners = frame.uv[:7].min(axis=0), frame.uv[:7].max(axis=0)
        margin = 0.25 * (corners[1] - corners[0])
        spurious = frame.detections.uv[frame.light < 0]
        assert len(spurious) == 5
        assert ((spurious >= corners[0] - margin) & (spurious <= corners[1] + margin)).all()


def test_labels_are_wrong_and_lights_missing_as_often_as_asked():
    frames = frames_of("joint")
    rear = np.concatenate([frame.light for frame in frames]) >= 7
    said = np.concatenate([frame.detections.p_rear for frame in frames])
    assert set(said) == {0.05, 0.95}
    assert ((said > 0.5) != rear).mean() == pytest.approx(0.3, abs=0.015)
    shares = [len(named(frame)) / frame.in_view.sum() for frame in frames]
    assert np.mean(shares) == pytest.approx(0.8, abs=0.015)
    assert all(np.isnan(frame.detections.p_rear).all() for frame in frames_of("joint-nocolor"))


def test_noise_has_its_sigma():
    for name, sigma in (("missing-1", 0.5), ("noise-2px", 2.0)):
        off = [frame.detections.uv[frame.light >= 0] - frame.uv[named(frame)] for frame in frames_of(name)]
        assert np.concatenate(off).std() == pytest.approx(sigma, rel=0.03)


def test_survey_errors_have_their_sigmas():
    """Seen from afar, head-on, the true pixels give each light's place across the line of sight."""
    straight = "path={start_z_m: 19, end_z_m: 18, sway_m: [0, 0, 0], sway_deg: [0, 0, 0]}"
    off_m = []
    for seed in range(400):
        frame = frames_of("approach", straight, "detections.survey=true", seed=seed)[0]
        uv = project_lights(CAMERA, frame.T_dock_cam, STATION.p_dock)
        off_m.append((frame.uv - uv)[:7] * 19.0 / CAMERA.K[0, 0])
    common = np.mean(off_m, axis=1, keepdims=True)
    assert common.std() == pytest.approx(np.hypot(0.005, 0.002 / np.sqrt(7)), rel=0.1)
    assert (off_m - common).std() == pytest.approx(0.002 * np.sqrt(6 / 7), rel=0.04)


def test_errors_of_survey_and_lens_last_for_a_sequence():
    frames = frames_of("three-lights", "path.count=50", "detections.survey=true", "detections.calibration=true")
    off = [frame.uv[:7] - project_lights(CAMERA, frame.T_dock_cam, STATION.p_dock[:7]) for frame in frames]
    off = np.array(off).reshape(50, 5, -1)
    assert np.abs(off - off[:, :1]).max() < 1.5
    assert off[:, 0].std() > 2.0


def test_calibration_errors_have_their_sigmas():
    exact = replace(STATION, sigma_light_m=0.0, sigma_layer_m=0.0)
    frames = frames_of(
        "joint", "detections.calibration=true", "detections.survey=true", "path.count=1000", station=exact
    )
    errors = []
    for frame in frames:
        uv = project_lights(CAMERA, frame.T_dock_cam, STATION.p_dock)
        A = np.zeros((26, 3))
        A[:13, 0], A[13:, 0] = (uv - CAMERA.center_px).T
        A[:13, 1] = A[13:, 2] = 1.0
        errors.append(np.linalg.lstsq(A, (frame.uv - uv).T.ravel())[0])
    np.testing.assert_allclose(np.std(errors, axis=0), [0.003, 2.0, 2.0], rtol=0.07)
    np.testing.assert_allclose(np.mean(errors, axis=0), 0.0, atol=0.25)


def test_a_path_has_one_survey_error_through_the_run():
    frames = frames_of("nominal", "detections.drop=0.0")
    near = [frame for frame in frames if 2.0 < frame.T_dock_cam[2, 3] < 6.0]
    off = [frame.uv[7:] - project_lights(CAMERA, frame.T_dock_cam, STATION.p_dock)[7:] for frame in near]
    assert np.abs(off).max() > 0.5
    assert np.abs(np.diff(off, axis=0)).max() < 0.2


def test_nominal_is_what_it_says():
    dead, spurious, speed = [], [], []
    for seed in range(30):
        frames = frames_of("nominal", "path.frame_interval_s=0.5", seed=seed)
        reach = np.array([np.linalg.norm(frame.T_dock_cam[:3, 3]) for frame in frames])
        rear = np.array([frame.in_view[7:].any() for frame in frames])
        assert 11.0 < reach[rear].max() < 20.5
        assert 23.0 < reach[[frame.in_view[:7].any() for frame in frames]].max() < 30.5
        speed.append((frames[0].T_dock_cam[2, 3] - frames[1].T_dock_cam[2, 3]) / 0.5)
        lit = np.zeros(13, bool)
        for frame in frames:
            lit[named(frame)] = True
            spurious.append((frame.light < 0).sum())
        dead.append(13 - lit.sum())
    assert set(dead) == {0, 1, 2, 3}
    assert 0.68 < min(speed) < 0.8 < 1.2 < max(speed) < 1.32
    assert min(spurious) == 0
    assert np.mean(spurious) == pytest.approx(2.5, abs=0.5)


def test_nothing_is_seen_in_a_black_out():
    frames = frames_of("nominal", "detections.black_outs.at_s=[[15, 16.5], [20, 20.3]]")
    t = np.array([frame.detections.t_ns for frame in frames]) * 1e-9
    black = ((t >= 15) & (t <= 16.5)) | ((t >= 20) & (t <= 20.3))
    assert all(len(frame.detections) == 0 for frame, out in zip(frames, black, strict=True) if out)
    assert all(len(named(frame)) for frame, out in zip(frames, black, strict=True) if not out and frame.in_view.any())
    blind = [sum(len(frame.detections) == 0 for frame in frames_of("black-outs", seed=seed)[150:]) for seed in range(5)]
    assert min(blind) > 3


def test_the_mirror_image_is_seen_alone():
    frames = frames_of("mirror-only", "path.count=200", "detections.noise_px=0")
    for frame in frames:
        assert (frame.light == -1).all()
        assert not frame.in_view.any()
        assert 7 <= len(frame.detections) <= 13
        # the first light's ray, where it meets the dock's plane, gives the height of the surface
        ray = frame.T_dock_cam[:3, :3] @ CAMERA.unproject(frame.detections.uv[:1])[0]
        at = frame.T_dock_cam[:3, 3] + ray * (frame.T_dock_cam[2, 3] / -ray[2])
        h = 0.5 * (at[1] + STATION.p_dock[0, 1])
        assert 1.0 <= h <= 4.0
        assert frame.T_dock_cam[1, 3] < h
        mirrored = STATION.p_dock[:7] * [1, -1, 1] + [0, 2 * h, 0]
        uv = project_lights(CAMERA, frame.T_dock_cam, mirrored)
        np.testing.assert_allclose(frame.detections.uv[:7], uv, atol=1e-6)


def test_clutter_alone_has_no_dock():
    frames = frames_of("clutter")
    assert {len(frame.detections) for frame in frames} == set(range(4, 21))
    assert all((frame.light == -1).all() and np.isnan(frame.uv).all() and not frame.in_view.any() for frame in frames)


def test_attitude_sensor_has_a_bias_for_the_run_and_little_noise():
    settings = ("detections.attitude={bias_deg: 2.0, noise_deg: 0.1}", "path.frame_interval_s=0.5")
    biases = []
    for seed in range(60):
        frames = frames_of("nominal", *settings, seed=seed)
        w = np.rad2deg([so3_log(f.detections.attitude.R_dock_cam @ f.T_dock_cam[:3, :3].T) for f in frames])
        assert w.std(axis=0) == pytest.approx(0.1, rel=0.5)
        biases.append(w.mean(axis=0))
    assert np.std(biases) == pytest.approx(2.0, rel=0.2)
    assert frames[0].detections.attitude.sigma_rad == pytest.approx(np.deg2rad(np.hypot(2.0, 0.1)))
    assert frames_of("nominal")[0].detections.attitude is None


def test_without_any_pose_there_is_one_line():
    with pytest.raises(InputError, match="no pose at") as caught:
        frames_of("missing-1", "path.z_m=0.3", "path.count=2")
    assert "\n" not in str(caught.value)


def test_a_frame_takes_microseconds():
    """A hundred is the bound on a busy machine; alone it takes about twenty."""
    frames_of("missing-spurious")
    best = np.inf
    for seed in range(3):
        start = time.process_time()
        count = len(frames_of("missing-spurious", seed=seed))
        best = min(best, (time.process_time() - start) / count)
    assert best < 100e-6


def read(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_detections_folder_says_what_was_seen(tmp_path):
    scenario = load_scenario("trials", ("faults.missing=1",))
    frames = write_detections(scenario, STATION, CAMERA, 0, tmp_path)
    truth, detections = read(tmp_path / "lights_truth.csv"), read(tmp_path / "detections.csv")
    assert frames == len(read(tmp_path / "timestamps.csv"))
    assert sum(row["visible"] == "1" for row in truth) == len(detections)
    assert (tmp_path / "camera.yaml").exists()


# Stations


def test_a_scenario_is_simulated_on_the_station_that_it_is_made_for():
    assert load_station(station_of(load_scenario("approach"))).name == STATION.name
    assert {name: load_station(station_of(load_scenario(name))).name for name in ("plate", "funnel")} == {
        "plate": "plate",
        "funnel": "funnel-ring",
    }
    with pytest.raises(InputError, match=r"^approach: station mud is not shipped; there are cage-13, cage-2x2x5, "):
        station_of(load_scenario("approach", ("station=mud",)))


def test_a_campaign_takes_each_scenarios_own_station_unless_one_is_given():
    scenarios = [load_scenario("approach"), load_scenario("plate")]
    own = plan(scenarios, ["lumidock"], (0, 1), None, CAMERA_FILE)
    assert [shard.station.name for shard in own.shards] == [STATION.name, "plate"]
    given = plan(scenarios, ["lumidock"], (0, 1), STATION_FILE, CAMERA_FILE)
    assert [shard.station.name for shard in given.shards] == [STATION.name] * 2
    assert own.shards[0].key == given.shards[0].key
    assert own.shards[1].key != given.shards[1].key
