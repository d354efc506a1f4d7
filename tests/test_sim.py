"""The simulator: paths, light, sensor and the folders it writes."""

import csv
import filecmp

import cv2
import numpy as np
import pytest
from bench.shipped import shipped_camera, shipped_station

from lumidock.camera import Camera
from lumidock.errors import InputError
from lumidock.geometry import se3_inverse, so3_log
from lumidock.sim import optics, sensor
from lumidock.sim.scenario import R_DOCK_CAM_HEAD_ON, Scenario, load_scenario, shipped_scenarios, trajectory
from lumidock.sim.sequence import render_frame, write_detections, write_rendered
from lumidock.sim.spots import spot_frames

STATION, CAMERA = shipped_station(), shipped_camera()
SMALL = Camera(320, 256, np.array([[273.0, 0, 159.5], [0, 273.0, 127.5], [0, 0, 1]]))
NOTHING = np.empty(0, np.int64)


def head_on(z):
    T = np.eye(4)
    T[:3, :3] = R_DOCK_CAM_HEAD_ON
    T[2, 3] = z
    return T


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


def test_projection_agrees_with_opencv():
    T = trajectory(load_scenario("approach"), np.random.default_rng(3))[1][140]
    T_cam_dock = se3_inverse(T)
    uv, _ = cv2.projectPoints(STATION.p_dock, so3_log(T_cam_dock[:3, :3]), T_cam_dock[:3, 3], CAMERA.K, None)
    np.testing.assert_allclose(optics.lamps(Scenario(), STATION, CAMERA, T).uv, uv[:, 0], atol=1e-6)


def test_direct_light_follows_inverse_square_and_attenuation():
    near, far = (optics.lamps(Scenario(), STATION, CAMERA, head_on(z)).direct_e[1] for z in (10.0, 20.0))
    d = [np.hypot(z, np.hypot(0.92, 0.21)) for z in (10.0, 20.0)]
    beam = (20.0 / d[1]) / (10.0 / d[0])
    # the green pixel collects mostly the green band, whose attenuation is 0.372 / m
    expected = (d[0] / d[1]) ** 2 * np.exp(-(0.081 + 0.291) * (d[1] - d[0])) * beam
    assert far[1] / near[1] == pytest.approx(expected, rel=0.1)


def test_beam_falls_to_half_at_its_half_angle():
    def green(angle):
        T = np.eye(4)
        p = STATION.p_dock[0] + 5.0 * np.array([np.sin(angle), 0, np.cos(angle)])
        T[:3, 3] = p
        return optics.lamps(Scenario(), STATION, CAMERA, T).direct_e[0, 1]

    assert green(np.deg2rad(60.0)) / green(0.0) == pytest.approx(0.5, rel=1e-6)


@pytest.mark.parametrize("window_px", [0.3, 1.7, 6.0])
def test_core_profile_keeps_its_light_and_its_centre(window_px):
    at = np.array([0.37, -0.21])
    pixels = np.arange(-20, 21)
    shares = optics.core_profile(pixels - at[0], pixels - at[1], window_px, 0.7).astype(float)
    assert shares.sum() == pytest.approx(1.0, abs=2e-3)
    centre = [(shares * pixels[None, :]).sum(), (shares * pixels[:, None]).sum()] / shares.sum()
    np.testing.assert_allclose(centre, at, atol=0.005)


def test_noise_follows_the_photon_transfer_curve():
    settings = Scenario().sensor.model_copy(update={"gamma": 1.0})
    for electrons in (200.0, 2000.0, 6000.0):
        flat = np.full((200, 200), electrons, np.float32)
        image = sensor.picture(flat, settings, np.random.default_rng(1))
        gain = 255.0 / settings.full_well_e
        assert image.mean() == pytest.approx(electrons * gain, rel=0.02, abs=0.2)
    raw_sigma = np.sqrt(2000.0 + 2.3**2) * 255.0 / settings.full_well_e
    green_at_green = sensor.picture(np.full((400, 400), 2000.0, np.float32), settings, np.random.default_rng(2))[
        ::2, 1::2, 1
    ]
    assert green_at_green.astype(float).std() == pytest.approx(np.hypot(raw_sigma, 12**-0.5), rel=0.1)


def test_picture_shows_the_lights_where_the_truth_says(rng):
    T = head_on(6.0)
    image, seen, snr = render_frame(Scenario(), STATION, CAMERA, T, np.empty((0, 2)), np.array([2]), rng)
    for i in range(7):
        u, v = np.round(seen.uv[i]).astype(int)
        assert (image[v, u].max() > 200) == (i != 2)
    assert snr[2] == 0.0
    assert snr[:2].min() > 1000


def test_spots_have_the_truth_they_claim():
    scenario = load_scenario("trials", ("faults.missing=2", "faults.spurious=3", "spots.noise_px=0.0"))
    for frame in spot_frames(scenario, STATION, CAMERA, 4):
        named = frame.light >= 0
        assert (~named).sum() == 3
        np.testing.assert_allclose(frame.detections.uv[named], frame.uv[frame.light[named]])
        front = frame.in_view[:7].sum()
        assert (frame.light[named] < 7).sum() == max(front - 2, 0)


def read(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_same_seed_same_bytes_on_one_worker_or_two(tmp_path):
    scenario = load_scenario("approach", ("path.frame_interval_s=4.0", "faults.spurious=2", "faults.missing=1"))
    for name, workers, seed in (("one", 1, 5), ("two", 2, 5), ("other", 1, 6)):
        assert write_rendered(scenario, STATION, SMALL, seed, tmp_path / name, workers=workers) == 9
    files = [path.relative_to(tmp_path / "one") for path in (tmp_path / "one").rglob("*") if path.is_file()]
    same, different, _ = filecmp.cmpfiles(tmp_path / "one", tmp_path / "two", files, shallow=False)
    assert len(same) == len(files) == 14
    assert not different
    assert not filecmp.cmp(tmp_path / "one" / "truth.csv", tmp_path / "other" / "truth.csv", shallow=False)
    assert {row["kind"] for row in read(tmp_path / "one" / "spurious_truth.csv")} == {"injected"}
    assert list(read(tmp_path / "one" / "truth.csv")[0]) == [
        "frame",
        "t_ns",
        "x_m",
        "y_m",
        "z_m",
        "qx",
        "qy",
        "qz",
        "qw",
    ]
    assert list(read(tmp_path / "one" / "lights_truth.csv")[0]) == ["frame", "light", "u_px", "v_px", "visible", "snr"]


def test_detections_folder_says_what_was_seen(tmp_path):
    scenario = load_scenario("trials", ("faults.missing=1",))
    frames = write_detections(scenario, STATION, CAMERA, 0, tmp_path)
    truth, spots = read(tmp_path / "lights_truth.csv"), read(tmp_path / "detections.csv")
    assert frames == len(read(tmp_path / "timestamps.csv"))
    assert sum(row["visible"] == "1" for row in truth) == len(spots)
    assert (tmp_path / "camera.yaml").exists()
