"""Rendered sequences: what is in the pictures, the truth and the stream, and that workers change nothing."""

import csv
import filecmp
from dataclasses import replace
from itertools import pairwise
from typing import get_args

import cv2
import numpy as np
import pytest
from bench.shipped import shipped_camera, shipped_station

from lumidock.camera import Camera, load_camera
from lumidock.errors import InputError
from lumidock.pose import project_lights
from lumidock.sim import knobs
from lumidock.sim.detections import simulated_frames
from lumidock.sim.scenario import R_DOCK_CAM_HEAD_ON, Scenario, load_scenario, shipped_scenarios
from lumidock.sim.schedule import controlled, metered, schedule_of
from lumidock.sim.sequence import render_frame, rendered, write_detections, write_rendered
from lumidock.sim.stream import rows_of
from lumidock.streams.images import read_image
from lumidock.streams.sources import open_source

STATION, CAMERA = shipped_station(), shipped_camera()
SMALL = Camera(320, 256, np.array([[273.0, 0, 159.5], [0, 273.0, 127.5], [0, 0, 1]]))
FEW, FEW_DRAWS = ("path.frame_interval_s=4.0",), ("path.count=2", "path.hold=2")
NOTHING, NO_SPURIOUS = np.empty(0, np.int64), np.empty((0, 2))


def head_on(z):
    T = np.eye(4)
    T[:3, :3] = R_DOCK_CAM_HEAD_ON
    T[2, 3] = z
    return T


def read(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def is_drawn(name):
    return load_scenario(name).path.kind == "draws"


def written(out, name, *settings, seed=3, workers=1, camera=SMALL, video=False):
    scenario = load_scenario(name, (*FEW, *(FEW_DRAWS if is_drawn(name) else ()), *settings))
    write_rendered(scenario, STATION, camera, seed, out, workers=workers, video=video)
    return out


def electrons(name, z, *settings, seed=0):
    scenario = load_scenario(name, settings)
    plan = schedule_of(scenario, STATION, SMALL, seed)
    conditions = replace(plan.conditions(0), T_dock_cam=head_on(z), T_cam_later=np.eye(4))
    return plan.renderer(0).expect(conditions)


@pytest.mark.parametrize("name", [name for name in shipped_scenarios() if name != "any-roll"])
def test_every_shipped_scenario_can_be_rendered(name, tmp_path):
    out = written(tmp_path, name, *(("path.hold=1",) if is_drawn(name) else ()))
    rows = read(out / "timestamps.csv")
    assert len(rows) >= 2
    poses = {row["frame"] for row in read(out / "truth.csv")}
    assert poses == {row["frame"] for row in rows}
    assert {row["frame"] for row in read(out / "lights_truth.csv")} <= poses


def test_same_seed_same_bytes_on_one_worker_or_two(tmp_path):
    settings = ("faults.spurious=2", "faults.missing=1", "around.snow={}", "around.headlamp={}")
    settings += ("around.surface={}", "sensor.auto_exposure={}", "sensor.hot_pixels=5", "path.frame_interval_s=6.0")
    for folder, workers, seed in (("one", 1, 5), ("two", 2, 5), ("other", 1, 6)):
        written(tmp_path / folder, "approach", *settings, workers=workers, seed=seed)
    files = [path.relative_to(tmp_path / "one") for path in (tmp_path / "one").rglob("*") if path.is_file()]
    same, different, _ = filecmp.cmpfiles(tmp_path / "one", tmp_path / "two", files, shallow=False)
    assert len(same) == len(files) == 13
    assert not different
    assert not filecmp.cmp(tmp_path / "one" / "truth.csv", tmp_path / "other" / "truth.csv", shallow=False)
    kinds = {row["kind"] for row in read(tmp_path / "one" / "spurious_truth.csv")}
    assert {"injected", "hot_pixel"} <= kinds
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


def test_truth_of_a_rendered_light_is_its_projection_and_its_picture_is_there(tmp_path):
    out = written(tmp_path, "approach", "path.start_z_m=9", "path.end_z_m=2", camera=CAMERA)
    poses = {row["frame"]: row for row in read(out / "truth.csv")}
    assert poses
    scenario = load_scenario("approach", (*FEW, "path.start_z_m=9", "path.end_z_m=2"))
    plan = schedule_of(scenario, STATION, CAMERA, 3)
    for number in range(len(plan)):
        uv = project_lights(CAMERA, plan.course.T_dock_cam[number], STATION.p_dock)
        image = read_image(out / "frames" / f"{number:06d}.jpg")
        for row in read(out / "lights_truth.csv"):
            if int(row["frame"]) == number and row["visible"] == "1":
                u, v = float(row["u_px"]), float(row["v_px"])
                np.testing.assert_allclose([u, v], uv[STATION.ids.index(row["light"])], atol=1e-3)
                assert image[round(v), round(u)].max() > 150


def test_snr_is_what_a_matched_filter_measures(rng):
    """Truth's ratio against the scatter of a filter's output over noisy read-outs, far, dim and among neighbours."""
    scenario = load_scenario("approach", ("output.color=false", "output.pixels=mono16", "output.file=png"))
    plan = schedule_of(scenario, STATION, CAMERA, 0)
    renderer = plan.renderer(0)
    conditions = replace(plan.conditions(0), T_dock_cam=head_on(26.0), T_cam_later=np.eye(4))
    expected = renderer.expect(conditions)
    electrons_lit = expected.electrons.copy()
    without = renderer.expect(replace(conditions, dark=np.array([4]))).electrons
    u, v = np.round(expected.emitters.uv[4]).astype(int)
    box = np.s_[v - 6 : v + 7, u - 6 : u + 7]
    ring = (electrons_lit - without)[v - 6, u - 6 : u + 7].mean()
    signal = (electrons_lit - without)[box] - ring
    weight = signal / (without[box] + ring + 2.3**2)
    outputs = []
    for _ in range(400):
        noisy = rng.poisson(without[box] + ring) + rng.normal(0, 2.3, signal.shape)
        outputs.append((weight * noisy).sum())
    measured = (weight * signal).sum() / np.std(outputs)
    assert expected.snr[4] == pytest.approx(measured, rel=0.12)
    assert expected.snr[4] > 8


def test_more_light_around_lowers_the_snr():
    night, day = (electrons("approach", 15.0, f"daylight.depth_m={depth}").snr[:7].mean() for depth in (60.0, 10.0))
    assert day < 0.6 * night
    lit = electrons("approach", 15.0, "daylight.depth_m=60", "around.headlamp={power_w: 300}").snr[:7].mean()
    assert lit < 0.8 * night


def test_what_is_saturated_all_over_does_not_show():
    shown, drowned = (electrons("approach", 9.0, f"sensor.exposure_ms={ms}") for ms in (2.0, 1000.0))
    assert (shown.snr[:7] > 100).all()
    assert (drowned.snr[:7] < 8).all()


def test_dark_hidden_and_failed_lamps_are_not_visible(rng):
    scenario, T_dock_cam = load_scenario("approach"), head_on(6.0)
    _, seen, snr = render_frame(scenario, STATION, SMALL, T_dock_cam, NO_SPURIOUS, dark=np.array([2]), rng=rng)
    assert snr[2] == 0.0
    assert not seen.lit[2]
    assert snr[:2].min() > 100
    failed = load_scenario("approach", (*FEW, "lamps.failures={F1: 0.0, F2: 100.0}"))
    assert schedule_of(failed, STATION, SMALL, 0).conditions(1).dark.tolist() == [0]
    hidden = electrons("approach", 6.0, "around.hull=0.9")
    assert hidden.snr[:7].min() < 8 < electrons("approach", 6.0).snr[:7].min()
    assert electrons("front-only", 6.0).snr[7:13].max() == 0.0


def test_swapped_colours_are_swapped():
    straight, swapped = (electrons(name, 6.0).emitters.at_lens[:13] for name in ("approach", "swapped-colors"))
    assert (straight[:7, 2] > 0).all()
    assert (straight[7:, 2] == 0).all()
    assert (swapped[:7, 2] == 0).all()
    assert (swapped[7:, 2] > 0).all()


def test_what_shines_beside_the_dock_is_in_the_truth(tmp_path):
    near = ("path.start_z_m=9", "path.end_z_m=5", "path.frame_interval_s=2.0")
    here = "around.vehicle={start: [0, 1, 1], velocity_m_s: [0, 0, 0]}"
    for name, kind in (("pool", "mirror"), ("pool", "glint"), ("headlamp", "snow"), ("vehicle", "vehicle")):
        settings = (*near, here) if name == "vehicle" else near
        out = written(tmp_path / f"{name}-{kind}", name, *settings, camera=CAMERA)
        rows = [row for row in read(out / "spurious_truth.csv") if row["kind"] == kind]
        assert rows, kind
    images = [row for row in read(tmp_path / "pool-mirror" / "spurious_truth.csv") if row["kind"] == "mirror"]
    assert np.median([float(row["v_px"]) for row in images]) < CAMERA.height / 2


def test_snow_keeps_its_place_while_the_camera_moves():
    scenario = load_scenario("headlamp", ("around.snow={drift_m_s: [0, 0, 0]}",))
    plan = schedule_of(scenario, STATION, SMALL, 0)

    def particles(z):
        conditions = replace(plan.conditions(0), T_dock_cam=head_on(z), T_cam_later=np.eye(4))
        seen = plan.renderer(0).expect(conditions).emitters
        at = seen.p_cam[seen.kind == "snow"] @ head_on(z)[:3, :3].T + head_on(z)[:3, 3]
        return {tuple(np.round(p, 6)) for p in at}

    here, there = particles(10.0), particles(9.9)
    assert len(here & there) > 0.7 * len(here)


def test_auto_exposure_settles_at_its_mean_and_gives_way_to_bright_lamps():
    settings = ("path.frame_interval_s=1.5", "sensor.auto_exposure={min_ms: 0.01}", "sensor.exposure_ms=0.2")
    settings += ("output={pixels: mono8, color: false}",)
    scenario = load_scenario("approach", settings)
    plan = schedule_of(scenario, STATION, SMALL, 0)
    light = [metered(plan, number) for number in range(len(plan))]
    exposure_s = controlled(plan, scenario.sensor.auto_exposure, light)
    assert exposure_s[0] == pytest.approx(0.2e-3)
    settled = replace(plan, exposure_s=exposure_s)
    expected = settled.renderer(8).expect(settled.conditions(8))
    image = settled.renderer(8).picture_of(expected, np.random.default_rng(0))
    assert image.mean() / 255.0 == pytest.approx(0.12, rel=0.1)
    nearest = int(np.argmax([(counts * np.arange(len(counts))).sum() for counts in light]))
    assert exposure_s[nearest + 1] < 0.6 * exposure_s[8]


PIXELS = {"bgr8": (3, np.uint8), "mono8": (2, np.uint8), "mono16": (2, np.uint16), "bayer8": (2, np.uint8)}
PIXELS["bayer16"] = (2, np.uint16)


@pytest.mark.parametrize("pixels", PIXELS)
def test_every_kind_of_picture_comes_out(pixels, tmp_path):
    out = written(tmp_path, "approach", f"output={{pixels: {pixels}, file: png}}", "path.start_z_m=5")
    image = cv2.imread(str(out / "frames" / "000000.png"), cv2.IMREAD_UNCHANGED)
    assert (image.ndim, image.dtype) == PIXELS[pixels]
    row = read(out / "timestamps.csv")[0]
    assert row.get("encoding") == (f"bayer_rggb{pixels[5:]}" if pixels.startswith("bayer") else None)
    assert all(hasattr(item, "image") for item in open_source(out).items())


def test_patterns_of_the_mosaic_hold_the_colours_they_name():
    blue_dock = ("lamps.layers=rear", "daylight.surface_w_m2=0")
    for pattern in ("rggb", "bggr", "grbg", "gbrg"):
        light = electrons("approach", 1.0, *blue_dock, f"output.pattern={pattern}").electrons
        planes = [light[i // 2 :: 2, i % 2 :: 2].sum(dtype=float) for i in range(4)]
        assert pattern[int(np.argmax(planes))] == "b"
        assert pattern[int(np.argmin(planes))] == "r"


@pytest.mark.parametrize(
    "setting", ["output={pixels: bayer8}", "output={color: false}", "water.kind=mud", "lens.blur_px=0"]
)
def test_what_cannot_be_is_refused_in_one_line(setting):
    with pytest.raises(InputError) as caught:
        load_scenario("approach", (setting,))
    assert "\n" not in str(caught.value)


def knob_names(section, prefix=""):
    """Names of all knobs of a section and of those below it."""
    for name, field in section.model_fields.items():
        kinds = [kind for kind in (field.annotation, *get_args(field.annotation)) if isinstance(kind, type)]
        below = [kind for kind in kinds if issubclass(kind, knobs.KnobSection)]
        yield from knob_names(below[0], f"{prefix}{name}.") if below else [f"{prefix}{name}"]


@pytest.mark.parametrize(
    "section",
    [
        name
        for name in Scenario.model_fields
        if name not in ("name", "about", "station", "config", "assumptions", "says")
    ],
)
@pytest.mark.filterwarnings("ignore:.*encountered:RuntimeWarning")
def test_absurd_settings_are_refused_or_simulated(section, tmp_path):
    path = ("path.start_z_m=4", "path.end_z_m=3.5", "path.frame_interval_s=0.5")
    refusals = []
    for name in knob_names(Scenario.model_fields[section].annotation, f"{section}."):
        for value in ("1e-300", "1e300", "[1e-300, 1e-300]", "[1e300, 1e300]", "[1e300, 1e300, 1e300]"):
            try:
                scenario = load_scenario("approach", (*path, f"{name}={value}"))
                list(simulated_frames(scenario, STATION, SMALL, 0))
                rendered(scenario, STATION, SMALL, 0, tmp_path)
            except InputError as error:
                refusals.append(str(error))
    assert refusals
    assert not any("\n" in text for text in refusals)


def test_a_video_holds_the_pictures(tmp_path):
    out = written(tmp_path, "approach", video=True)
    items = list(open_source(out / "video.mp4").items())
    assert len(items) == len(read(out / "timestamps.csv")) == 9
    assert not (out / "frames").exists()
    with pytest.raises(InputError, match="a video holds"):
        written(tmp_path / "raw", "approach", "output={pixels: bayer8, file: png}", video=True)


def test_a_wrong_calibration_is_wrong_by_what_it_says(tmp_path):
    out = written(tmp_path, "wrong-calibration")
    assert load_camera(out / "camera.yaml").K.tolist() == SMALL.K.tolist()
    lights = {row["light"]: float(row["u_px"]) for row in read(out / "lights_truth.csv") if row["frame"] == "000006"}
    plan = schedule_of(load_scenario("wrong-calibration", FEW), STATION, SMALL, 3)
    believed = project_lights(SMALL, plan.course.T_dock_cam[6], STATION.p_dock)
    apart = (lights["F7"] - lights["F1"]) / (believed[6, 0] - believed[0, 0])
    assert apart == pytest.approx(1.03, abs=1e-4)


def test_a_port_is_seen_through_and_its_calibration_is_written(tmp_path):
    out = written(tmp_path, "flat-port", camera=CAMERA)
    held, truth = load_camera(out / "camera.yaml"), read(out / "lights_truth.csv")
    assert held.distortion[0] > 0.1
    plan = schedule_of(load_scenario("flat-port", FEW), STATION, CAMERA, 3)
    for row in truth:
        believed = project_lights(held, plan.course.T_dock_cam[int(row["frame"])], STATION.p_dock)
        off = believed[STATION.ids.index(row["light"])] - [float(row["u_px"]), float(row["v_px"])]
        assert np.hypot(*off) < 3.0
    with pytest.raises(InputError, match="flat port"):
        write_detections(load_scenario("flat-port"), STATION, CAMERA, 0, tmp_path / "bare")


# The stream


def rows(n=4000, seed=1, **settings):
    return rows_of(knobs.StreamFaults(**settings), np.arange(n) * 150_000_000, np.random.default_rng(seed))


def test_a_sound_stream_is_complete():
    assert [(row.number, row.shows, row.t_ns, row.fault) for row in rows(5)] == [
        (i, i, i * 150_000_000, "") for i in range(5)
    ]


@pytest.mark.parametrize("fault", ["half_written", "black", "white", "over_exposed", "duplicated", "disordered"])
def test_faults_are_as_frequent_as_asked(fault):
    found = [row for row in rows(**{fault: 0.1}) if row.fault == fault]
    assert len(found) == pytest.approx(400, rel=0.2)


def test_lost_doubled_swapped_and_frozen_frames_are_that():
    assert len(rows(dropped=0.1)) == pytest.approx(3600, rel=0.02)
    doubled = rows(duplicated=0.1)
    assert sum(a.number == b.number and a.t_ns == b.t_ns for a, b in pairwise(doubled)) > 300
    swapped = rows(disordered=0.1)
    assert sum(b.t_ns < a.t_ns for a, b in pairwise(swapped)) > 300
    assert sorted(row.number for row in swapped) == list(range(4000))
    frozen = [row for row in rows(frozen=0.02, frozen_frames=4) if row.fault == "frozen"]
    assert all(row.shows < row.number <= row.shows + 4 for row in frozen)
    assert len(frozen) > 150


def test_the_clock_jumps_and_goes_on_from_there():
    steps = np.diff([row.t_ns for row in rows(clock_jump_s=0.8, clock_jumps=0.01)])
    assert set(steps) == {150_000_000, 950_000_000}
    assert min(np.diff([row.t_ns for row in rows(clock_jump_s=-3.0, clock_jumps=0.01)])) < 0


def test_a_doubled_row_has_one_file_and_one_truth(tmp_path):
    out = written(tmp_path, "approach", "stream={duplicated: 0.9, half_written: 0.5}", workers=2)
    stamps = [row["frame"] for row in read(out / "timestamps.csv")]
    assert len(stamps) > len(set(stamps)) == 9
    assert [row["frame"] for row in read(out / "truth.csv")] == sorted(set(stamps))
    halves = {row["frame"] for row in read(out / "stream_truth.csv") if row["fault"] == "half_written"}
    whole = written(tmp_path / "whole", "approach") / "frames"
    for frame in halves:
        half, all_of_it = ((folder / f"{frame}.jpg").stat().st_size for folder in (out / "frames", whole))
        assert half == all_of_it // 2


def test_spoilt_files_are_what_a_reader_gets(tmp_path):
    settings = "stream={half_written: 0.2, black: 0.2, white: 0.2, over_exposed: 0.3, frozen: 0.1, frozen_frames: 2}"
    out = written(tmp_path, "approach", settings, "path.frame_interval_s=0.3", "path.start_z_m=12", "path.end_z_m=2")
    faults = {row["frame"]: row["fault"] for row in read(out / "stream_truth.csv")}
    assert set(faults.values()) == {"half_written", "black", "white", "over_exposed", "frozen"}
    items = {getattr(item, "name", None) or item.frame: item for item in open_source(out).items()}
    for frame, fault in faults.items():
        if fault == "half_written":
            assert items[frame].reason == "bad_frame"
        else:
            level = items[frame].image.mean()
            assert {"black": level == 0, "white": level == 255, "over_exposed": level > 30, "frozen": True}[fault]
    visible = {row["frame"] for row in read(out / "lights_truth.csv") if row["visible"] == "1"}
    assert all(frame not in visible for frame, fault in faults.items() if fault in ("black", "white", "half_written"))
