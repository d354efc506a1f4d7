"""Real frames, where they are at hand: the run finishes, and its poses reproject onto what was seen."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from lumidock.app.run import Setup, run
from lumidock.camera import load_camera
from lumidock.config import Config
from lumidock.datatypes import Frame
from lumidock.localizer import Localizer
from lumidock.paper import PaperLocalizer
from lumidock.station import load_station
from lumidock.streams.run_folder import RunFolder
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


@pytest.mark.skipif(not POOL.exists(), reason="the real pool frames are not on this machine")
def test_lights_beside_a_white_funnel_are_found_and_named():
    """No track where no dock is in view; where eight lights are, it holds, identifies them and fits the image."""
    station, camera = load_station(POOL / "station.yaml"), load_camera(POOL / "camera.yaml")
    localizer = Localizer(station, camera)
    tracked, errors, found = [], [], []
    for number, frame in enumerate(open_source(POOL).items()):
        if number >= 150:
            break
        if not (number < 41 or number >= 80):
            continue
        assert isinstance(frame, Frame)
        fix = localizer.process(frame)
        holds = fix.status != "none" and fix.guide is not None
        assert number >= 41 or not holds
        tracked += [holds] if number >= 84 else []
        if holds and fix.status != "coasting":
            T_cam_dock = localizer.state.first.T_cam_dock
            uv = camera.project(station.p_dock @ T_cam_dock[:3, :3].T + T_cam_dock[:3, 3])
            named = fix.match.light >= 0
            errors += np.linalg.norm(fix.match.detections.uv[named] - uv[fix.match.light[named]], axis=1).tolist()
            inside = ((uv > 2.0) & (uv < (camera.width - 3.0, camera.height - 3.0))).all(axis=1)
            if inside.sum() >= 6:
                found += np.isin(np.flatnonzero(inside), fix.match.light[named]).tolist()
    assert np.mean(tracked) > 0.97
    assert np.mean(found) > 0.96, "lights in view that are identified"
    assert np.median(errors) < 1.0  # px; the camera turns, and a pose lags behind by most of this
