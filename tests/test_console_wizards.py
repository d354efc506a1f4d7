"""Dock check, calibration and survey on the page."""

import json

import cv2
import numpy as np
import pytest
from asking import BEARER, client, ended, result

from lumidock.camera import load_camera
from lumidock.datatypes import Fix, Frame


def test_the_dock_check_is_the_one_of_the_command(live, folder, lumidock):
    page = client(live)
    found = result(page, page.post("/api/check", json={}, headers=BEARER))
    _, out, _ = lumidock("station", "check", folder / "station.yaml", "--camera", folder / "camera.yaml", "--json")
    assert found == json.loads(out)


BOARD = {"kind": "charuco", "columns": 8, "rows": 6, "square_m": 0.04, "marker_m": 0.03, "dictionary": "DICT_4X4_50"}


def board_views(count):
    """Pictures of a ChArUco board that a pinhole of 500 px takes from around."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    drawn = cv2.aruco.CharucoBoard((8, 6), 0.04, 0.03, dictionary).generateImage((800, 600))
    K = np.array([[500.0, 0, 319.5], [0, 500.0, 239.5], [0, 0, 1]])
    to_m = np.array([[0.04 / 100, 0, 0], [0, 0.04 / 100, 0], [0, 0, 1.0]])
    rng = np.random.default_rng(7)
    for number in range(count):
        R = cv2.Rodrigues(rng.uniform(-0.5, 0.5, 3))[0]
        t = np.array([*rng.uniform(-0.05, 0.05, 2), rng.uniform(0.3, 0.55)]) - R @ [0.16, 0.12, 0.0]
        H = K @ np.column_stack([R[:, 0], R[:, 1], t]) @ to_m
        yield Frame(str(number), number, cv2.warpPerspective(drawn, H, (640, 480), borderValue=90))


def test_a_camera_is_calibrated_from_views_that_were_taken(live, tmp_path):
    page = client(live)
    nothing = Fix("a", 5, "none", "front", reason="no_lights")
    assert "no picture yet" in page.post("/api/board/look", json=BOARD, headers=BEARER).json()["error"]
    for frame in board_views(8):
        live.live.add(frame, nothing, None)
        seen = page.post("/api/board/look", json=BOARD | {"take": True}, headers=BEARER).json()
        assert len(seen["corners"]) >= 8, seen
    assert seen["taken"] == 8
    assert np.sum(seen["coverage"]) > 100
    found = result(page, page.post("/api/board/solve", json=BOARD, headers=BEARER))
    assert found["focal_px"] == pytest.approx([500.0, 500.0], rel=0.02)
    target = tmp_path / "found.yaml"
    asked = {"kind": "calibration", "path": str(target)}
    assert page.post("/api/save", json=asked, headers=BEARER).json() == {"saved": str(target)}
    assert load_camera(target).focal_px == pytest.approx(found["focal_px"])
    assert page.post("/api/save", json=asked | {"kind": "survey"}, headers=BEARER).status_code == 400


def test_a_picture_without_the_board_is_not_taken(live):
    live.live.add(Frame("a", 5, np.zeros((480, 640), np.uint8)), Fix("a", 5, "none", "front", reason="no_lights"), None)
    page = client(live)
    answer = page.post("/api/board/look", json=BOARD | {"take": True}, headers=BEARER)
    assert "nothing was taken" in answer.json()["error"]
    for spoilt in ({"kind": "dots"}, {"columns": "x"}, {"dictionary": "__class__"}):
        assert page.post("/api/board/look", json=BOARD | spoilt, headers=BEARER).status_code == 400


def test_a_survey_that_must_not_be_used_says_why(replay):
    page = client(replay)
    answer = page.post("/api/survey", json={"off_m": 0.05, "tape_m": 1.7, "tape_a": "A", "tape_b": "B"}, headers=BEARER)
    job = ended(page, answer)
    assert job["state"] == "failed"
    assert "frames" in job["line"]  # seven are too few
    assert page.post("/api/save", json={"kind": "survey", "path": "/tmp/x.yaml"}, headers=BEARER).status_code == 400


def test_labels_go_to_the_survey_and_wrong_ones_are_refused(replay):
    page = client(replay)
    frame = page.get("/api/recording/0/6").json()
    label = {"frame": frame["frame"], "uv": frame["detections"][0]["uv"], "light": "Z"}
    job = ended(page, page.post("/api/survey", json={"off_m": 0.05, "labels": [label]}, headers=BEARER))
    assert "no light Z" in job["line"]
    for labels in ([label | {"light": "A"}] * 2, [label | {"light": "A", "uv": [-9.0, -9.0]}]):
        job = ended(page, page.post("/api/survey", json={"off_m": 0.05, "labels": labels}, headers=BEARER))
        assert "given twice" in job["line"] or "no detection" in job["line"]
    answer = page.post("/api/survey", json={"off_m": 0.05, "labels": [{"frame": 1}]}, headers=BEARER)
    assert "wanted a list of frame, uv and light" in answer.json()["error"]
