"""The live server in this process: its slot, its queues, its camera and its health page."""

import errno
import json
import socket
import threading
import time
import urllib.error
import urllib.request
from contextlib import suppress

import numpy as np
import pytest
from commandline import wait_for

from lumidock.app.serve import Done, Newest, Server, SourceReader, Taken, Worker
from lumidock.datatypes import Fix, Frame
from lumidock.streams.healthpage import HealthPage

IMAGE = np.zeros((8, 8), np.uint8)


def made(fix=None, item=None, at_s=None):
    T = np.diag([1.0, -1, -1, 1])
    item = item or Frame("a", 5, IMAGE)
    return Done(
        Taken(item, time.monotonic() if at_s is None else at_s), fix or Fix("a", 5, "tracking", "rear", T_dock_cam=T), 7
    )


# Slots and queues


def test_a_newer_frame_replaces_the_one_that_waits():
    newest = Newest()
    assert newest.get(0.0) is None
    for name in "abc":
        newest.put(Frame(name, 0, IMAGE))
    assert newest.get(0.0).item.name == "c"
    assert (newest.dropped, newest.get(0.0)) == (2, None)


def test_a_recording_waits_until_the_last_picture_has_been_looked_at():
    newest = Newest()
    newest.put(Frame("a", 0, IMAGE))
    for looked_at in (False, True):
        if looked_at:
            newest.get(0.0)
            newest.get(0.0)  # asked for the next one
        start = time.monotonic()
        newest.wait_until_idle(60.0 if looked_at else 0.2)
        waited_s = time.monotonic() - start
        assert waited_s < 30.0 if looked_at else waited_s >= 0.2


class Recorder:
    """A sink that notes what it gets; `act` may raise or wait."""

    def __init__(self, act=lambda _: None):
        self.got, self.act, self.closed = [], act, 0

    def add(self, item, fix, latency_us):
        self.act(len(self.got))
        self.got.append((item, fix, latency_us))

    def close(self):
        self.closed += 1


def test_a_queue_drops_its_oldest_and_the_rest_arrives():
    gate = threading.Event()
    sink = Recorder(lambda _: gate.wait(20))
    worker = Worker("w", lambda: sink, queue=3)
    worker.start()
    worker.offer(made(item=Frame("0", 0, IMAGE)))
    wait_for(lambda: not worker._queue)
    for name in "123456":
        worker.offer(made(item=Frame(name, 0, IMAGE)))
    gate.set()
    worker.finish()
    assert [item.name for item, _, _ in sink.got] == ["0", "4", "5", "6"]
    assert (worker.dropped, worker.sent, sink.closed) == (3, 4, 1)


def test_a_sink_that_fails_is_opened_again():
    sinks = []

    def open_sink():
        def fail(number):
            if len(sinks) == 1 and number == 1:
                raise OSError(errno.ENOSPC, "No space left on device")

        sinks.append(Recorder(fail))
        return sinks[-1]

    worker = Worker("w", open_sink, queue=10)
    worker.start()
    worker.offer(made())
    wait_for(lambda: worker.sent == 1)
    worker.offer(made())
    wait_for(lambda: worker.errors == 1)
    assert "No space left" in worker.problem
    worker.offer(made())
    wait_for(lambda: worker.sent == 2)
    worker.finish()
    assert (len(sinks), sinks[0].closed, worker.problem) == (2, 1, "")


def test_what_is_stale_is_not_sent():
    sink = Recorder()
    worker = Worker("w", lambda: sink, queue=5, stale_s=30.0)
    worker.start()
    worker.offer(made(at_s=time.monotonic() - 31.0))
    worker.offer(made())
    worker.finish()
    assert (len(sink.got), worker.stale) == (1, 1)


def test_a_viewer_begins_when_the_vehicle_has_been_told(monkeypatch):
    monkeypatch.setattr("lumidock.app.serve._YIELD_S", 0.2)
    began = {}
    workers = [
        Worker(name, lambda name=name: Recorder(lambda _: began.setdefault(name, time.monotonic())), queue=5, **options)
        for name, options in (("viewer", {"patient": True}), ("vehicle", {}))
    ]
    start = time.monotonic()
    for worker in workers:
        worker.start()
        worker.offer(made())
    for worker in workers:
        worker.finish()
    assert began["vehicle"] < began["viewer"]
    assert began["viewer"] - start >= 0.2


def test_a_sink_that_hangs_is_left_behind(monkeypatch):
    monkeypatch.setattr("lumidock.app.serve._CLOSING_S", 0.1)
    release = threading.Event()
    sink = Recorder(lambda _: release.wait(60))
    worker = Worker("w", lambda: sink, queue=5)
    worker.start()
    worker.offer(made())
    worker.finish()  # or it would take a minute
    assert not sink.closed
    release.set()


class Still:
    """A localizer that knows its place."""

    def process(self, frame):
        return Fix(frame.name, frame.t_ns, "tracking", "rear", T_dock_cam=np.diag([1.0, -1, -1, 1]))

    process_detections = process


def server(items, workers, **options):
    stop, newest = threading.Event(), Newest()
    camera = SourceReader(items, newest, **({"live": False, "loop": False, "stop": stop} | options))
    return Server(Still(), camera, newest, workers, stop)


def test_a_blocked_client_and_a_full_disk_do_not_delay_the_vehicle():
    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    vehicle = Recorder()
    release = threading.Event()
    workers = [
        Worker("vehicle", lambda: vehicle, queue=1, stale_s=0.25),
        Worker("blocked", lambda: Recorder(lambda _: release.wait(20)), queue=2),
        Worker("full", lambda: Recorder(full), queue=2),
    ]
    served = server(lambda: (Frame(str(i), i * 10_000_000, IMAGE) for i in range(200)), workers)
    threading.Timer(3.0, release.set).start()
    served.serve()
    health = served.health()
    assert health["sinks"]["vehicle"]["sent"] >= 100  # two seconds' frames, while the blocked one takes three
    assert health["sinks"]["blocked"]["dropped"] > 100
    assert health["sinks"]["full"]["errors"] >= 1


def test_a_lost_camera_is_opened_again(monkeypatch):
    monkeypatch.setattr("lumidock.app.serve._RETRY_S", 0.05)
    tries = []

    def items():
        tries.append(1)
        yield Frame(str(len(tries)), len(tries), IMAGE)
        if len(tries) < 4:
            raise OSError("the cable is out")
        served.stop.set()

    seen = Recorder()
    served = server(items, [Worker("w", lambda: seen, queue=9)], live=True)
    served.serve()
    assert len(tries) == 4
    assert served.camera.reconnects >= 3
    assert [fix.frame for _, fix, _ in seen.got][:3] == ["1", "1.2", "2.3"]


def test_a_recording_is_shown_at_its_own_pace_and_again(monkeypatch):
    """A busy machine may drop pictures, never show one early."""
    monkeypatch.setattr("lumidock.app.serve._LOOP_PAUSE_NS", 50_000_000)
    last_ns, began = 350_000_000, time.monotonic()
    shown_s = {}
    frames = [Frame(str(i), i * 50_000_000, IMAGE) for i in range(4)]

    class Watching(Recorder):
        def add(self, item, fix, latency_us):
            super().add(item, fix, latency_us)
            shown_s.setdefault(fix.t_ns, time.monotonic() - began)
            if fix.t_ns >= last_ns:
                served.stop.set()

    served = server(lambda: iter(frames), [Worker("w", Watching, queue=9)], loop=True)
    guard = threading.Timer(60.0, served.stop.set)
    guard.start()
    served.serve()
    guard.cancel()
    assert max(shown_s) >= last_ns  # the second time through
    assert list(shown_s) == sorted(shown_s)
    assert all(t_ns % 50_000_000 == 0 and seconds >= t_ns * 1e-9 for t_ns, seconds in shown_s.items())


# The health page


@pytest.fixture
def page():
    page = HealthPage("127.0.0.1", 0, lambda: {"ok": False, "camera": {"problem": "<b>lost</b>"}, "rate": 1 / 3})
    yield page
    page.close()


def get(page, path):
    with urllib.request.urlopen(f"http://127.0.0.1:{page.port}{path}", timeout=10) as answer:
        return answer.read().decode()


def test_the_health_is_told_as_json(page):
    for path in ("/", "/health.json"):
        assert json.loads(get(page, path)) == {"ok": False, "camera": {"problem": "<b>lost</b>"}, "rate": 1 / 3}
    with pytest.raises(urllib.error.HTTPError, match="404"):
        get(page, "/../../etc/passwd")


def test_garbage_floods_and_slow_clients_do_not_stop_the_page(page, rng):
    held = []
    for content in [b"\xff" * 70_000, b"GET / HTTP/1.1\r\n" + b"a: b\r\n" * 5000, rng.bytes(10_000), b"", b"GET"]:
        client = socket.create_connection(("127.0.0.1", page.port), timeout=5)
        held.append(client)
        with suppress(OSError):
            client.sendall(content)
    start = time.monotonic()
    assert json.loads(get(page, "/health.json"))["ok"] is False
    assert time.monotonic() - start < 9.0
    for client in held:
        client.close()
