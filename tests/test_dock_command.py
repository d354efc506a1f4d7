"""`lumidock dock` as a process, and the example ROV."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from bench.shipped import STATION_FILE, shipped_camera
from commandline import LUMIDOCK

from lumidock.camera import save_camera
from lumidock.sim.rendered_camera import scaled

ROV = Path(__file__).parents[1] / "examples" / "rov" / "rov.py"
NOSE = "schema: 1\nT_body_cam: {translation: [0.23, 0, 0], quat_xyzw: [-0.5, 0.5, -0.5, 0.5]}\n"


def dock(*words):
    command = [LUMIDOCK, "dock", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


def test_two_methods_are_counted_and_shown(tmp_path):
    done = dock(
        "docking", "--set", "docking.time_limit_s=10", "--method", "lumidock", "--method", "raw", "--seeds", "3:5",
        "--json", "--out", tmp_path / "out",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert set(told["methods"]) == {"lumidock", "raw"}
    for counts in told["methods"].values():
        assert (counts["runs"], counts["out_of_time"], counts["contacts"]) == (2, 2, 0)
    written = json.loads((tmp_path / "out" / "docking.json").read_text())
    assert [one["seed"] for one in written["dockings"]["raw"]] == [3, 4]
    page = (tmp_path / "out" / "docking.html").read_text()
    assert "Dockings by method" in page
    assert "raw, seed 3" in page


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (("docking", "--vehicle", "boat"), "--vehicle boat: there are auv, rov"),
        (("docking", "--method", "nothing"), "nothing"),
        (("docking", "--seeds", "5:5"), "--seeds 5:5"),
        (("clutter",), "clutter: a closed loop takes no"),
        (("funnel",), "cage only"),
    ],
)
def test_what_cannot_be_docked_is_refused_in_one_line(tmp_path, words, match):
    done = dock(*words, "--out", tmp_path / "out")
    assert (done.returncode, len(done.stderr.strip().splitlines())) == (2, 1), done.stderr
    assert match in done.stderr


@pytest.mark.slow  # in real time
def test_the_example_rov_docks_by_mavlink_alone(tmp_path):
    (tmp_path / "vehicle.yaml").write_text(NOSE)
    save_camera(scaled(shipped_camera(), 0.25), tmp_path / "camera.yaml")
    command = [sys.executable, ROV, STATION_FILE, tmp_path / "camera.yaml", tmp_path / "vehicle.yaml"]
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "dock: go (clear)" in done.stdout
