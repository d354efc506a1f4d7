"""Evaluation of one run and of a folder of runs: the same numbers as a table, JSON and Parquet."""

import json
import shutil

import pyarrow.parquet as pq
import pytest
from bench.shipped import CAMERA_FILE, STATION_FILE, shipped_camera, shipped_station

from lumidock.app.run import Setup, run
from lumidock.config import Config
from lumidock.errors import InputError
from lumidock.evaluation.metrics import evaluate
from lumidock.evaluation.run_description import read_description
from lumidock.evaluation.run_folders import evaluate_all, find_runs, flat, source_of, write_table
from lumidock.localizer import Localizer
from lumidock.sim.scenario import load_scenario
from lumidock.sim.sequence import write_detections
from lumidock.streams import run_folder
from lumidock.streams.run_folder import RunFolder
from lumidock.streams.sources import open_source

COARSE = ("path.start_z_m=12", "path.frame_interval_s=0.8")


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A folder with two runs beside their sequence, one of them deeper, and a folder that is none."""
    folder = tmp_path_factory.mktemp("runs")
    write_detections(load_scenario("approach", COARSE), shipped_station(), shipped_camera(), 5, folder / "sequence")
    for name, cold in (("warm", False), ("cold", True)):
        out = folder / name
        station, camera = shipped_station(), shipped_camera()
        with RunFolder(out, station.ids) as run_folder:
            (out / "station.yaml").write_bytes(STATION_FILE.read_bytes())
            (out / "camera.yaml").write_bytes(CAMERA_FILE.read_bytes())
            setup = Setup("lumidock", cold, Config(), STATION_FILE, CAMERA_FILE)
            run(open_source(folder / "sequence"), Localizer(station, camera, cold=cold), run_folder, setup)
    (folder / "other").mkdir()
    return folder


def test_runs_are_found_by_name_and_only_them(runs):
    assert [run.name for run in find_runs(runs)] == ["cold", "warm"]
    assert find_runs(runs / "warm") == [runs / "warm"]


def test_every_row_is_the_evaluation_of_its_run(runs):
    rows = {row["run"]: row for row in evaluate_all(runs)}
    for name in ("cold", "warm"):
        alone = evaluate(runs / name, runs / "sequence")
        assert {key: rows[name][key] for key in alone} == alone
    assert rows["cold"]["cold"] is True


def test_table_json_and_parquet_say_the_same(runs, tmp_path, lumidock):
    code, out, _ = lumidock("eval", runs, "--json", "--out", tmp_path / "all.parquet")
    assert code == 0
    rows = json.loads(out)
    table = pq.read_table(tmp_path / "all.parquet").to_pylist()
    assert [row["run"] for row in table] == [row["run"] for row in rows] == ["cold", "warm"]
    for row, content in zip(table, rows, strict=True):
        wanted = flat(content)
        assert {key: row[key] for key in wanted} == wanted
    code, out, _ = lumidock("eval", runs)
    assert code == 0
    assert [line.split()[0] for line in out.splitlines()] == ["run", "cold", "warm"]
    code, out, _ = lumidock("eval", runs, "--out", tmp_path / "all.json")
    assert json.loads((tmp_path / "all.json").read_text()) == rows


def test_columns_of_one_run_alone_are_nulls_of_the_others(tmp_path):
    write_table([{"run": "a", "x": {"y": 1}}, {"run": "b", "z": 0.5, "list": [1]}], tmp_path / "t.parquet")
    assert pq.read_table(tmp_path / "t.parquet").to_pylist() == [
        {"run": "a", "x.y": 1, "z": None},
        {"run": "b", "x.y": None, "z": 0.5},
    ]


def test_no_run_no_truth_and_other_endings_are_one_line(runs, tmp_path, lumidock):
    with pytest.raises(InputError, match="neither a run"):
        find_runs(runs / "other")
    lonely = tmp_path / "lonely"
    shutil.copytree(runs / "warm", lonely)
    for words in (("eval", lonely), ("eval", tmp_path / "absent"), ("eval", runs, "--out", tmp_path / "t.xlsx")):
        code, _, error = lumidock(*words)
        assert (code, len(error.strip().splitlines())) == (2, 1)


def test_a_source_too_large_to_hash_is_known_by_its_samples(runs, tmp_path, monkeypatch):
    monkeypatch.setattr(run_folder, "_MOST_HASHED", 300)
    monkeypatch.setattr(run_folder, "_SAMPLE", 200)
    out, stamps = tmp_path / "run", runs / "sequence" / "timestamps.csv"
    station, source = shipped_station(), open_source(runs / "sequence")
    with RunFolder(out, station.ids) as folder:
        run(source, Localizer(station, shipped_camera()), folder, Setup("lumidock", False, Config(), stamps, stamps))
    assert "timestamps.csv" in read_description(out)["inputs_sampled"]
    assert source_of(out, read_description(out), runs / "sequence").path == runs / "sequence"
    other = shutil.copytree(runs / "sequence", tmp_path / "other")
    (other / "timestamps.csv").write_text(stamps.read_text() + "\n")
    with pytest.raises(InputError, match="not what"):
        source_of(out, read_description(out), other)
