"""Reproduction: the same numbers for the same seeds, nothing done twice, and a page that is whole."""

import csv
import filecmp
import json
from dataclasses import replace

import numpy as np
import pytest
from bench.shipped import CAMERA_FILE, STATION_FILE, shipped_camera, shipped_station
from test_report import CHROMIUM, Reader, probe

from lumidock.app.run import Setup, run
from lumidock.camera import load_camera
from lumidock.config import Config
from lumidock.datatypes import Detections, Fix, Match
from lumidock.errors import InputError
from lumidock.localizer import Localizer
from lumidock.reproduce import FULL, QUICK, reproduce, work
from lumidock.reproduce.experiments import jobs_of
from lumidock.reproduce.jobs import Job, run_jobs
from lumidock.reproduce.trials import Counts, trial, verdict
from lumidock.sim.detections import SimulatedFrame
from lumidock.sim.measured import measured_like
from lumidock.sim.scenario import load_scenario, shipped_scenarios
from lumidock.sim.sequence import write_rendered
from lumidock.streams.run_folder import RunFolder
from lumidock.streams.sources import open_source

DOCK = (str(STATION_FILE), str(CAMERA_FILE))
TINY = replace(
    QUICK,
    name="tiny",
    trials=1,
    trials_a_job=1,
    draws=5,
    docking_interval_s=1.0,
    search_interval_s=6.0,
    waters=("III",),
    exposures_ms=(2.0,),
    envelope_interval_s=6.0,
    daylight_w_m2=(600.0,),
    shipped=(),
    point_seeds=1,
)


def spot_frame(light):
    n = len(light)
    detections = Detections.from_uv("0", 0, np.arange(2.0 * n).reshape(n, 2))
    return SimulatedFrame(detections, np.eye(4), np.array(light), np.zeros((13, 2)), np.ones(13, bool))


def answer(frame, light, status="acquired"):
    return Fix("0", 0, status, "front", reason="protection", match=Match(frame.detections, np.array(light)))


@pytest.mark.parametrize(
    ("named", "status", "wanted"),
    [
        ([0, 1, 2, -1], "acquired", (True, False)),
        ([0, 1, -1, -1], "acquired", (False, False)),
        ([0, 2, 1, -1], "acquired", (False, True)),
        ([0, 1, 2, 3], "tracking", (False, True)),
        ([0, 1, 2, -1], "none", (False, False)),
    ],
)
def test_verdict_tells_right_incomplete_and_wrong_names(named, status, wanted):
    frame = spot_frame([0, 1, 2, -1])
    assert verdict(answer(frame, named, status), frame) == wanted


def test_trial_is_the_same_every_time_and_counts_no_frame_twice():
    first, second = (trial(shipped_station(), shipped_camera(), 2, 0, 77) for _ in range(2))
    assert first == second
    assert first.frames > 50
    assert max(first.right + first.wrong, first.ours_right + first.ours_wrong) <= first.frames
    assert first.ours_cold_wrong == first.ours_wrong == 0
    assert first + Counts() == first


def test_what_is_done_is_not_done_again_and_what_changed_is(tmp_path):
    settings = ["path.count=3"]
    job = Job("cold", 1.0, work.acquisition_trial, (DOCK, "missing-1", settings, 3))
    seen = []
    first = run_jobs([job], tmp_path, "dock", workers=0)
    file = tmp_path / "cold.json"
    content = json.loads(file.read_text())
    content["result"]["frames"] = 99
    file.write_text(json.dumps(content))
    again = run_jobs([job], tmp_path, "dock", workers=0, progress=lambda done, total: seen.append((done, total)))
    assert again["cold"]["frames"] == 99
    assert seen == [(1, 1)]
    assert run_jobs([job], tmp_path, "another dock", workers=0) == first
    file.write_text("{ cut off")
    assert run_jobs([job], tmp_path, "dock", workers=0) == first
    other = replace(job, arguments=(DOCK, "missing-1", settings, 4))
    assert json.loads(file.read_text())["key"] != other.key("dock")


def fixes_of(folder):
    """Rows of a run without their times."""
    with (folder / "fixes.csv").open(newline="") as file:
        return [{k: v for k, v in row.items() if k != "latency_us"} for row in csv.DictReader(file)]


def test_frames_in_memory_give_the_fixes_of_frames_on_disk(tmp_path):
    settings = ["path.frame_interval_s=2.5", "stream.half_written=0.2", "stream.duplicated=0.3"]
    kept = work.docking(DOCK, "stream-faults", settings, 5, str(tmp_path / "kept"), True)
    work.docking(DOCK, "stream-faults", settings, 5, str(tmp_path / "memory"), False)
    disk, sequence = tmp_path / "disk", tmp_path / "memory" / "sequence"
    station, camera = shipped_station(), shipped_camera()
    write_rendered(load_scenario("stream-faults", tuple(settings)), station, camera, 5, disk, workers=1)
    pictures = sorted(file.name for file in (disk / "frames").iterdir())
    assert filecmp.cmpfiles(disk / "frames", tmp_path / "kept" / "sequence" / "frames", pictures, False)[0] == pictures
    assert not (sequence / "frames").exists()
    truth = sorted(file.name for file in disk.iterdir() if file.is_file())
    assert "stream_truth.csv" in truth
    assert filecmp.cmpfiles(disk, sequence, truth, False)[0] == truth
    with RunFolder(tmp_path / "run", station.ids) as folder:
        localizer = Localizer(station, load_camera(disk / "camera.yaml"))
        run(
            open_source(disk), localizer, folder, Setup("lumidock", False, Config(), STATION_FILE, disk / "camera.yaml")
        )
    rows = fixes_of(tmp_path / "run")
    assert rows == fixes_of(tmp_path / "memory" / "lumidock") == fixes_of(tmp_path / "kept" / "lumidock")
    assert {"bad_frame", "bad_stamp"} <= {row["reason"] for row in rows}
    assert sum(row["valid"] == "1" for row in rows) == kept["lumidock"]["valid"] > 0


def test_every_shipped_docking_is_run_at_point_level_with_the_detectors_errors(tmp_path):
    jobs = {job.name: job for job in jobs_of(FULL, DOCK, tmp_path) if job.name.startswith("point-")}
    paths = [name for name in shipped_scenarios() if load_scenario(name).path.kind != "draws"]
    for name in paths:
        for seed in range(20):
            _, scenario, (setting,), first, stop = jobs[f"point-{name}-{FULL.first_seed + seed}"].arguments
            assert (scenario, first, stop) == (name, FULL.first_seed + seed, FULL.first_seed + seed + 1)
            assert setting == f"detections.detector={measured_like(load_scenario(name))}"
    assert len(jobs) == 20 * len(paths)
    counts = jobs[f"point-rectangle-{FULL.first_seed}"].call(*jobs[f"point-rectangle-{FULL.first_seed}"].arguments)
    assert counts["counts"]["frames"] == 127


@pytest.mark.parametrize("grid", [TINY, QUICK, FULL])
def test_jobs_have_names_of_their_own_and_cover_every_water(grid, tmp_path):
    names = [job.name for job in jobs_of(grid, DOCK, tmp_path)]
    assert len(names) == len(set(names))
    assert not [name for name in names if set(name) & set('/\\:*?"<>| ')]
    for water in grid.waters:
        for exposure in grid.exposures_ms:
            assert any(n.startswith(f"envelope-water-{water}-{exposure:g}-") for n in names)


def test_folder_of_something_else_is_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(InputError, match="no reproduction"):
        reproduce(TINY, STATION_FILE, CAMERA_FILE, tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.mark.slow
def test_reproduction_goes_on_where_it_was_and_its_page_is_whole(tmp_path):
    out, done = tmp_path / "out", []

    class EnoughError(Exception):
        pass

    def stop(now, _total):
        if now > 5:
            raise EnoughError

    with pytest.raises(EnoughError):
        reproduce(TINY, STATION_FILE, CAMERA_FILE, out, workers=0, progress=stop)
    kept = {file.name: file.stat().st_mtime_ns for file in (out / "results").iterdir()}
    assert kept
    results = reproduce(TINY, STATION_FILE, CAMERA_FILE, out, workers=2, progress=lambda now, _: done.append(now))
    assert done[0] > 0
    assert all((out / "results" / name).stat().st_mtime_ns == at for name, at in kept.items())
    text = (out / "report.html").read_text()
    page = Reader(text)
    figures = [attrs["id"] for tag, attrs in page.found if tag == "figure" and "plot" in attrs.get("class", "")]
    for name in ("swarm", "backtracking", "search", "envelope", "docking-errors", "docking-lumidock-trajectory"):
        assert name in figures
    assert len(text.encode()) < 5e6
    tables = (out / "tables.md").read_text()
    for title in ("Table 1", "Figures 9 and 10", "Figures 12 and 13", "Figures 15 and 16", "Turbidity"):
        assert f"## {title}" in tables
    assert results["docking-0"]["lumidock"]["hazardous"]["valid"]["any"] == 0
    assert results["docking-0"]["lumidock"]["hazardous"]["guide"]["any"] == 0
    if CHROMIUM:
        for width in (1200, 360):
            assert probe(tmp_path / "page.html", text, width, False) == "PROBED rgb(255, 255, 255) "
