import csv
import errno
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import assert_close, numeric_jacobian, transforms
from hypothesis import given, settings
from pymavlink.dialects.v20 import common
from scipy.spatial.transform import Rotation
from test_run import simulate

from lumidock.datatypes import Fix, Frame
from lumidock.geometry import se3_exp, se3_inverse
from lumidock.serve import Camera, Done, Newest, Server, Taken, Worker
from lumidock.streams.healthpage import HealthPage
from lumidock.streams.mavlink import R_LOCAL_DOCK, Mavlink, covariance_of_body, estimate, roll_pitch_yaw
from lumidock.streams.sources import open_source
from lumidock.vehicle import Vehicle

LUMIDOCK = str(Path(sys.executable).with_name("lumidock"))
VEHICLE = "schema: 1\nT_body_cam: {translation: [0.8, 0, 0.1], quat_xyzw: [-0.5, 0.5, -0.5, 0.5]}\n"
AHEAD = np.array([[0.0, 0, 1, 0.8], [-1, 0, 0, 0], [0, -1, 0, 0.1], [0, 0, 0, 1]])  # T_body_cam of that file
IMAGE = np.zeros((8, 8), np.uint8)


def made(fix=None, item=None, at_s=None):
    T = np.diag([1.0, -1, -1, 1])
    item = item or Frame("a", 5, IMAGE)
    return Done(
        Taken(item, time.monotonic() if at_s is None else at_s), fix or Fix("a", 5, "tracking", "rear", T_dock_cam=T), 7
    )


def wait_for(condition, seconds=20.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.005)


# MAVLink


def test_head_on_the_body_looks_along_the_local_frame():
    T_dock_cam = np.diag([1.0, -1, -1, 1])
    T_dock_cam[:3, 3] = [0.3, 0.2, 6.0]
    message = estimate(
        common.MAVLink(None), Fix("a", 7_000, "tracking", "rear", T_dock_cam=T_dock_cam), Vehicle(AHEAD), 3
    )
    # the camera is 0.8 m before and 0.1 m above the body; right of the dock's middle is right, above it is negative
    assert_close([message.x, message.y, message.z], [-6.8, 0.3, -0.1], atol=1e-12)
    assert_close([message.roll, message.pitch, message.yaw], [0, 0, 0], atol=1e-12)
    assert (message.usec, message.reset_counter, np.isnan(message.covariance[0])) == (7, 3, True)


@given(transforms(), transforms(1.0))
def test_position_and_angles_are_those_of_the_body(T_dock_cam, T_body_cam):
    fix = Fix("a", 0, "tracking", "rear", T_dock_cam=T_dock_cam)
    message = estimate(common.MAVLink(None), fix, Vehicle(T_body_cam), 0)
    T_dock_body = T_dock_cam @ np.linalg.inv(T_body_cam)
    assert_close([message.x, message.y, message.z], R_LOCAL_DOCK @ T_dock_body[:3, 3], atol=1e-9)
    wanted = R_LOCAL_DOCK @ T_dock_body[:3, :3] @ np.diag([1, -1, -1])
    found = Rotation.from_euler("ZYX", [message.yaw, message.pitch, message.roll]).as_matrix()
    assert_close(found, wanted, atol=1e-6)


@settings(max_examples=50)
@given(transforms(), transforms(1.0))
def test_the_covariance_is_carried_to_the_body(T_dock_cam, T_body_cam):
    def pose(error):
        moved = T_dock_cam.copy()
        moved[:3, 3] += error[:3]
        moved[:3, :3] = se3_exp(np.concatenate([np.zeros(3), error[3:]]))[:3, :3] @ T_dock_cam[:3, :3]
        T_dock_body = moved @ se3_inverse(T_body_cam)
        R = R_LOCAL_DOCK @ T_dock_body[:3, :3] @ np.diag([1, -1, -1])
        return np.concatenate([R_LOCAL_DOCK @ T_dock_body[:3, 3], roll_pitch_yaw(R)])

    _, pitch, yaw = pose(np.zeros(6))[3:]
    if abs(pitch) > 1.2:
        return  # angles are no coordinates there
    J = numeric_jacobian(pose, np.zeros(6))
    if np.abs(J).max() > 100:
        return  # an angle that turns over at pi between two steps
    A = np.arange(36.0).reshape(6, 6) / 36 + np.eye(6)
    lever_dock = (T_dock_cam @ se3_inverse(T_body_cam))[:3, 3] - T_dock_cam[:3, 3]
    found = covariance_of_body(A @ A.T, lever_dock, pitch, yaw)
    np.testing.assert_allclose(found, J @ A @ A.T @ J.T, rtol=1e-4, atol=1e-4)


@pytest.fixture
def listener():
    """A UDP port and a function that reads all MAVLink messages that came to it."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as port:
        port.bind(("127.0.0.1", 0))
        port.setblocking(False)
        link = common.MAVLink(None)

        sender = []

        def read():
            found = []
            while True:
                try:
                    content, address = port.recvfrom(4096)
                except BlockingIOError:
                    return found
                sender[:] = [address]
                found += link.parse_buffer(content) or []

        def peer():
            """Address of who sent last."""
            read()
            return sender[0]

        yield SimpleNamespace(port=port.getsockname()[1], read=read, peer=peer)


def test_only_measured_valid_fixes_are_sent_and_jumps_counted(listener):
    link = Mavlink("127.0.0.1", listener.port, Vehicle(AHEAD))
    T = np.diag([1.0, -1, -1, 1])
    for status in ("acquired", "tracking", "coasting", "acquired", "tracking"):
        link.add(Frame("a", 5, IMAGE), Fix("a", 5, status, "rear", T_dock_cam=T), 7)
    link.add(Frame("a", 5, IMAGE), Fix("a", 5, "tracking", "rear", reason="protection"), 7)
    link.tick()
    link.tick()
    found = listener.read()
    assert [m.get_type() for m in found] == ["VISION_POSITION_ESTIMATE"] * 4 + ["HEARTBEAT"]
    assert [m.reset_counter for m in found[:4]] == [0, 0, 1, 1]
    assert {(m.get_srcSystem(), m.get_srcComponent()) for m in found} == {(1, 197)}
    link.close()


def test_nobody_listening_is_no_error():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as port:
        port.bind(("127.0.0.1", 0))
        free = port.getsockname()[1]
    link = Mavlink("127.0.0.1", free, Vehicle(AHEAD))
    for _ in range(5):
        link.add(*(lambda d: (d.taken.item, d.fix, 7))(made()))
        time.sleep(0.01)
    link.close()


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
        newest.wait_until_idle(0.2)
        assert (time.monotonic() - start < 0.1) == looked_at


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
    worker = Worker("w", lambda: sink, queue=5, stale_s=0.25)
    worker.start()
    worker.offer(made(at_s=time.monotonic() - 0.3))
    worker.offer(made())
    worker.finish()
    assert (len(sink.got), worker.stale) == (1, 1)


def test_a_viewer_begins_when_the_vehicle_has_been_told(monkeypatch):
    monkeypatch.setattr("lumidock.serve._AFTER_YOU_S", 0.2)
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
    assert began["vehicle"] - start < 0.2 <= began["viewer"] - start


def test_a_sink_that_hangs_is_left_behind(monkeypatch):
    monkeypatch.setattr("lumidock.serve._CLOSING_S", 0.1)
    worker = Worker("w", lambda: Recorder(lambda _: time.sleep(3)), queue=5)
    worker.start()
    worker.offer(made())
    start = time.monotonic()
    worker.finish()
    assert time.monotonic() - start < 1.0


class Still:
    """A localizer that knows its place."""

    def process(self, frame):
        return Fix(frame.name, frame.t_ns, "tracking", "rear", T_dock_cam=np.diag([1.0, -1, -1, 1]))

    process_detections = process


def server(items, workers, **options):
    stop, newest = threading.Event(), Newest()
    camera = Camera(items, newest, **({"live": False, "loop": False, "stop": stop} | options))
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
    assert health["sinks"]["vehicle"]["sent"] >= 190
    assert health["sinks"]["vehicle"]["frame_to_sent_ms"]["p99"] < 20.0
    assert health["sinks"]["blocked"]["dropped"] > 100
    assert health["sinks"]["full"]["errors"] >= 1


def test_a_lost_camera_is_opened_again(monkeypatch):
    monkeypatch.setattr("lumidock.serve._RETRY_S", 0.05)
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
    monkeypatch.setattr("lumidock.serve._LOOP_PAUSE_NS", 50_000_000)
    seen = Recorder()
    frames = [Frame(str(i), i * 50_000_000, IMAGE) for i in range(4)]
    served = server(lambda: iter(frames), [Worker("w", lambda: seen, queue=9)], loop=True)
    threading.Timer(1.0, served.stop.set).start()  # of which the first garbage collection may take a part
    start = time.monotonic()
    served.serve()
    assert 0.4 < time.monotonic() - start < 3.0
    t_ns = [fix.t_ns for _, fix, _ in seen.got]
    assert (
        t_ns[:8]
        == [0, 50_000_000, 100_000_000, 150_000_000, 200_000_000, 250_000_000, 300_000_000, 350_000_000][: len(t_ns)]
    )
    assert len(t_ns) >= 6


# The health page


@pytest.fixture
def page():
    page = HealthPage("127.0.0.1", 0, lambda: {"ok": False, "camera": {"problem": "<b>lost</b>"}, "rate": 1 / 3})
    yield page
    page.close()


def get(page, path):
    with urllib.request.urlopen(f"http://127.0.0.1:{page.port}{path}", timeout=10) as answer:
        return answer.read().decode()


def test_the_page_says_it_to_people_and_machines(page):
    assert json.loads(get(page, "/health.json"))["rate"] == 1 / 3
    text = get(page, "/")
    assert "NOT ok" in text
    assert "&lt;b&gt;lost" in text
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


# The command


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    """Seven frames, a quarter of a second apart."""
    folder = simulate(tmp_path_factory.mktemp("sequence"))
    (folder / "vehicle.yaml").write_text(VEHICLE)
    return folder


def start(*words):
    command = [LUMIDOCK, "serve", *map(str, words), "--health-port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    process.url = process.stdout.readline().split()[-1]
    return process


def rows(folder):
    with (folder / "fixes.csv").open(newline="") as file:
        return [{k: v for k, v in row.items() if k != "latency_us"} for row in csv.DictReader(file)]


def test_live_gives_the_fixes_of_a_replay(sequence, tmp_path, listener):
    run = [LUMIDOCK, "run", str(sequence), "--out", str(tmp_path / "run")]
    assert subprocess.run(run, capture_output=True).returncode == 0
    mavlink = ("--vehicle", sequence / "vehicle.yaml", "--mavlink", f"127.0.0.1:{listener.port}")
    served = start(sequence, "--out", tmp_path / "live", *mavlink, "--record", tmp_path / "live.mcap")
    out, err = served.communicate(timeout=60)
    assert (served.returncode, err) == (0, ""), out
    assert rows(tmp_path / "live") == rows(tmp_path / "run")
    found = [m for m in listener.read() if m.get_type() == "VISION_POSITION_ESTIMATE"]
    valid = [row for row in rows(tmp_path / "run") if row["valid"] == "1" and row["status"] != "coasting"]
    assert [m.usec for m in found] == [int(row["t_ns"]) // 1000 for row in valid]
    for message, row in zip(found, valid, strict=True):
        assert abs(-message.x - float(row["z_m"]) - 0.8) < 0.1
    recorded = [item.t_ns for item in open_source(tmp_path / "live.mcap").items()]
    assert recorded == [int(row["t_ns"]) for row in rows(tmp_path / "run")]


def test_sigterm_ends_it_in_good_order(sequence, tmp_path):
    served = start(sequence, "--loop", "--out", tmp_path / "live", "--record", tmp_path / "live.mcap")
    wait_for(lambda: json.loads(urllib.request.urlopen(served.url + "health.json").read())["fixes"]["frames"] >= 3)
    served.send_signal(signal.SIGTERM)
    out, err = served.communicate(timeout=20)
    assert (served.returncode, err) == (0, ""), out
    assert len(rows(tmp_path / "live")) >= 3
    assert (tmp_path / "live.mcap").read_bytes().endswith(b"\x89MCAP0\r\n")


def records(folder):
    return [word for kind in ("mcap", "mp4") for word in ("--record", folder / f"live.{kind}")]


def killed(sequence, folder, seconds):
    """Kill a server after some seconds; returns what was in its files, and what its health had told before."""
    served = start(sequence, "--loop", "--out", folder / "live", *records(folder))
    time.sleep(seconds)
    health = json.loads(urllib.request.urlopen(served.url + "health.json").read())
    served.kill()
    served.communicate()
    return health["fixes"]["frames"]


@pytest.mark.parametrize("seconds", [0.3, 1.3])
def test_kill_9_leaves_files_that_can_be_read(sequence, tmp_path, seconds):
    check_killed(sequence, tmp_path, seconds)


def check_killed(sequence, folder, seconds):
    frames = killed(sequence, folder, seconds)
    table = rows(folder / "live")
    assert len(table) >= frames - 4  # at four frames a second
    assert all(row["status"] and None not in row for row in table)
    if frames > 4:
        for kind in ("mcap", "mp4"):
            found = [item for item in open_source(folder / f"live.{kind}").items() if isinstance(item, Frame)]
            assert len(found) >= frames - 4, kind


@pytest.mark.slow
@pytest.mark.parametrize("part", range(5))
def test_kill_9_at_two_hundred_instants(sequence, tmp_path, rng, part):
    for number in range(40):
        folder = tmp_path / str(number)
        folder.mkdir()
        seconds = float(rng.uniform(0.0, 4.0))
        print(f"part {part}, kill {number}: after {seconds:.3f} s")  # noqa: T201  # in the report of a failure
        check_killed(sequence, folder, seconds)


def test_a_full_disk_is_told_and_the_vehicle_still_guided(sequence, tmp_path, listener):
    (tmp_path / "full.mcap").symlink_to("/dev/full")
    mavlink = ("--vehicle", sequence / "vehicle.yaml", "--mavlink", f"127.0.0.1:{listener.port}")
    served = start(sequence, "--loop", "--force", "--record", tmp_path / "full.mcap", *mavlink)

    def health():
        return json.loads(urllib.request.urlopen(served.url + "health.json").read())

    wait_for(lambda: health()["sinks"]["full.mcap"]["errors"] >= 1)
    assert "No space left" in health()["sinks"]["full.mcap"]["problem"]
    sent = health()["sinks"]["mavlink"]["sent"]
    wait_for(lambda: health()["sinks"]["mavlink"]["sent"] > sent)
    served.terminate()
    assert served.wait(20) == 0


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (("--mavlink", "127.0.0.1:14550"), "needs --vehicle"),
        (("--vehicle", "vehicle.yaml", "--mavlink", "14550"), "wanted HOST:PORT"),
        (("--record", "a.doc"), "not one of"),
        (("--rerun", "127.0.0.1"), "wanted rerun"),
        (("--zenoh", "127.0.0.1:7447"), "wanted an endpoint"),
    ],
)
def test_what_cannot_be_served_is_refused(sequence, words, match):
    command = [LUMIDOCK, "serve", ".", *words, "--health-port", "0"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=sequence, timeout=60)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert match in done.stderr


def listening(pid):
    """Addresses, as the kernel writes them, of the sockets that a process listens on."""
    tables = [Path(f"/proc/{pid}/net/{name}").read_text().splitlines()[1:] for name in ("tcp", "tcp6")]
    sockets = [line.split() for table in tables for line in table]
    files = {os.readlink(path) for path in Path(f"/proc/{pid}/fd").iterdir() if path.is_symlink()}
    return [line[1] for line in sockets if line[3] == "0A" and f"socket:[{line[9]}]" in files]


def test_everything_listens_on_this_machine_only(sequence):
    served = start(sequence, "--loop", "--foxglove", "--foxglove-port", "0", "--zenoh", "tcp/127.0.0.1:1")
    try:
        time.sleep(1.0)
        mine = listening(served.pid)
        assert len(mine) >= 2
        assert all(address.startswith("0100007F") for address in mine)
    finally:
        served.terminate()
        served.communicate(timeout=20)


def test_garbage_and_floods_on_every_port_are_borne(sequence, rng, listener):
    port = free_port()
    mavlink = ("--vehicle", sequence / "vehicle.yaml", "--mavlink", f"127.0.0.1:{listener.port}")
    served = start(sequence, "--loop", "--foxglove", "--foxglove-port", port, *mavlink)
    page = int(served.url.rstrip("/").rpartition(":")[2])

    def health():
        return json.loads(urllib.request.urlopen(served.url + "health.json", timeout=30).read())

    def memory_mib():
        return int(Path(f"/proc/{served.pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20

    wait_for(lambda: health()["sinks"]["mavlink"]["sent"] >= 1)
    before, clients = memory_mib(), []
    answers = listener.peer()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as flood:
        for _ in range(3000):
            flood.sendto(rng.bytes(1000), answers)
    for number in range(60):
        with suppress(OSError):
            client = socket.create_connection(("127.0.0.1", port if number % 2 else page), timeout=2)
            clients.append(client)
            client.sendall(rng.bytes(20_000) if number % 3 else b"GET / HTTP/1.1\r\nUpgrade: websocket\r\n")
    for client in clients:
        client.close()
    sent = health()["sinks"]["mavlink"]["sent"]
    wait_for(lambda: health()["sinks"]["mavlink"]["sent"] > sent + 3, 30)
    assert memory_mib() < before + 100.0
    served.terminate()
    out, err = served.communicate(timeout=20)
    assert (served.returncode, "Traceback" in err) == (0, False), out


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]
