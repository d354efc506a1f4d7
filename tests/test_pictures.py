"""Overlays, the trajectory plot and the contact sheet: they are made, and show what they should."""

import re
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
from bench.shipped import shipped_camera, shipped_station

from lumidock.app import demo
from lumidock.datatypes import Detections, Fix, Match
from lumidock.pose import project_lights
from lumidock.report.stills import contact_sheet, plot_trajectory
from lumidock.streams.overlay import around_lights, brightened, draw, shown_detections, whole

STATION, CAMERA = shipped_station(), shipped_camera()


def fix_at(z, *, valid=True):
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[2, 3] = z
    detections = Detections.from_uv(
        f"{z}", 0, np.concatenate([project_lights(CAMERA, T, STATION.p_dock[:7]), [[90.0, 80.0]]])
    )
    match = Match(detections, np.array([*range(7), -1]))
    if not valid:
        return Fix(f"{z}", 0, "none", "search", 8, reason="inconsistent", match=match)
    return Fix(f"{z}", 0, "acquired", "front", 8, 7, T, match=match)


def test_overlay_marks_every_detection_where_it_is():
    image = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    fix = fix_at(9.0)
    view = whole(image, 1224)
    drawn = draw(image, fix, STATION, CAMERA, view)
    assert drawn.shape == (1024, 1224, 3)
    for uv in fix.match.detections.uv:
        u, v = view.at(uv)
        assert drawn[v - 12 : v + 13, u - 12 : u + 13].max() > 100
    assert image.max() == 0


def test_overlay_of_a_mono_frame_without_a_fix_has_no_crosses():
    image = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
    with_pose, without = (
        draw(image, fix_at(9.0, valid=valid), STATION, CAMERA, whole(image, 1224)) for valid in (True, False)
    )
    u, v = whole(image, 1224).at(fix_at(9.0).match.detections.uv[0])
    assert with_pose[v, u].max() > 0
    assert without[v, u].max() == 0


def test_close_view_holds_all_detections_and_stays_inside():
    image = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    for z in (25.0, 9.0, 3.0):
        view = around_lights(image, fix_at(z), 600)
        assert 0 <= view.u <= view.u + view.width <= CAMERA.width
        assert 0 <= view.v <= view.v + view.height <= CAMERA.height
        for uv in fix_at(z).match.detections.uv[:7]:
            assert view.u <= uv[0] <= view.u + view.width


def test_plot_and_sheet_are_written(tmp_path):
    fixes = [fix_at(z) for z in (20.0, 9.0)] + [fix_at(5.0, valid=False)]
    plot_trajectory(
        fixes, {fix.frame: fix_at(float(fix.frame)).T_dock_cam for fix in fixes}, STATION, tmp_path / "t.png"
    )
    assert cv2.imread(str(tmp_path / "t.png")).std() > 10
    contact_sheet(
        [np.full((100, 120, 3), level, np.uint8) for level in (0, 80, 160, 240)], tmp_path / "s.jpg", width=60
    )
    assert cv2.imread(str(tmp_path / "s.jpg")).shape == (108, 128, 3)
    contact_sheet([], tmp_path / "none.jpg")
    assert not (tmp_path / "none.jpg").exists()


def test_improbable_detections_have_no_ring_unless_they_are_identified():
    image = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    fix = fix_at(9.0)
    detections = replace(fix.match.detections, p_light=np.array([0.01, *[0.9] * 6, 0.09]))
    fix = replace(fix, match=replace(fix.match, detections=detections))
    assert shown_detections(fix.match).tolist() == [0, 1, 2, 3, 4, 5, 6]
    crop = whole(image, CAMERA.width)
    drawn = draw(image, replace(fix, frame=""), STATION, CAMERA, crop)
    u, v = crop.at(detections.uv[7])
    assert drawn[v + 9, u].max() == 0  # where its ring would be
    u, v = crop.at(detections.uv[0])
    assert drawn[v + 9, u].max() > 100


def test_text_can_be_read_on_a_halo():
    image = np.full((CAMERA.height, CAMERA.width, 3), 250, np.uint8)
    fix = fix_at(9.0)
    drawn, crop = draw(image, fix, STATION, CAMERA, whole(image, 1224)), whole(image, 1224)
    u, v = crop.at(fix.match.detections.uv[0])
    beside = drawn[v - 14 : v - 2, u + 12 : u + 30]
    assert beside.min() < 0.4 * 250  # the ground of the light's id is dark


def test_a_dim_image_is_brightened_and_a_bright_one_left_alone():
    dim = np.full((200, 200, 3), 20, np.uint8)
    dim[90:110, 90:110] = 60
    seen, gain = brightened(dim)
    assert gain > 3.0
    assert seen[100, 100, 0] > 180
    assert brightened(np.full((20, 20), 250, np.uint8))[1] == 1.0


@pytest.mark.parametrize("extras", [True, False], ids=["all extras", "base install"])
def test_the_demo_does_its_job_with_and_without_extras(lumidock, monkeypatch, tmp_path, extras):
    if not extras:
        for module in ("av", "matplotlib"):
            monkeypatch.setitem(sys.modules, module, None)  # as if it were not installed
    monkeypatch.setattr(demo, "SETTINGS", (*demo.SETTINGS, "path.start_z_m=9", "path.frame_interval_s=2.4"))
    code, out, err = lumidock("demo", "--out", tmp_path / "demo", "--seed", "3")
    assert (code, err) == (0, "")
    made = {path.name for path in (tmp_path / "demo").iterdir()}
    always = {"sequence", "run", "stages.jpg"}
    assert made == (always | {"annotated.mp4", "report.html", "trajectory.png"} if extras else always)
    assert ("pip install 'lumidock[video]'" in out) == ("pip install 'lumidock[report]'" in out) == (not extras)
    assert re.search(r"^identities  0 of \d+ identified", out, re.MULTILINE)
    if extras:
        assert b"avc1" in (tmp_path / "demo" / "annotated.mp4").read_bytes()[:2000]  # H.264, which browsers play
