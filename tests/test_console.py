"""The console in this process: who may ask, what is answered, and that guidance never waits for it."""

import io
import json
import re
import socket
import struct
import threading
import time
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from commandline import wait_for
from hypothesis import given
from hypothesis import strategies as st
from test_run import CAMERA, simulate

from lumidock.app.console.frame_view import Scene, frame_view, trust
from lumidock.app.console.guard import Guard, is_loopback
from lumidock.app.console.jobs import Jobs
from lumidock.app.console.live import LiveView
from lumidock.app.console.replay import Recording, Replay, events
from lumidock.app.console.stretch import write_stretch
from lumidock.app.console.tuning import SETTINGS, changed, differences, load_profile, profile_text, save_profile
from lumidock.app.console.wizards import Files
from lumidock.app.reasons import REASONS, explain
from lumidock.app.serve import Newest, Server, SourceReader, Worker
from lumidock.camera import load_camera
from lumidock.config import Config
from lumidock.datatypes import Alternative, Detections, Fix, Frame, Guide, Match, Protection
from lumidock.errors import InputError
from lumidock.methods import localizer_of
from lumidock.station import load_station
from lumidock.streams.sources import open_source

pytest.importorskip("starlette")
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect

from lumidock.app.console.routes import Console, application
from lumidock.app.console.server import ConsoleServer

TOKEN = "a-token-for-tests"
HEAD_ON = np.diag([1.0, -1, -1, 1])
BEARER = {"Authorization": f"Bearer {TOKEN}"}
HOST = "http://127.0.0.1:8780"
OWN = {"Host": "127.0.0.1:8780"}


@pytest.fixture(autouse=True)
def _same_priority(monkeypatch):
    """Or the tests would wait for whatever else the machine does."""
    monkeypatch.setattr("lumidock.app.console.jobs._NICE", 0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return simulate(tmp_path_factory.mktemp("sequence"))


@pytest.fixture(scope="module")
def scene(folder):
    return Scene(load_station(folder / "station.yaml"), CAMERA)


def at(z_m=4.0):
    T = HEAD_ON.copy()
    T[2, 3] = z_m
    return T


def detected(uv, light, p_light=1.0):
    d = Detections.from_uv("a", 5, np.array(uv, float).reshape(-1, 2))
    d.p_light[:] = p_light
    return Match(d, np.array(light, np.int64))


def files(folder, tmp_path):
    return Files(folder / "station.yaml", folder / "camera.yaml", tmp_path)


@pytest.fixture
def live(folder, scene, tmp_path):
    """A console of a live camera whose newest frame is the first of the sequence."""
    view = LiveView(scene, lambda: {"camera": {"frames": 1}})
    console = Console(files(folder, tmp_path), "lumidock", Config(), "dock small", live=view, health=view.health)
    yield console
    console.close()


@pytest.fixture
def replay(folder, scene, tmp_path):
    """A console of the sequence, read to its end."""
    localizer = localizer_of("lumidock", scene.station, CAMERA, Config())
    recording = Recording(
        scene, folder / "station.yaml", folder / "camera.yaml", "lumidock", Config(), open_source(folder), None
    )
    console = Console(files(folder, tmp_path), "lumidock", Config(), "dock small")
    console.replay = Replay(recording, console.jobs, tmp_path, localizer)
    console.replay.start()
    wait_for(lambda: console.replay.ended)
    assert console.replay.problem == ""
    yield console
    console.close()


def client(console, host="127.0.0.1", url=HOST):
    return TestClient(Guard(application(console), host, TOKEN), base_url=url)


def result(page, answer):
    """The result of a job that a request started."""
    assert answer.status_code == 200, answer.text
    job = ended(page, answer)
    assert job["state"] == "done", job
    return job["result"]


def ended(page, answer):
    """The state of such a job once it has ended."""
    end = time.monotonic() + 240
    while (job := page.get(f"/api/jobs/{answer.json()['number']}").json())["state"] in ("waiting", "running"):
        assert time.monotonic() < end, job
        time.sleep(0.2)
    return job


# Who may ask


@pytest.mark.parametrize("path", ["/", "/static/main.js", "/api/about", "/api/settings", "/health.json"])
def test_this_machine_reads_without_a_token(live, path):
    assert client(live).get(path).status_code == 200


@pytest.mark.parametrize("host", ["evil.example", "evil.example:8780", "127.0.0.1.evil.example", "[::1", ""])
def test_a_name_that_anybody_can_point_here_is_refused(live, host):
    answer = client(live).get("/api/about", headers={"Host": host})
    assert answer.status_code in (400, 421)


@pytest.mark.parametrize("host", ["localhost:8780", "127.0.0.1", "[::1]:8780"])
def test_this_machine_is_known_by_its_names(live, host):
    assert client(live).get("/api/about", headers={"Host": host}).status_code == 200


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:9999", "https://127.0.0.1"])
def test_the_page_of_another_site_is_refused(live, origin):
    for method in ("GET", "POST"):
        answer = client(live).request(method, "/api/settings", headers={"Origin": origin, **BEARER})
        assert answer.status_code == 403


def writing(console):
    return [route.path for route in application(console).routes if getattr(route, "methods", None) == {"POST"}]


def test_nothing_is_written_without_the_token(live):
    page, paths = client(live), writing(live)
    assert len(paths) >= 10
    for path in paths:
        for headers in ({}, {"Authorization": "Bearer wrong"}, {"Authorization": ""}):
            assert page.post(path, json={}, headers=headers).status_code == 401, path


def test_another_address_wants_the_token_for_all_but_the_page(live):
    page = client(live, "192.168.2.2", "http://192.168.2.2:8780")
    assert page.get("/").status_code == 200
    assert page.get("/api/about").status_code == 401
    assert page.get("/api/about", headers=BEARER).status_code == 200
    host = {"Host": "192.168.2.2:8780"}
    with pytest.raises(WebSocketDisconnect), page.websocket_connect("/api/live", headers=host):
        pass
    offered = ["lumidock", f"token.{TOKEN}"]
    with page.websocket_connect("/api/live", subprotocols=offered, headers=host) as socket_:
        assert socket_.accepted_subprotocol == "lumidock"


@pytest.mark.parametrize("headers", [{"Host": "evil.example"}, {"Origin": "http://evil.example"}])
def test_the_live_socket_is_guarded_too(live, headers):
    with pytest.raises(WebSocketDisconnect), client(live).websocket_connect("/api/live", headers=OWN | headers):
        pass
    with client(live).websocket_connect("/api/live", headers=OWN | {"Origin": HOST}):
        pass


def test_a_body_is_small_and_json(live):
    page = client(live)
    assert page.post("/api/check", content=b"x" * 70_000, headers=BEARER).status_code == 413
    assert page.post("/api/preview", content=b"[1", headers=BEARER).status_code == 400
    assert page.post("/api/preview", content=b"[1]", headers=BEARER).json() == {"error": "wanted a JSON object"}


def test_the_policy_lets_nothing_in_from_outside(live):
    answer = client(live).get("/")
    policy = answer.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert answer.headers["x-content-type-options"] == "nosniff"


STATIC = Path(__file__).parents[1] / "src" / "lumidock" / "app" / "console" / "static"


def test_the_page_names_no_other_host_and_has_nothing_inline():
    for path in STATIC.iterdir():
        text = path.read_text(encoding="utf-8").replace("http://www.w3.org/2000/svg", "")
        assert not re.search(r"(https?|wss?):?//[\w]", text), path.name
        assert len(text.splitlines()) <= 500
    page = (STATIC / "index.html").read_text(encoding="utf-8")
    assert not re.search(r"<style|style=|\son\w+=|<script(?![^>]*src)", page)


@pytest.mark.parametrize("name", ["../routes.py", "..%2froutes.py", "main.py", "nothing.js"])
def test_only_files_of_the_page_are_given(live, name):
    assert client(live).get(f"/static/{name}").status_code == 404


@given(st.text(max_size=60))
def test_any_host_is_loopback_or_not(host):
    assert is_loopback(host) in (True, False)


# A fix on the page


def test_every_reason_of_the_documentation_is_explained_alike():
    text = (Path(__file__).parents[1] / "docs" / "reasons.md").read_text(encoding="utf-8")
    rows = {
        row[0].strip("` "): row[1:3]
        for line in text.splitlines()
        if (row := line.strip("| ").split(" | ")) and row[0].startswith("`")
    }
    assert {word: [reason.meaning, reason.remedy] for word, reason in REASONS.items()} == rows


def test_trust_has_three_colours_with_a_sentence():
    guide = Guide(0.0, 0.0, 9.0, 0.01, 0.2)
    fixes = {
        "valid": Fix("a", 5, "tracking", "front", T_dock_cam=at()),
        "guide": Fix("a", 5, "tracking", "front", reason="protection", guide=guide),
        "none": Fix("a", 5, "none", "search", reason="no_lights"),
    }
    for word, fix in fixes.items():
        assert trust(fix) == word
        assert explain(fix).meaning.endswith(".")
    assert explain(fixes["guide"]).meaning.startswith("Bearing and range may be used")


def test_levels_stand_beside_the_limits_of_the_dock(scene):
    fix = Fix("a", 5, "tracking", "front", T_dock_cam=at(), protection=Protection(0.1, 0.2, 0.01))
    levels = {row["name"]: row for row in frame_view(fix, scene, 1500)["levels"]}
    lateral_m, axial_m, angle_rad = scene.station.alert_limits.of_pose(4.0, 0.2)
    assert [levels[name]["limit"] for name in ("lateral", "axial")] == [lateral_m, axial_m]
    assert levels["angle"]["limit"] == pytest.approx(np.rad2deg(angle_rad), abs=1e-4)
    assert frame_view(fix, scene, 1500)["latency_ms"] == 1.5


def test_a_rejected_detection_says_why(scene):
    fix = Fix("a", 5, "tracking", "front", T_dock_cam=at(), match=detected([[50, 60], [10, 10]], [0, -1], 0.9))
    found = frame_view(fix, scene, None)["detections"]
    assert (found[0]["light"], found[0]["why"]) == ("A", "")
    assert re.fullmatch(r"Where no light is predicted: [\d.]+ px from [A-E], .+\.", found[1]["why"])
    unlike = Fix("a", 5, "none", "front", reason="too_few", match=detected([[10, 10]], [-1], 0.02))
    assert "probability that it is one is 2.0 %" in frame_view(unlike, scene, None)["detections"][0]["why"]
    alone = Fix("a", 5, "none", "front", reason="too_few", match=detected([[10, 10]], [-1]))
    assert "too_few" in frame_view(alone, scene, None)["detections"][0]["why"]


def test_alternatives_are_predicted_and_never_a_pose(scene):
    fix = Fix(
        "a", 5, "none", "front", reason="ambiguous", alternatives=(Alternative(0.6, at()), Alternative(0.4, at(5.0)))
    )
    view = frame_view(fix, scene, None)
    assert (view["trust"], view["pose"]) == ("none", None)
    assert [one["position"][2] for one in view["alternatives"]] == [4.0, 5.0]
    assert len(view["predicted"]) == len(scene.station)


def test_a_view_is_json_whatever_is_not_finite(scene):
    fix = Fix("a", 2**62, "tracking", "front", T_dock_cam=at(-1e-9), match=detected([[1, 2]], [-1], np.nan))
    assert json.loads(json.dumps(frame_view(fix, scene, None), allow_nan=False))["t_ns"] == str(2**62)


# Live


def opened(message):
    (length,) = struct.unpack_from("<I", message)
    return json.loads(message[4 : 4 + length]), message[4 + length :]


def test_a_page_gets_the_newest_fix_with_its_picture(live, folder):
    for item in open_source(folder).items():
        live.live.add(
            item, Fix(item.name, item.t_ns, "tracking", "front", T_dock_cam=at(), match=detected([[9, 9]], [2])), 7
        )
    with client(live).websocket_connect("/api/live", headers=OWN) as socket_:
        socket_.send_text("0")
        state, jpeg = opened(socket_.receive_bytes())
    assert (state["number"], state["last_seen_s"], state["health"]) == (7, {"C": 0.0}, {"camera": {"frames": 1}})
    picture = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape[:2] == (CAMERA.height, CAMERA.width)


def test_a_picture_is_made_once_for_all_pages_and_not_without_any(live, folder, monkeypatch):
    made = []
    monkeypatch.setattr("lumidock.app.console.live.picture_of", lambda image: made.append(image) or b"jpeg")
    item = next(iter(open_source(folder).items()))
    for _ in range(5):
        live.live.add(item, Fix(item.name, item.t_ns, "none", "front", reason="too_few"), None)
    assert made == []
    for _ in range(3):
        live.live.message()
    assert len(made) == 1


def test_frames_are_kept_while_asked_for_and_within_bounds(live, monkeypatch):
    monkeypatch.setattr("lumidock.app.console.live._MOST_KEPT", 10_000)
    image, fix = np.zeros((50, 50), np.uint8), Fix("a", 5, "none", "front", reason="too_few")
    live.live.add(Frame("a", 5, image), fix, None)
    assert live.live.kept() == []
    live.live.ask_to_keep()
    for number in range(9):
        live.live.add(Frame(str(number), number, image), fix, None)
    assert [frame.name for frame in live.live.kept()] == ["5", "6", "7", "8"]


class Still:
    """A localizer that knows its place."""

    def process(self, frame):
        return Fix(frame.name, frame.t_ns, "tracking", "rear", T_dock_cam=HEAD_ON)

    process_detections = process


def stalled_page(port):
    """A page that asks for a hundred messages and reads none."""
    page = socket.create_connection(("127.0.0.1", port))
    page.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    key = "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13"
    host = f"Host: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade"
    page.sendall(f"GET /api/live HTTP/1.1\r\n{host}\r\n{key}\r\n\r\n".encode())
    assert b"101" in page.recv(64)
    page.sendall(b"\x81\x81\x00\x00\x00\x000" * 100)  # the text "0" in a masked frame
    return page


def test_stalled_pages_do_not_delay_the_vehicle(live):
    """200 pictures in two seconds: the vehicle is sent every fix that is localized, and none waits for a page."""
    image = np.random.default_rng(5).integers(0, 255, (512, 612), np.uint8)  # hard to compress: 200 kB
    got, stop, newest = [], threading.Event(), Newest()

    class Vehicle:
        def add(self, _item, fix, _latency_us):
            got.append(fix.frame)

        def close(self):
            pass

    workers = [
        Worker("vehicle", Vehicle, queue=1, stale_s=0.25),
        Worker("console", lambda: live.live, queue=1, patient=True),
    ]
    camera = SourceReader(
        lambda: (Frame(str(i), i * 10_000_000, image) for i in range(200)), newest, live=False, loop=False, stop=stop
    )
    served = Server(Still(), camera, newest, workers, stop)
    page = ConsoleServer(live, "127.0.0.1", 0)
    stalled = [stalled_page(page.port) for _ in range(3)]
    began = time.monotonic()
    served.serve()
    took_s = time.monotonic() - began
    for one in stalled:
        one.close()
    page.close()
    assert len(got) >= 100
    assert took_s < 20.0  # without any page it takes 2; a page that was waited for would take 30
    assert served.health()["sinks"]["vehicle"]["stale"] <= 20


def test_a_page_that_goes_away_gives_its_place_back(live):
    for _ in range(12):
        with client(live).websocket_connect("/api/live", headers=OWN) as socket_:
            socket_.send_text("no number")
            with pytest.raises(WebSocketDisconnect):
                socket_.receive_bytes()
    assert live.pages == 0


def test_settings_are_tried_on_the_last_seconds(live, folder):
    page = client(live)
    assert "no frame has been kept" in page.post("/api/preview", json={}, headers=BEARER).json()["error"]
    page.post("/api/keep", json={}, headers=BEARER)
    for item in open_source(folder).items():
        live.live.add(item, Fix(item.name, item.t_ns, "none", "front", reason="too_few"), None)
    assert page.post("/api/keep", json={}, headers=BEARER).json() == {"frames": 7, "seconds": 1.5}
    found = result(page, page.post("/api/preview", json={"settings": {"detect.min_snr": 1e4}}, headers=BEARER))
    assert "v" in found["in_use"]["trust"]
    assert found["proposed"]["trust"] == "n" * 7  # a light of a contrast of 10,000 there is not
    assert live.config == Config()


# Replay


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
    job = replay.rerun("lumidock", Config(), "again", None)
    wait_for(lambda: job.state in ("done", "failed"), 120)
    assert job.state == "done", job.line
    variants = replay.view()["variants"]
    assert variants[0]["trust"] == variants[1]["trust"]
    replay.close()
    jobs.close()


# Settings and profiles


@given(st.dictionaries(st.sampled_from([one.path for one in SETTINGS]), st.floats(0.051, 0.09)))
def test_a_profile_holds_what_differs_and_nothing_else(values):
    out_of_bounds = ("integrity.risk", "prior.roll_deg", "prior.pitch_deg", "prior.yaw_deg")
    config = changed(Config(), {path: value for path, value in values.items() if path not in out_of_bounds})
    text = profile_text(config, "dock x\nvehicle y")
    assert text.startswith("# lumidock profile: dock x vehicle y\n")
    assert yaml.safe_load(text) == differences(config, Config())


def test_a_profile_is_saved_where_the_user_says_and_nowhere_else(live, tmp_path):
    page, path = client(live), tmp_path / "dock.yaml"
    asked = {"path": str(path), "settings": {"match.spurious": 9}, "vehicle": "BlueROV2"}
    assert page.post("/api/profile/save", json=asked, headers=BEARER).json() == {"saved": str(path)}
    assert load_profile(path).match.spurious == 9.0
    assert "BlueROV2" in path.read_text()
    assert "exists" in page.post("/api/profile/save", json=asked, headers=BEARER).json()["error"]
    assert page.post("/api/profile/save", json=asked | {"replace": True}, headers=BEARER).status_code == 200
    loaded = page.post("/api/profile/load", json={"path": str(path)}, headers=BEARER).json()
    assert {one["path"]: one["value"] for one in loaded}["match.spurious"] == 9.0


@pytest.mark.parametrize("name", ["dock.txt", "missing/dock.yaml", "", ".bashrc", "a\0.yaml"])
def test_other_files_are_not_written(live, tmp_path, name):
    answer = client(live).post("/api/profile/save", json={"path": name and str(tmp_path / name)}, headers=BEARER)
    assert answer.status_code == 400
    assert list(tmp_path.iterdir()) == []


def test_saving_replaces_files_only(tmp_path):
    (tmp_path / "folder.yaml").mkdir()
    with pytest.raises(InputError, match="exists"):
        save_profile("{}", tmp_path / "folder.yaml", replace=True)


def test_every_setting_is_explained(live):
    for one in client(live).get("/api/settings").json():
        assert one["title"]
        assert one["effect"].endswith(".")
        assert one["value"] == one["default"]


# Wizards


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
