"""`lumidock survey`, `station design` and `calib water` as commands."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from bench.built_docks import BuiltDock, built_dock, taped

from lumidock.camera import save_camera
from lumidock.station import load_station


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> tuple[BuiltDock, list[Path]]:
    """A dock 5 cm off its drawing, and two dockings at it as sequences of bare detections."""
    dock, folder = built_dock(5, interval_s=0.2), tmp_path_factory.mktemp("recorded")
    folders = []
    for number, recording in enumerate(dock.recordings):
        out = folder / f"seq{number}"
        out.mkdir()
        save_camera(dock.camera, out / "camera.yaml")
        with (out / "timestamps.csv").open("w", newline="") as file:
            csv.writer(file).writerows([("frame", "file", "t_ns"), *((d.frame, "", d.t_ns) for d in recording)])
        with (out / "detections.csv").open("w", newline="") as file:
            rows = [(d.frame, *uv, p) for d in recording for uv, p in zip(d.uv, d.p_rear, strict=True)]
            csv.writer(file).writerows([("frame", "u_px", "v_px", "p_rear"), *rows])
        folders.append(out)
    return dock, folders


def test_a_survey_writes_a_station_that_fits_and_a_page(lumidock, recorded, tmp_path):
    dock, folders = recorded
    out, page = tmp_path / "dock.yaml", tmp_path / "survey.html"
    i, j, metres = taped(dock, "F1", "R5")
    tape = ("--distance", dock.drawing.ids[i], dock.drawing.ids[j], metres)
    words = ("--station", "cage-2x2x5", "--off", 0.05, *tape, "--out", out, "--page", page, "--json")
    code, text, _ = lumidock("survey", *folders, *words)
    assert code == 0
    told = json.loads(text)
    assert told["held_out_px"]["survey"] < 1.0 < told["held_out_px"]["drawing"]
    surveyed = load_station(out).p_dock
    assert np.linalg.norm(surveyed[i] - surveyed[j]) == pytest.approx(metres, abs=0.006)
    html = page.read_text()
    assert "usable" in html
    assert all(light in html for light in dock.drawing.ids)

    code, text, _ = lumidock("survey", folders[1], "--station", out, "--check", "--json")
    assert (code, json.loads(text)["moved"]) == (0, [])
    content = yaml.safe_load(out.read_text())
    content["lights"][10]["position"][0] += 0.08
    out.write_text(yaml.safe_dump(content))
    code, text, _ = lumidock("survey", folders[1], "--station", out, "--check", "--json")
    assert (code, json.loads(text)["moved"]) == (1, [content["lights"][10]["id"]])


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (("--station", "cage-2x2x5"), "--out FILE"),
        (("--out", "x.yaml"), "--station FILE"),
        (("--station", "cage-2x2x5", "--out", "x.yaml", "--distance", "F1", "F99", "2"), "no light F99"),
        (("--station", "cage-2x2x5", "--out", "x.yaml", "--distance", "F1", "F2", "far"), "two lights and metres"),
        (("--station", "cage-2x2x5", "--out", "x.yaml", "--known", "side"), "no layer side"),
        (("--lights", "7", "--out", "x.yaml"), "--lights 7"),
    ],
)
def test_wrong_words_are_one_line(refusal, recorded, tmp_path, monkeypatch, words, match):
    monkeypatch.chdir(tmp_path)
    assert match in refusal("survey", recorded[1][0], *words)
    assert not (tmp_path / "x.yaml").exists()


_SPEC = """schema: 1
name: small
dead: 1
from_z_m: 6
seed: 3
evaluations: 24
places:
  - {layer: front, lights: 5, corner: [-0.5, -0.5, 0], along: [1, 0, 0], across: [0, 1, 0]}
"""


def test_the_same_spec_gives_the_same_dock(lumidock, tmp_path):
    pytest.importorskip("cma")
    spec = tmp_path / "small.yaml"
    spec.write_text(_SPEC)
    for name in ("a.yaml", "b.yaml"):
        code, text, _ = lumidock("station", "design", spec, "--out", tmp_path / name, "--json")
        assert code == 0
        assert json.loads(text)["evaluations"] >= 24
    a, b = (load_station(tmp_path / name) for name in ("a.yaml", "b.yaml"))
    np.testing.assert_array_equal(a.p_dock, b.p_dock)
    assert np.abs(a.p_dock[:, :2]).max() <= 0.5


def test_a_spec_with_an_unknown_key_is_refused(refusal, tmp_path):
    spec = tmp_path / "spec.yaml"
    spec.write_text(_SPEC + "colour: red\n")
    assert "unknown key" in refusal("station", "design", spec, "--out", tmp_path / "a.yaml")


def test_calibration_wants_a_board_or_a_dock(refusal, tmp_path):
    assert "--dock" in refusal("calib", "water", "--out", tmp_path / "camera.yaml")
    words = ("calib", "water", tmp_path, "--out", tmp_path / "camera.yaml")
    assert "charuco or chessboard" in refusal(*words, "--board", "dots")
    assert "COLUMNSxROWS" in refusal(*words, "--squares", "8")
