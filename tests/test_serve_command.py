"""`lumidock serve` as a process: files, signals, full disks, garbage on its ports."""

import json
import os
import signal
import socket
import subprocess
import time
import urllib.error
import urllib.request
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import zenoh
from commandline import LUMIDOCK, NO_DISTORTION, VEHICLE, fixes, free_port, serve, wait_for
from test_run import simulate

from lumidock.datatypes import Frame
from lumidock.evaluation.metrics import evaluate
from lumidock.report import report
from lumidock.report.moments import images_of
from lumidock.report.view import load_run
from lumidock.streams.sources import open_source


def rows(folder):
    return [{k: v for k, v in row.items() if k != "latency_us"} for row in fixes(folder)]


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    """Seven frames, a quarter of a second apart."""
    folder = simulate(tmp_path_factory.mktemp("sequence"))
    (folder / "vehicle.yaml").write_text(VEHICLE)
    return folder


def test_live_gives_the_fixes_of_a_replay(sequence, tmp_path, listener):
    run = [LUMIDOCK, "run", str(sequence), "--out", str(tmp_path / "run")]
    assert subprocess.run(run, capture_output=True).returncode == 0
    mavlink = ("--vehicle", sequence / "vehicle.yaml", "--mavlink", f"127.0.0.1:{listener.port}")
    served = serve(sequence, "--out", tmp_path / "live", *mavlink, "--record", tmp_path / "live.mcap")
    out, err = served.communicate(timeout=60)
    assert (served.returncode, err) == (0, ""), out
    assert rows(tmp_path / "live") == rows(tmp_path / "run")
    poses = {"VISION_POSITION_ESTIMATE": "usec", "ODOMETRY": "time_usec"}
    found = [m for m in listener.read() if m.get_type() in poses]
    valid = [row for row in rows(tmp_path / "run") if row["valid"] == "1" and row["status"] != "coasting"]
    assert [getattr(m, poses[m.get_type()]) for m in found] == [int(row["t_ns"]) // 1000 for row in valid]
    for message, row in zip(found, valid, strict=True):
        assert abs(-message.x - float(row["z_m"]) - 0.8) < 0.1
    live, replayed = (json.loads((tmp_path / name / "run.json").read_text()) for name in ("live", "run"))
    assert set(replayed) <= set(live)
    for name in ("method", "cold", "source", "inputs_sha256", "config"):
        assert live[name] == replayed[name]
    for name in set(replayed["counts"]) - {"latency_us"}:
        assert live["counts"][name] == replayed["counts"][name]
    assert set(live["counts"]["latency_us"]) == {"p50", "p95", "p99", "max"}
    assert live["counts"]["camera"]["dropped"] == 0
    recorded = [item.t_ns for item in open_source(tmp_path / "live.mcap").items()]
    assert recorded == [int(row["t_ns"]) for row in rows(tmp_path / "run")]


def test_sigterm_ends_it_in_good_order(sequence, tmp_path):
    served = serve(sequence, "--loop", "--out", tmp_path / "live", "--record", tmp_path / "live.mcap")
    wait_for(lambda: json.loads(urllib.request.urlopen(served.url + "health.json").read())["fixes"]["frames"] >= 3)
    served.send_signal(signal.SIGTERM)
    out, err = served.communicate(timeout=20)
    assert (served.returncode, err) == (0, ""), out
    assert len(rows(tmp_path / "live")) >= 3
    assert (tmp_path / "live.mcap").read_bytes().endswith(b"\x89MCAP0\r\n")


def test_a_recording_that_was_shown_twice_is_evaluated_and_reported(sequence, tmp_path):
    served = serve(sequence, "--loop", "--out", tmp_path / "live")
    wait_for(lambda: json.loads(urllib.request.urlopen(served.url + "health.json").read())["fixes"]["frames"] >= 10)
    served.terminate()
    served.communicate(timeout=20)
    table = rows(tmp_path / "live")
    assert any(row["frame"].startswith("1.") for row in table)
    result = evaluate(tmp_path / "live", sequence)
    assert result["frames"] == sum(row["frames"] for row in result["by_true_z"]) == len(table)
    assert result["hazardous"]["valid"]["any"] == 0
    assert sum(row["frames"] for row in result["by_true_z"]) == len(table)
    view = load_run(tmp_path / "live", sequence)
    assert np.isfinite(view.true_position).all()
    assert view.visible.any(axis=1).all()
    (shown,) = images_of(view, [(len(table) - 1, "last")])
    assert shown.jpeg_base64
    assert "With truth" in report([tmp_path / "live"], [sequence])


def records(folder):
    return [word for kind in ("mcap", "mp4") for word in ("--record", folder / f"live.{kind}")]


def killed(sequence, folder, seconds):
    """Kill a server after some seconds; returns what was in its files, and what its health had told before."""
    served = serve(sequence, "--loop", "--out", folder / "live", *records(folder))
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
    described = json.loads((folder / "live" / "run.json").read_text())
    assert (described["live"], described["counts"]["finished"]) == (True, False)
    assert described["counts"]["frames"] >= len(table) - 5  # a second old at most
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
    served = serve(sequence, "--loop", "--force", "--record", tmp_path / "full.mcap", *mavlink)

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


def test_a_port_that_is_taken_is_one_line(sequence):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        command = [LUMIDOCK, "serve", str(sequence), "--health-port", port]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert f"--health-port {port}: cannot listen on 127.0.0.1: Address already in use" in done.stderr


def listening(pid):
    """Addresses, as the kernel writes them, of the sockets that a process listens on."""
    tables = [Path(f"/proc/{pid}/net/{name}").read_text().splitlines()[1:] for name in ("tcp", "tcp6")]
    sockets = [line.split() for table in tables for line in table]
    files = {os.readlink(path) for path in Path(f"/proc/{pid}/fd").iterdir() if path.is_symlink()}
    return [line[1] for line in sockets if line[3] == "0A" and f"socket:[{line[9]}]" in files]


def test_everything_listens_on_this_machine_only(sequence):
    served = serve(sequence, "--loop", "--foxglove", "--foxglove-port", "0", "--zenoh", "tcp/127.0.0.1:1")
    try:
        time.sleep(1.0)
        mine = listening(served.pid)
        assert len(mine) >= 2
        assert all(address.startswith("0100007F") for address in mine)
    finally:
        served.terminate()
        served.communicate(timeout=20)


def test_a_zenoh_session_without_a_router_is_said_and_its_coming_noticed(sequence):
    port = free_port()
    served = serve(sequence, "--loop", "--zenoh", f"tcp/127.0.0.1:{port}")

    def problem():
        health = json.loads(urllib.request.urlopen(served.url + "health.json").read())
        return health["sinks"]["zenoh"]["problem"]

    wait_for(lambda: "no zenoh router or peer answers" in problem())
    config = zenoh.Config()
    for key, value in {"mode": "router", "listen/endpoints": [f"tcp/127.0.0.1:{port}"]}.items():
        config.insert_json5(key, json.dumps(value))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config):
        wait_for(lambda: not problem())
    served.terminate()
    _, err = served.communicate(timeout=20)
    assert "lumidock: warning: zenoh: no zenoh router or peer answers at tcp/127.0.0.1" in err


def attack(sequence, folder, first, page):
    """A second server after the folder and the ports of the first: refused in one line, with nothing touched."""
    port = page.rstrip("/").rpartition(":")[2]
    for more in (("--health-port", port), ("--health-port", "0", "--force"), ("--health-port", port, "--force")):
        words = ["serve", str(sequence), "--out", str(folder / "live"), *more]
        before = first.poll()
        done = subprocess.run([LUMIDOCK, *words], capture_output=True, text=True, timeout=60)
        assert before is None
        assert (done.returncode, done.stdout) == (2, ""), done.stderr
        assert len([line for line in done.stderr.splitlines() if not line.startswith(NO_DISTORTION)]) == 1, done.stderr


def check_attacked(sequence, folder, seconds):
    """Kill a server that another one attacks; every row that its health had told of is there, and nobody else's."""
    served = serve(sequence, "--loop", "--out", folder / "live")
    attack(sequence, folder, served, served.url)
    time.sleep(seconds)
    frames = json.loads(urllib.request.urlopen(served.url + "health.json").read())["fixes"]["frames"]
    served.kill()
    served.communicate()
    table = rows(folder / "live")
    assert len(table) >= frames - 4
    names = [row["frame"] for row in table]
    assert len(set(names)) == len(names)
    assert all(row["status"] and None not in row for row in table)
    again = serve(sequence, "--out", folder / "live", "--force")
    _, err = again.communicate(timeout=60)
    assert (again.returncode, "Traceback" in err) == (0, False)
    assert [row["frame"] for row in rows(folder / "live")] == [f"{k:06d}" for k in range(7)]


def test_a_second_server_touches_nothing_of_the_first(sequence, tmp_path):
    check_attacked(sequence, tmp_path, 0.5)


def test_garbage_and_floods_on_every_port_are_borne(sequence, rng, listener):
    port = free_port()
    mavlink = ("--vehicle", sequence / "vehicle.yaml", "--mavlink", f"127.0.0.1:{listener.port}")
    served = serve(sequence, "--loop", "--foxglove", "--foxglove-port", port, *mavlink)
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
