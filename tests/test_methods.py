"""Methods by their names, and a method of one's own that is installed as a package."""

import csv
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from bench.shipped import CAMERA_FILE, STATION_FILE, shipped_camera, shipped_station

from lumidock.config import Config
from lumidock.errors import InputError
from lumidock.methods import BASELINES, METHODS, implementation, localizer_of, method_names, require_method

ROOT = Path(__file__).parents[1]
DOCK = ["--station", str(STATION_FILE), "--camera", str(CAMERA_FILE)]


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """The environment of a process that has the example package installed."""
    target = tmp_path_factory.mktemp("site")
    options = ["--no-deps", "--no-build-isolation", "--no-index", "--quiet", "--target", target]
    pip = [sys.executable, "-m", "pip", "install", *options, ROOT / "examples" / "own_method"]
    done = subprocess.run([*map(str, pip)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    paths = [str(target), str(ROOT / "src"), str(ROOT), os.environ.get("PYTHONPATH", "")]
    return os.environ | {"PYTHONPATH": os.pathsep.join(paths)}


def lumidock(installed, *words):
    command = [sys.executable, "-m", "lumidock", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, env=installed, check=False)


@pytest.mark.parametrize("name", [*METHODS, *BASELINES])
def test_every_method_of_the_package_is_made_by_its_name(name):
    require_method(name)
    localizer = localizer_of(name, shipped_station(), shipped_camera(), Config())
    assert callable(localizer.process_detections)
    assert implementation(name) == ""
    assert name in method_names()


def test_a_method_that_there_is_not_is_refused_with_those_that_there_are():
    with pytest.raises(InputError, match="no such method; there are lumidock, paper, hungarian"):
        require_method("telepathy")


def test_run_and_eval_take_a_method_of_an_installed_package(installed, tmp_path):
    sequence, run = tmp_path / "sequence", tmp_path / "run"
    settings = ("path.start_z_m=9.5", "path.end_z_m=8.3", "path.frame_interval_s=0.3", "lamps.layers=front")
    words = ["sim", "approach", "--seed", 3, "--out", sequence, *DOCK]
    done = lumidock(installed, *words, *(word for one in settings for word in ("--set", one)))
    assert done.returncode == 0, done.stderr
    done = lumidock(installed, "run", sequence, "--method", "polar-order", "--out", run)
    assert done.returncode == 0, done.stderr
    assert json.loads((run / "run.json").read_text())["method"] == "polar-order"
    with (run / "fixes.csv").open(newline="") as file:
        assert sum(row["valid"] == "1" for row in csv.DictReader(file)) >= 3
    rows = json.loads(lumidock(installed, "eval", tmp_path, "--json").stdout)
    assert [row["method"] for row in rows] == ["polar-order"]
    assert rows[0]["error"]["lateral_m"]["median"] < 0.3


def test_campaign_takes_it_and_counts_anew_when_its_code_changes(installed, tmp_path):
    words = ["campaign", "missing-1", "--method", "polar-order", "--method", "hungarian", "--seeds", "0:1"]
    words += ["--set", "path.count=20", "--set", "faults.missing=0", "--set", "detections.rear_range_m=0.01"]
    done = lumidock(installed, *words, "--workers", 1, "--out", tmp_path / "campaign", *DOCK)
    assert done.returncode == 0, done.stderr
    table = json.loads((tmp_path / "campaign" / "table.json").read_text())
    valid = {row["method"]: row["counts"]["valid"] for row in table["rows"]}
    assert valid["polar-order"] >= 18
    assert set(valid) == {"polar-order", "hungarian"}
    source = Path(installed["PYTHONPATH"].split(os.pathsep)[0]) / "own_method.py"
    code = "from lumidock.methods import implementation; print(implementation('polar-order'))"
    before, after = (_after_edit(installed, source, code, text) for text in ("", "\n# another version\n"))
    assert before.split()[:2] == after.split()[:2] == ["own-method", "0.1.0"]
    assert before != after


def _after_edit(installed, source, code, text):
    source.write_text(source.read_text() + text)
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=installed, check=True
    ).stdout


def test_a_package_that_does_not_load_gives_one_line(installed, tmp_path):
    folder = tmp_path / "broken-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text("[lumidock.methods]\nbroken = nowhere:Nothing\n")
    env = installed | {"PYTHONPATH": f"{tmp_path}{os.pathsep}{installed['PYTHONPATH']}"}
    done = lumidock(env, "campaign", "missing-1", "--method", "broken", "--out", tmp_path / "out", "--workers", 1)
    assert done.returncode == 2
    assert "nowhere" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--only", "table-2"], "--only table-2: no such section; there are table-1, "),
        (["--method", "telepathy"], "--method telepathy: no such method; there are lumidock, paper, "),
        (["--config", "preset.yaml"], "paper.preset: "),
    ],
)
def test_reproduce_refuses_what_there_is_not_in_one_line(installed, tmp_path, words, line):
    (tmp_path / "preset.yaml").write_text("paper: {preset: as_remembered}\n")
    words = [str(tmp_path / word) if word.endswith(".yaml") else word for word in words]
    done = lumidock(installed, "reproduce", *words, "--out", tmp_path / "out")
    assert done.returncode == 2
    assert line in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "out").exists()


def test_reproduce_puts_an_installed_method_into_its_tables(installed, tmp_path):
    out = tmp_path / "out"
    (tmp_path / "few.yaml").write_text("paper: {preset: as_printed}\n")
    words = ["--only", "figure-7-11", "--method", "polar-order", "--config", tmp_path / "few.yaml", "--workers", 1]
    done = lumidock(installed, "reproduce", *words, "--out", out, *DOCK)
    assert done.returncode == 0, done.stderr
    rows = list(csv.reader((out / "tables" / "figure-7-11-1.csv").open(newline="")))
    assert rows[0][-1] == "polar-order"
    assert [row[-1] for row in rows[1:3]] == ["right", "right"]
    assert rows[5][-1] != "right"  # it knows no missing light
