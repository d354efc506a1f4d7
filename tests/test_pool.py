"""Real frames, where they are at hand: the run finishes, and its poses reproject onto what was seen."""

import csv
import json
from pathlib import Path

import pytest

from lumidock.camera import load_camera
from lumidock.config import Config
from lumidock.paper import PaperLocalizer
from lumidock.run import Setup, run
from lumidock.station import load_station
from lumidock.streams.runfolder import RunFolder
from lumidock.streams.sources import open_source

POOL = Path(__file__).parents[2] / "shared" / "real" / "pool-ring"


@pytest.mark.skipif(not POOL.exists(), reason="the real pool frames are not on this machine")
def test_pool_run_finishes_with_a_row_for_every_frame(tmp_path):
    source = open_source(POOL)
    station = load_station(POOL / "station.yaml")
    localizer = PaperLocalizer(station, load_camera(POOL / "camera.yaml"))
    setup = Setup("paper", False, Config(), POOL / "station.yaml", POOL / "camera.yaml")
    with RunFolder(tmp_path / "run", station.ids) as folder:
        run(source, localizer, folder, setup)
    with (tmp_path / "run" / "fixes.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["frame"] for row in rows] == [str(number) for number in range(240)]
    assert all(row["valid"] == "0" for row in rows[:40])  # no dock in view
    assert json.loads((tmp_path / "run" / "run.json").read_text())["counts"]["finished"]
