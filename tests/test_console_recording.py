"""A recording on the page: frame by frame, run again, and packed."""

import io
import json
import zipfile

import numpy as np
import pytest
from asking import BEARER, HEAD_ON, client, result
from commandline import wait_for

from lumidock.app.console.jobs import Jobs
from lumidock.app.console.limits import Choice
from lumidock.app.console.replay import Recording, Replay, events
from lumidock.app.console.stretch import write_stretch
from lumidock.app.console.wizards import Files
from lumidock.config import Config
from lumidock.datatypes import Fix, Guide
from lumidock.streams.sources import open_source


def test_a_recording_is_read_with_its_fixes_and_pictures(replay):
    page = client(replay)
    view = page.get("/api/recording").json()
    assert (view["count"], view["pictures"], view["ended"], view["t_s"][-1]) == (7, 7, True, 1.5)
    assert view["variants"][0]["trust"].count("v") >= 5
    assert page.get("/api/picture/3").headers["content-type"] == "image/jpeg"
    assert page.get("/api/picture/99").status_code == 204
    frame = page.get("/api/recording/0/6").json()
    assert (frame["index"], frame["trust"]) == (6, "valid")
    assert set(frame["last_seen_s"]) == {"A", "B", "C", "D", "E"}
    assert page.get("/api/recording/0/99").json() is None
    assert page.get("/api/recording/5/0").status_code == 400


def test_losses_and_alarms_are_found():
    pose, guide = Fix("a", 5, "tracking", "rear", T_dock_cam=HEAD_ON), Guide(0.0, 0.0, 9.0, 0.01, 0.2)
    led = Fix("a", 5, "tracking", "rear", reason="protection", guide=guide)
    none, frozen = (Fix("a", 5, "none", "rear", reason=word) for word in ("stale", "frozen"))
    found = [
        (event["index"], event["kind"])
        for event in events([none, pose, pose, led, none, none, frozen, frozen, pose, none])
    ]
    assert found == [(3, "loss"), (4, "loss"), (6, "alarm"), (9, "loss")]


def test_a_stretch_is_run_again_with_another_method_and_settings(replay):
    page = client(replay)
    asked = {"method": "lumidock", "settings": {"detect.min_snr": 1e4}, "first": 2, "last": 4, "label": "blind"}
    number = result(page, page.post("/api/rerun", json=asked, headers=BEARER))["variant"]
    variant = page.get("/api/recording").json()["variants"][1]
    assert (variant["number"], variant["label"], variant["first"], variant["trust"]) == (number, "blind", 2, "nnn")
    assert page.get(f"/api/recording/{number}/3").json()["frame"] == page.get("/api/recording/0/3").json()["frame"]
    assert page.get(f"/api/recording/{number}/1").json() is None
    number = result(page, page.post("/api/rerun", json={"method": "p3p-vote"}, headers=BEARER))["variant"]
    assert len(page.get("/api/recording").json()["variants"][number]["trust"]) == 7


@pytest.mark.parametrize(
    ("asked", "why"),
    [
        ({"method": "magic"}, "no such method"),
        ({"first": 4, "last": 2}, "wanted the first before the last"),
        ({"first": 0, "last": 10**6}, "at most"),
        ({"first": "0", "last": 3}, "wanted the numbers"),
        ({"settings": {"integrity.risk": 7}}, "integrity.risk"),
        ({"settings": {"match.max_pairs": 7}}, "none that the console changes"),
        ({"settings": {"match.spurious": "much"}}, "wanted a number"),
        ({"settings": [1]}, "wanted names and numbers"),
    ],
)
def test_what_cannot_be_run_is_refused_in_a_line(replay, asked, why):
    answer = client(replay).post("/api/rerun", json=asked, headers=BEARER)
    assert answer.status_code == 400
    assert why in answer.json()["error"]


def test_a_bundle_repeats_what_was_seen(replay, tmp_path, lumidock):
    page = client(replay)
    asked = {"variant": 0, "first": 1, "last": 4, "bookmarks": [2], "notes": "lost here"}
    answer = page.post("/api/bundle", json=asked, headers=BEARER)
    result(page, answer)
    got = page.get(f"/api/jobs/{answer.json()['number']}/file", headers=BEARER)
    with zipfile.ZipFile(io.BytesIO(got.content)) as archive:
        archive.extractall(tmp_path / "bundle")
    about = json.loads((tmp_path / "bundle" / "about.json").read_text())
    assert (about["frames"], about["bookmarks"], about["notes"]) == ([1, 4], [2], "lost here")
    bundle = tmp_path / "bundle"
    words = ("--config", bundle / "config.yaml", "--out", bundle / "again", "--json")
    code, out, _ = lumidock("run", bundle / "sequence", *words)
    assert (code, json.loads(out)["frames"]) == (0, 4)
    assert len((bundle / "run" / "fixes.csv").read_text().splitlines()) == 5


def test_a_stretch_of_pictures_is_written_pixel_for_pixel(folder, tmp_path):
    before = list(open_source(folder).items())
    assert write_stretch(before, tmp_path / "copy") == 7
    after = list(open_source(tmp_path / "copy").items())
    assert [(a.name, a.t_ns) for a in after] == [(b.name, b.t_ns) for b in before]
    assert all(np.array_equal(a.image, b.image) for a, b in zip(after, before, strict=True))


def test_a_stretch_of_detections_is_written_too(bare, tmp_path):
    before = list(open_source(bare).items())
    write_stretch(before, tmp_path / "copy")
    after = list(open_source(tmp_path / "copy").items())
    assert all(np.array_equal(a.uv, b.uv) for a, b in zip(after, before, strict=True))


def test_a_run_without_its_frames_is_replayed_and_repeated(bare, tmp_path, lumidock, scene):
    assert lumidock("run", bare, "--out", tmp_path / "run")[0] == 0
    run, jobs = tmp_path / "run", Jobs()
    recording = Recording(scene, run / "station.yaml", run / "camera.yaml", "lumidock", Config(), None, run)
    replay = Replay(recording, jobs, tmp_path)
    replay.start()
    wait_for(lambda: replay.ended)
    job = replay.rerun(
        "lumidock", Choice(Config(), Files(run / "station.yaml", run / "camera.yaml", tmp_path)), "again", None
    )
    wait_for(lambda: job.state in ("done", "failed"), 120)
    assert job.state == "done", job.line
    variants = replay.view()["variants"]
    assert variants[0]["trust"] == variants[1]["trust"]
    replay.close()
    jobs.close()
