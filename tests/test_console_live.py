"""The live view, and that guidance never waits for it."""

import json
import socket
import struct
import threading
import time

import cv2
import numpy as np
import pytest
from asking import BEARER, HEAD_ON, OWN, at, client, detected, result
from starlette.websockets import WebSocketDisconnect
from test_run import CAMERA

from lumidock.app.console.server import ConsoleServer
from lumidock.app.serve import Newest, Server, SourceReader, Worker
from lumidock.config import Config
from lumidock.datatypes import Fix, Frame
from lumidock.streams.sources import open_source


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
