import csv
import json
import shutil

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from lumidock.app.run import Setup, Summary
from lumidock.app.run import run as run_source
from lumidock.camera import Camera, load_camera, save_camera
from lumidock.config import Config
from lumidock.datatypes import Fix, Guide
from lumidock.errors import InputError
from lumidock.paper import PaperLocalizer
from lumidock.sim.scenario import load_scenario
from lumidock.sim.sequence import write_detections, write_rendered
from lumidock.station import load_station
from lumidock.streams.run_folder import FIX_COLUMNS, RunFolder, sha256
from lumidock.streams.sources import open_source

CAMERA = Camera(320, 256, np.array([[273.0, 0, 159.5], [0, 273.0, 127.5], [0, 0, 1]]))
LIGHTS = {"A": (-0.9, 0.7), "B": (0.8, 0.9), "C": (0.9, -0.4), "D": (-0.7, -0.8), "E": (0.1, 0.2)}
STATION = {
    "schema": 1,
    "name": "small",
    "lights": [{"id": name, "layer": "front", "position": [x, y, 0]} for name, (x, y) in LIGHTS.items()],
}
SETTINGS = ("path.start_z_m=4.0", "path.end_z_m=2.5", "path.frame_interval_s=0.25", "sensor.exposure_ms=0.05")
LOST = ("bad_frame", "bad_stamp")


def simulate(folder, *settings, bare=False):
    """A sequence of seven frames of a small station, 4.0 to 2.5 m before it, or of bare detections."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "station.yaml").write_text(yaml.safe_dump(STATION))
    save_camera(CAMERA, folder / "camera.yaml")
    scenario, station = load_scenario("approach", (*SETTINGS, *settings)), load_station(folder / "station.yaml")
    if bare:
        write_detections(scenario, station, CAMERA, 0, folder)
    else:
        write_rendered(scenario, station, CAMERA, 0, folder, workers=1)
    return folder


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    return simulate(tmp_path_factory.mktemp("rendered"))


@pytest.fixture
def sequence(rendered, tmp_path):
    """A copy of the rendered sequence that a test may spoil."""
    return shutil.copytree(rendered, tmp_path / "sequence")


def stamps(folder, change):
    """Rewrite timestamps.csv, its rows [frame, file, t_ns] changed by `change(rows)`."""
    lines = (folder / "timestamps.csv").read_text().splitlines()
    rows = [line.split(",") for line in lines[1:]]
    change(rows)
    (folder / "timestamps.csv").write_text("\n".join([lines[0], *map(",".join, rows)]) + "\n")


def run(source, out, *, cold=False, on_fix=lambda _item, _fix: None, calibration=None):
    """Run the paper's method over a source; returns the summary."""
    calibration = calibration or source
    station_file, camera_file = calibration / "station.yaml", calibration / "camera.yaml"
    station = load_station(station_file)
    localizer = PaperLocalizer(station, load_camera(camera_file), cold=cold)
    setup = Setup("paper", cold, Config(), station_file, camera_file)
    with RunFolder(out, station.ids) as folder:
        return run_source(open_source(source), localizer, folder, setup, on_fix=on_fix)


def fixes(out):
    with (out / "fixes.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def column(out, name):
    return [row[name] for row in fixes(out)]


def without_latency(out):
    """Content of all files of a run, latencies dropped."""
    contents = {path.name: path.read_bytes() for path in out.iterdir()}
    table, at = [line.split(b",") for line in contents["fixes.csv"].splitlines()], FIX_COLUMNS.index("latency_us")
    contents["fixes.csv"] = [row[:at] + row[at + 1 :] for row in table]
    description = json.loads(contents["run.json"])
    del description["counts"]["latency_us"]
    return contents | {"run.json": description}


def test_every_frame_gets_a_row_and_the_counts_fit(rendered, tmp_path):
    summary = run(rendered, tmp_path / "run")
    rows = fixes(tmp_path / "run")
    assert [row["frame"] for row in rows] == [f"{i:06d}" for i in range(7)]
    assert [int(row["t_ns"]) for row in rows] == [i * 250_000_000 for i in range(7)]
    assert all(int(row["latency_us"]) > 0 for row in rows)
    valid = [row for row in rows if row["valid"] == "1"]
    assert len(valid) >= 6
    assert all(2.0 < float(row["z_m"]) < 4.5 for row in valid)
    described = json.loads((tmp_path / "run" / "run.json").read_text())
    assert described["counts"] == summary.as_dict()
    assert (summary.frames, summary.usable, summary.valid, summary.finished) == (7, 7, len(valid), True)
    assert sum(summary.status.values()) == 7
    assert sum(summary.stage.values()) == len(valid)
    assert described["source"] == {"kind": "sequence", "name": rendered.name}
    assert described["inputs_sha256"] == {
        name: sha256(rendered / name) for name in ("timestamps.csv", "station.yaml", "camera.yaml")
    }
    assert Config(**described["config"]) == Config()


def test_the_same_input_gives_the_same_bytes(rendered, tmp_path):
    threads = cv2.getNumThreads()
    run(rendered, tmp_path / "one")
    cv2.setNumThreads(1)
    try:
        run(rendered, tmp_path / "two")
    finally:
        cv2.setNumThreads(threads)
    assert without_latency(tmp_path / "one") == without_latency(tmp_path / "two")


def test_frames_that_cannot_be_used_keep_their_rows(sequence, tmp_path):
    frames = sequence / "frames"
    content = (frames / "000001.jpg").read_bytes()
    (frames / "000001.jpg").write_bytes(content[: len(content) // 2])
    cv2.imwrite(str(frames / "000002.jpg"), np.zeros((255, 320), np.uint8))
    (frames / "000003.jpg").unlink()

    def spoil(rows):
        rows[4][2] = "1.5"
        rows[5][0] = "renamed"

    stamps(sequence, spoil)
    summary = run(sequence, tmp_path / "run")
    rows = fixes(tmp_path / "run")
    assert [row["frame"] for row in rows] == ["000000", "000001", "000002", "000003", "000004", "renamed", "000006"]
    assert [row["reason"] for row in rows][1:5] == ["bad_frame", "bad_frame", "bad_frame", "bad_stamp"]
    assert [row["t_ns"] for row in rows][1:6] == ["250000000", "500000000", "750000000", "", "1250000000"]
    assert [rows[i]["valid"] for i in (0, 5, 6)] == ["1"] * 3
    assert [row["latency_us"] == "" for row in rows] == [row["reason"] in LOST for row in rows]
    assert (summary.frames, summary.usable) == (7, 3)


@pytest.mark.parametrize(("cold", "stage"), [(False, "front"), (True, "search")])
def test_a_lost_frame_keeps_the_stage_unless_history_is_forgotten(sequence, tmp_path, cold, stage):
    (sequence / "frames" / "000003.jpg").write_bytes(b"")
    run(sequence, tmp_path / "run", cold=cold)
    assert column(tmp_path / "run", "stage")[2:4] == ["front", stage]
    assert column(tmp_path / "run", "reason")[3] == "bad_frame"


@pytest.mark.parametrize(
    ("changed", "reasons"),
    [
        ({3: "500000000"}, {3: "bad_stamp"}),
        ({3: "-1"}, {3: "bad_stamp"}),
        ({2: str(10**18)}, {3: "bad_stamp"}),
        ({2: str(2**63 - 1)}, {3: "bad_stamp"}),
        ({0: str(-(2**63) + 1)}, {}),
    ],
    ids=["repeated", "backward", "years ahead", "the largest", "the smallest"],
)
def test_a_wild_stamp_costs_one_frame(sequence, tmp_path, changed, reasons):
    def spoil(rows):
        for number, stamp in changed.items():
            rows[number][2] = stamp

    stamps(sequence, spoil)
    run(sequence, tmp_path / "run")
    rows = fixes(tmp_path / "run")
    assert {i: row["reason"] for i, row in enumerate(rows) if row["reason"] in LOST} == reasons
    assert [row["valid"] for row in rows][4:] == ["1"] * 3
    assert [row["t_ns"] for row in rows][2:4] == [changed.get(2, "500000000"), changed.get(3, "750000000")]


def test_gray_pictures_work(sequence, tmp_path):
    for file in (sequence / "frames").iterdir():
        cv2.imwrite(str(file.with_suffix(".png")), cv2.imread(str(file), cv2.IMREAD_GRAYSCALE))
        file.unlink()

    def rename(rows):
        for row in rows:
            row[1] = row[1].replace(".jpg", ".png")

    stamps(sequence, rename)
    assert run(sequence, tmp_path / "run").valid >= 6


@pytest.mark.parametrize("level", [0, 128, 255])
@pytest.mark.parametrize("shape", [(256, 320), (256, 320, 3)])
def test_a_plain_picture_has_no_lights(sequence, tmp_path, level, shape):
    cv2.imwrite(str(sequence / "frames" / "000003.jpg"), np.full(shape, level, np.uint8))
    run(sequence, tmp_path / "run")
    assert [column(tmp_path / "run", name)[3] for name in ("valid", "reason")] == ["0", "no_lights"]


def test_bare_detections_give_fixes(tmp_path):
    sequence = simulate(tmp_path / "bare", bare=True)
    rows = (sequence / "detections.csv").read_text().splitlines(keepends=True)
    spoilt = [row.replace(",1,", ",one,") if row.startswith("000003") else row for row in rows]
    (sequence / "detections.csv").write_text("".join(spoilt))
    summary = run(sequence, tmp_path / "run")
    assert (summary.frames, summary.usable) == (7, 6)
    assert summary.valid >= 5
    assert column(tmp_path / "run", "reason")[3] == "bad_frame"
    described = json.loads((tmp_path / "run" / "run.json").read_text())
    assert described["source"]["kind"] == "detections"
    assert described["inputs_sha256"]["detections.csv"] == sha256(sequence / "detections.csv")


def test_frames_with_a_guide_are_counted():
    guide, T = Guide(0.0, 0.0, 20.0, 0.01, 0.5), np.eye(4)
    summary = Summary()
    for reason, pose, found in [("protection", None, guide), ("", T, guide), ("", T, None), ("too_few", None, None)]:
        fix = Fix("a", 0, "tracking", "front", T_dock_cam=pose, reason=reason, guide=found)
        summary.count(fix, 1, "")
    counts = summary.as_dict()
    assert [counts[name] for name in ("frames", "valid", "guide", "guide_only")] == [4, 2, 2, 1]


@given(st.lists(st.integers(0, 2000), min_size=1))
def test_latencies_are_counted_and_their_percentiles_are_the_nearest_ranks(latencies):
    summary = Summary()
    for us in latencies:
        summary.count(Fix("a", 0, "none", "search", reason="too_few"), us, "")
    ranks = {"p50": 50, "p95": 95, "p99": 99, "max": 100}
    wanted = {name: int(np.percentile(latencies, q, method="inverted_cdf")) for name, q in ranks.items()}
    assert summary.as_dict()["latency_us"] == wanted


def test_a_method_is_told_the_attitude_and_the_run_remembers_its_file(tmp_path):
    sequence = simulate(tmp_path / "bare", bare=True)
    (sequence / "attitude.csv").write_text("t_ns,qx,qy,qz,qw,sigma_rad\n500000000,1,0,0,0,0.02\n")
    told = {}
    run(sequence, tmp_path / "run", on_fix=lambda item, _fix: told.update({item.frame: item.attitude}))
    assert [name for name, attitude in told.items() if attitude is not None] == ["000002"]
    assert_array_equal(told["000002"].R_dock_cam, np.diag([1, -1, -1]))
    described = json.loads((tmp_path / "run" / "run.json").read_text())
    assert described["inputs_sha256"]["attitude.csv"] == sha256(sequence / "attitude.csv")


def test_a_cold_run_knows_no_tracking(rendered, tmp_path):
    run(rendered, tmp_path / "run", cold=True)
    assert set(column(tmp_path / "run", "status")) <= {"none", "acquired"}
    run(rendered, tmp_path / "run")
    assert "tracking" in column(tmp_path / "run", "status")


@pytest.mark.parametrize(
    ("spoil", "text"),
    [
        (lambda folder: save_camera(Camera(640, 512, CAMERA.K), folder / "camera.yaml"), "frame 000000 is 320x256"),
        (lambda folder: shutil.rmtree(folder / "frames"), "000000.jpg: No such file"),
        (lambda folder: stamps(folder, lambda rows: [row.__setitem__(2, "nan") for row in rows]), "stamp 'nan'"),
    ],
    ids=["other camera", "no frames", "no stamps"],
)
def test_a_run_without_a_usable_row_says_why(sequence, tmp_path, spoil, text):
    spoil(sequence)
    with pytest.raises(InputError, match=text):
        run(sequence, tmp_path / "run")
    assert set(column(tmp_path / "run", "reason")) <= set(LOST)
    assert len(fixes(tmp_path / "run")) == 7
    assert json.loads((tmp_path / "run" / "run.json").read_text())["counts"]["usable"] == 0


def test_an_interrupted_run_is_described(rendered, tmp_path):
    seen = []

    def stop(_item, fix):
        seen.append(fix.frame)
        if len(seen) == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(rendered, tmp_path / "run", on_fix=stop)
    counts = json.loads((tmp_path / "run" / "run.json").read_text())["counts"]
    assert column(tmp_path / "run", "frame") == seen
    assert (counts["frames"], counts["finished"]) == (3, False)


def test_an_input_that_vanishes_does_not_spoil_the_run(sequence, tmp_path):
    run(sequence, tmp_path / "run", on_fix=lambda _item, _fix: (sequence / "camera.yaml").unlink(missing_ok=True))
    assert json.loads((tmp_path / "run" / "run.json").read_text())["counts"]["finished"]
