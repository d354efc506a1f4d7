"""A station file that is wrong: `run`, run.json, the report and the health of a server say so in one sentence."""

import json
import re
import subprocess
import threading
from pathlib import Path

import pytest
from commandline import LUMIDOCK

from lumidock.app.run import contradictions_in_words
from lumidock.app.serve import Newest, Server, SourceReader
from lumidock.camera import load_camera
from lumidock.evaluation.run_description import contradictions
from lumidock.localizer import Localizer
from lumidock.report import report
from lumidock.sim.detections import simulated_frames
from lumidock.sim.scenario import load_scenario
from lumidock.station import load_station

ROOT = Path(__file__).parents[1] / "src" / "lumidock"
STATION = load_station(ROOT / "stations" / "cage-2x2x5.yaml")
CAMERA = load_camera(ROOT / "cameras" / "imx264-60deg.yaml")
SHORT = (
    "path.start_z_m=14",
    "path.end_z_m=6",
    "path.frame_interval_s=0.1",
    "detections.dead=0",
    "detections.bent_m=0.06",
)
SENTENCE = re.compile(r"light [FR]\d appears \d+ cm from its surveyed position")


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A simulated docking with one light 6 cm from its surveyed position, as detections."""
    folder = tmp_path_factory.mktemp("bent")
    settings = [word for one in SHORT for word in ("--set", one)]
    for words in (
        ("sim", "faults/bent-light", "--detections", "--seed", "3", *settings, "--out", folder / "seq"),
        ("run", folder / "seq", "--out", folder / "run"),
    ):
        done = subprocess.run([LUMIDOCK, *map(str, words)], capture_output=True, text=True, check=True)
    return folder, done.stderr


def test_run_says_it_and_run_json_keeps_it(recording):
    folder, err = recording
    said = [line for line in err.splitlines() if SENTENCE.search(line)]
    assert said
    assert all(line.startswith("lumidock: warning: light ") for line in said)
    counts = json.loads((folder / "run" / "run.json").read_text())["counts"]
    first = counts["contradictions"][0]
    assert first["file"] == "survey"
    assert first["subject"] in STATION.ids
    assert SENTENCE.fullmatch(first["text"])
    assert sum(one["frames"] for one in counts["contradictions"]) == sum(
        counts["reason"].get(word, 0) for word in ("survey", "calibration")
    )
    assert contradictions_in_words(counts)[0].startswith(first["text"])


def test_the_report_says_it(recording):
    folder, _ = recording
    assert SENTENCE.search(report([folder / "run"]))


@pytest.mark.parametrize("counts", [None, {}, {"contradictions": 3}, {"contradictions": [{"text": "x"}]}])
def test_a_damaged_description_says_nothing(counts):
    assert contradictions({"counts": counts}) == []


def test_the_health_of_a_server_says_it():
    frames = list(simulated_frames(load_scenario("faults/bent-light", SHORT), STATION, CAMERA, 3))
    stop, newest = threading.Event(), Newest()
    camera = SourceReader(lambda: (frame.detections for frame in frames), newest, live=False, loop=False, stop=stop)
    server = Server(Localizer(STATION, CAMERA), camera, newest, [], stop)
    assert server.health()["fixes"]["contradiction"] == ""
    server.serve()
    assert SENTENCE.fullmatch(server.health()["fixes"]["contradiction"])
