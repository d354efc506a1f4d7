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
from lumidock.report.page import Table
from lumidock.reproduce import EXPERIMENTS, FULL, QUICK, Dock, Plan, layer_rules, reproduce, work
from lumidock.reproduce.experiments import chosen, jobs_of
from lumidock.reproduce.intervals import BETTER, LIKE, WORSE, mark, wilson
from lumidock.reproduce.jobs import Job, run_jobs
from lumidock.reproduce.layouts import LAYOUTS, with_layout
from lumidock.reproduce.table1 import LARGE
from lumidock.reproduce.tables import as_csv, latex
from lumidock.reproduce.trials import HISTORY, Condition, Count, Participants, merged, trial, verdict
from lumidock.reproduce.work import Simulation
from lumidock.sim.detections import SimulatedFrame
from lumidock.sim.measured import is_measured, measured_like
from lumidock.sim.scenario import load_scenario, shipped_scenarios
from lumidock.sim.sequence import write_rendered
from lumidock.streams.run_folder import RunFolder
from lumidock.streams.sources import open_source

DOCK = Dock(str(STATION_FILE), str(CAMERA_FILE))
TINY = replace(
    QUICK,
    name="tiny",
    trials=1,
    layout_trials=1,
    trials_a_job=1,
    table_interval_s=4.0,
    ablation_trials=1,
    compared=6,
    tuned=4,
    extraction_frames=1,
    draws=5,
    docking_interval_s=1.0,
    search_interval_s=4.0,
    waters=("III",),
    exposures_ms=(2.0,),
    envelope_interval_s=6.0,
    daylight_w_m2=(600.0,),
    shipped=(),
    point_seeds=1,
)


def detected_frame(light):
    n = len(light)
    detections = Detections.from_uv("0", 0, np.arange(2.0 * n).reshape(n, 2))
    return SimulatedFrame(detections, np.eye(4), np.array(light), np.zeros((13, 2)), np.ones(13, bool))


def answer(frame, light, status="acquired"):
    return Fix("0", 0, status, "front", reason="protection", match=Match(frame.detections, np.array(light)))


@pytest.mark.parametrize(
    ("identified", "status", "wanted"),
    [
        ([0, 1, 2, -1], "acquired", (True, False)),
        ([0, 1, -1, -1], "acquired", (False, False)),
        ([0, 2, 1, -1], "acquired", (False, True)),
        ([0, 1, 2, 3], "tracking", (False, True)),
        ([0, 1, 2, -1], "none", (False, False)),
    ],
)
def test_verdict_tells_right_incomplete_and_wrong_identities(identified, status, wanted):
    frame = detected_frame([0, 1, 2, -1])
    assert verdict(answer(frame, identified, status), frame) == wanted


def test_trial_is_the_same_every_time_and_counts_no_frame_twice():
    station, camera = shipped_station(), shipped_camera()
    names = (LARGE, LARGE + HISTORY, "paper-as-printed", "lumidock without history", "lumidock")
    first, second = (
        trial(station, camera, Condition(2, 0), 77, Participants(names, station, camera, Config())) for _ in range(2)
    )
    assert first == second
    far, near = first["30 m"], first["18.6 m"]
    assert 0 < near["lumidock"].frames < far["lumidock"].frames
    for by_name in first.values():
        for count in by_name.values():
            assert count.right + count.wrong <= count.frames == by_name["lumidock"].frames
        assert by_name["lumidock"].wrong == by_name["lumidock without history"].wrong == 0
        assert by_name[LARGE].wrong == by_name[LARGE].frames - by_name[LARGE].right
    doubled = merged([first, second])["30 m"][LARGE]
    assert doubled == Count(
        *(2 * n for n in (far[LARGE].frames, far[LARGE].right, far[LARGE].wrong, far[LARGE].passed_wrong))
    )


def test_interval_holds_the_share_as_often_as_it_says(rng):
    """Wilson's interval is that of the score test: its ends are where the test just rejects."""
    for part, whole in ((0, 30), (3, 30), (30, 30), (289, 320)):
        low, high = wilson(part, whole)
        assert 0.0 <= low <= part / whole <= high <= 1.0
        for end in (low, high):
            if 0.0 < end < 1.0:
                score = abs(part / whole - end) / np.sqrt(end * (1.0 - end) / whole)
                assert score == pytest.approx(1.959964, rel=1e-6)
    inside = [wilson(k, 200) for k in rng.binomial(200, 0.9, 4000)]
    assert np.mean([low <= 0.9 <= high for low, high in inside]) == pytest.approx(0.95, abs=0.02)


def test_mark_compares_intervals_and_not_points():
    assert mark(300, 300, 100.0, 2108) == LIKE
    assert mark(299, 300, 100.0, 2108) == LIKE
    assert mark(285, 300, 100.0, 2108) == WORSE
    assert mark(300, 300, 90.3, 2108) == BETTER


def test_layouts_are_what_their_names_say():
    station = shipped_station()
    front = station.lights_of("front")
    for layout in LAYOUTS[1:]:
        xy = with_layout(station, layout).p_dock[front, :2]
        sides = [int(word) for word in layout.rpartition(" ")[2].split("-")]
        left, right = (xy[:, 0] == x for x in (xy[:, 0].min(), xy[:, 0].max()))
        assert [left.sum(), (~left & ~right).sum(), right.sum()] == sides
        assert {(-x, y) for x, y in xy.round(6).tolist()} == {(x, y) for x, y in xy.round(6).tolist()}
    assert with_layout(station, LAYOUTS[0]) is station
    with pytest.raises(InputError, match="6 front lights"):
        with_layout(
            replace(station, layer=1 - station.layer, layers=("rear", "front"), p_dock=-station.p_dock), LAYOUTS[1]
        )


def test_what_is_done_is_not_done_again_and_what_changed_or_is_gone_is(tmp_path):
    simulation = Simulation(DOCK, "missing-1", ("path.count=3",), 3)
    left = tmp_path / "left"
    left.touch()
    job = Job("cold", 1.0, work.acquisition_trial, (simulation, ("paper", "lumidock"), Config()), (left,))
    seen = []
    first = run_jobs([job], tmp_path, "dock", workers=0)
    file = tmp_path / "cold.json"
    content = json.loads(file.read_text())
    content["result"]["frames"] = 99
    file.write_text(json.dumps(content))
    again = run_jobs([job], tmp_path, "dock", workers=0, progress=lambda done, total: seen.append((done, total)))
    assert again["cold"]["frames"] == 99
    assert seen == [(1, 1)]
    assert run_jobs([replace(job, code="another method")], tmp_path, "dock", workers=0) == first
    file.write_text(json.dumps(content))
    assert run_jobs([job], tmp_path, "another dock", workers=0) == first
    file.write_text("{ cut off")
    assert run_jobs([job], tmp_path, "dock", workers=0) == first
    file.write_text(json.dumps(content))
    left.unlink()
    assert run_jobs([job], tmp_path, "dock", workers=0) == first
    other = replace(job, arguments=(replace(simulation, seed=4), ("paper", "lumidock"), Config()))
    assert json.loads(file.read_text())["key"] != other.key("dock")


def test_rules_for_the_layers_differ_only_where_their_input_does():
    """Without colour every rule but colour alone is the rule by radius; by colour no gray detection is a rear one."""
    settings = ("path.start_z_m=9", "path.end_z_m=4", "path.frame_interval_s=1.6")
    result = layer_rules.measure(Simulation(DOCK, "approach", settings, 3), Config())
    gray, color = result["gray"], result["colour"]
    assert gray["auto"] == gray["color_or_radius"] == gray["radius"] != gray["color"]
    assert gray["color"]["detections"] == gray["radius"]["detections"] > 30
    front = gray["color"]["right_layer"]
    assert 0 < front <= 7 * gray["color"]["frames"]
    assert color["color"] == color["auto"]
    assert color["color"]["right_layer"] >= 0.95 * color["color"]["detections"] > front
    assert color["color"]["wrong"] == 0
    rows = layer_rules.table({"layer-rules": result}).rows
    assert len(rows) == 2 * len(layer_rules.RULES)


def test_tables_are_whole_as_csv_and_latex():
    table = Table("50 % & more", ["a_b", "c"], [["x, y", "✓ 3 %"], ["{1}", "-"]])
    assert list(csv.reader(as_csv(table).splitlines())) == [table.head, *table.rows]
    text = latex(table)
    assert r"50 \% \& more" in text
    assert r"x, y & \checkmark{} 3 \% \\" in text
    assert r"\{1\} & - \\" in text
    assert text.count("&") == 4


def test_a_section_there_is_not_is_refused_and_one_alone_has_only_its_jobs(tmp_path):
    with pytest.raises(InputError, match="no such section; there are table-1"):
        chosen(["table-2"])
    plan = Plan(TINY, DOCK, tmp_path)
    apart = [job.name for experiment in EXPERIMENTS for job in jobs_of(plan, [experiment.name])]
    assert apart == [job.name for job in jobs_of(plan)]


def test_one_section_alone_makes_a_page_and_its_tables(tmp_path):
    out = tmp_path / "out"
    plan = Plan(TINY, DOCK, out, extra=("hungarian",))
    results = reproduce(plan, only=["acquisition", "figure-6"], workers=0)
    assert {name.partition("-")[0] for name in results} == {"acquisition", "figure"}
    assert set(results["acquisition-missing-spurious"]) == {
        "frames",
        "paper-as-printed",
        "paper",
        "lumidock",
        "hungarian",
    }
    page = Reader((out / "report.html").read_text())
    figures = [attrs["id"] for tag, attrs in page.found if tag == "figure" and "plot" in attrs.get("class", "")]
    assert figures == ["swarm-as-printed", "swarm-recommended", "swarm-fitness"]
    rows = list(csv.reader((out / "tables" / "acquisition-1.csv").open(newline="")))
    assert len(rows) == 7
    assert len(rows[0]) == 2 + 3 * 4
    assert (out / "tables" / "acquisition-1.tex").read_text().count(r"\\") == 7
    assert "## Acquisition" in (out / "tables.md").read_text()


def fixes_of(folder):
    """Rows of a run without their times."""
    with (folder / "fixes.csv").open(newline="") as file:
        return [{k: v for k, v in row.items() if k != "latency_us"} for row in csv.DictReader(file)]


@pytest.mark.slow
def test_frames_in_memory_give_the_fixes_of_frames_on_disk(tmp_path):
    settings = ("path.frame_interval_s=2.5", "stream.half_written=0.2", "stream.duplicated=0.3")
    simulation = Simulation(DOCK, "stream-faults", settings, 5)
    kept = work.docking(simulation, str(tmp_path / "kept"), True, ("paper", "lumidock"), Config())
    work.docking(simulation, str(tmp_path / "memory"), False, ("lumidock",), Config())
    disk, sequence = tmp_path / "disk", tmp_path / "memory" / "sequence"
    station, camera = shipped_station(), shipped_camera()
    write_rendered(load_scenario("stream-faults", settings), station, camera, 5, disk, workers=1)
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
    for folder, keep, methods in (("kept", True, ("paper", "lumidock")), ("memory", False, ("lumidock",))):
        assert all(path.exists() for path in work.docking_leaves(tmp_path / folder, keep, methods))
    rows = fixes_of(tmp_path / "run")
    assert rows == fixes_of(tmp_path / "memory" / "lumidock") == fixes_of(tmp_path / "kept" / "lumidock")
    assert {"bad_frame", "bad_stamp"} <= {row["reason"] for row in rows}
    assert sum(row["valid"] == "1" for row in rows) == kept["lumidock"]["valid"] > 0


def test_every_shipped_docking_is_run_at_point_level_with_the_detectors_errors(tmp_path):
    jobs = {job.name: job for job in jobs_of(Plan(FULL, DOCK, tmp_path), ["hazards"]) if job.name.startswith("point-")}
    paths = [
        name
        for name in shipped_scenarios()
        if load_scenario(name).path.kind != "draws" and is_measured(load_scenario(name))
    ]
    for name in paths:
        for seed in range(20):
            (simulation,) = jobs[f"point-{name}-{FULL.first_seed + seed}"].arguments
            assert (simulation.scenario, simulation.seed) == (name, FULL.first_seed + seed)
            assert simulation.settings[0] == f"detections.detector={measured_like(load_scenario(name))}"
    assert len(jobs) == 20 * len(paths)
    counts = jobs[f"point-rectangle-{FULL.first_seed}"].call(*jobs[f"point-rectangle-{FULL.first_seed}"].arguments)
    assert counts["counts"]["frames"] == 111  # once round 15.2 x 12.4 m, a frame every 0.5 m


@pytest.mark.parametrize("grid", [TINY, QUICK, FULL])
def test_jobs_have_names_of_their_own_and_cover_every_water(grid, tmp_path):
    names = [job.name for job in jobs_of(Plan(grid, DOCK, tmp_path))]
    assert len(names) == len(set(names))
    assert not [name for name in names if set(name) & set('/\\:*?"<>| ')]
    for water in grid.waters:
        for exposure in grid.exposures_ms:
            assert any(n.startswith(f"envelope-water-{water}-{exposure:g}-") for n in names)


def test_folder_of_something_else_is_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(InputError, match="no reproduction"):
        reproduce(Plan(TINY, DOCK, tmp_path))
    assert [file.name for file in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.mark.slow
def test_reproduction_goes_on_where_it_was_and_its_page_is_whole(tmp_path):
    out, done = tmp_path / "out", []
    plan = Plan(TINY, DOCK, out)

    class EnoughError(Exception):
        pass

    def stop(now, _total):
        if now > 5:
            raise EnoughError

    with pytest.raises(EnoughError):
        reproduce(plan, workers=0, progress=stop)
    kept = {file.name: file.stat().st_mtime_ns for file in (out / "results").iterdir()}
    assert kept
    results = reproduce(plan, workers=2, progress=lambda now, _: done.append(now))
    assert done[0] > 0
    assert all((out / "results" / name).stat().st_mtime_ns == at for name, at in kept.items())
    text = (out / "report.html").read_text()
    page = Reader(text)
    figures = [attrs["id"] for tag, attrs in page.found if tag == "figure" and "plot" in attrs.get("class", "")]
    wanted = ("swarm-fitness", "backtracking", "figure-11", "search", "envelope", "docking-errors", "figure-16-paper")
    for name in (*wanted, "comparison", "swarm-sizes", "detection-0", "docking-lumidock-trajectory"):
        assert name in figures
    assert len(text.encode()) < 8e6
    tables = (out / "tables.md").read_text()
    for title in ("The paper's figures", "Table 1", "Figures 9 and 10", "Figures 12 and 13", "Figures 15 and 16"):
        assert f"## {title}" in tables
    for title in ("Other people's methods", "Ablations", "Extraction", "Turbidity", "Hazardously"):
        assert f"## {title}" in tables
    assert results["docking-0"]["lumidock"]["hazardous"]["valid"]["any"] == 0
    assert results["docking-0"]["lumidock"]["hazardous"]["guide"]["any"] == 0
    for side in ("below", "left", "above", "right"):
        rows = [row for row in csv.reader((out / "tables" / "search-1.csv").open()) if row[0].startswith(side)]
        assert all(int(row[2]) >= 0.9 * int(row[1]) for row in rows)
    if CHROMIUM:
        for width in (1200, 360):
            assert probe(tmp_path / "page.html", text, width, False) == "PROBED rgb(255, 255, 255) "
            assert probe(tmp_path / "page.html", text, width, True) == "PROBED rgb(17, 23, 29) "
