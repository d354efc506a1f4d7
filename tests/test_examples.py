"""The examples run as they stand, and say what they should."""

import re
import subprocess
import sys
from pathlib import Path

import cv2
import pytest
from bench.shipped import CAMERA_FILE, STATION_FILE, shipped_camera, shipped_station

from lumidock.app.run import Setup, run
from lumidock.config import Config
from lumidock.localizer import Localizer
from lumidock.sim.scenario import load_scenario
from lumidock.sim.sequence import write_rendered
from lumidock.streams.run_folder import RunFolder
from lumidock.streams.sources import open_source

EXAMPLES = Path(__file__).parents[1] / "examples"
DOCK = (STATION_FILE, CAMERA_FILE)


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    """A short rendered approach from 9.5 to 8.3 m."""
    folder = tmp_path_factory.mktemp("examples") / "sequence"
    settings = ("path.start_z_m=9.5", "path.end_z_m=8.3", "path.frame_interval_s=0.2")
    write_rendered(load_scenario("approach", settings), shipped_station(), shipped_camera(), 11, folder, workers=1)
    return folder


def say(name, *words):
    """What an example prints."""
    command = [sys.executable, EXAMPLES / name, *words]
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_one_image(sequence):
    text = say("01_one_image.py", sequence / "frames" / "000000.jpg", *DOCK)
    assert float(re.search(r"z \+([\d.]+) m", text)[1]) == pytest.approx(9.5, abs=0.2)


def test_video(sequence, tmp_path):
    video = tmp_path / "approach.mp4"
    camera = shipped_camera()
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"mp4v"), 5.0, (camera.width, camera.height))
    for picture in sorted((sequence / "frames").iterdir()):
        writer.write(cv2.imread(str(picture)))
    writer.release()
    lines = say("02_video.py", video, *DOCK).splitlines()
    assert len(lines) == 7
    assert sum("z +" in line for line in lines) >= 4


def test_own_array():
    text = say("03_own_array.py")
    assert "named: A, B, C, D, E, F" in text


def test_own_detector(sequence):
    text = say("04_own_detector.py", sequence / "frames" / "000003.jpg", *DOCK)
    assert int(re.match(r"\d+", text)[0]) >= 7


def test_reading_a_run(sequence, tmp_path):
    station, camera = shipped_station(), shipped_camera()
    with RunFolder(tmp_path / "run", station.ids) as folder:
        (tmp_path / "run" / "station.yaml").write_bytes(STATION_FILE.read_bytes())
        setup = Setup("lumidock", False, Config(), *DOCK)
        summary = run(open_source(sequence), Localizer(station, camera), folder, setup)
    text = say("05_read_a_run.py", tmp_path / "run")
    assert f"{summary.valid} of 7 frames have a pose" in text


def test_campaign(tmp_path):
    text = say("06_campaign.py", tmp_path / "campaign")
    assert "| missing-spurious | paper |" in text


def test_every_example_is_tried():
    tried = set(re.findall(r'say\("([^"]+)"', Path(__file__).read_text()))
    assert tried == {path.name for path in EXAMPLES.glob("*.py")}
