"""Two servers after the same folder and ports, and every way to end the one that got them."""

import json
import os
import signal
import subprocess
import time
import urllib.request
from contextlib import suppress
from pathlib import Path

import pytest
from commandline import LUMIDOCK, NO_DISTORTION, fixes, free_port, wait_for
from test_run import simulate

FATES = (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
WANTED = ("folder", "port", "folder and ports")


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    """Seven frames, a quarter of a second apart."""
    return simulate(tmp_path_factory.mktemp("sequence"))


class Pair:
    """Two servers that want the same folder, the same port or both; whoever comes first has it."""

    def __init__(self, sequence, folder, wanted):
        self.sequence, self.folder, self.wanted = sequence, folder, wanted
        self.port = free_port()

    def start(self, number):
        """The first or second server, in a session of its own."""
        port = 0 if self.wanted == "folder" else self.port
        out = self.folder / (f"live-{number}" if self.wanted == "port" else "live")
        words = ["--out", out, "--force", "--health-port", port]
        pipes = {"stdout": subprocess.PIPE, "stderr": (self.folder / f"stderr-{number}").open("w"), "text": True}
        command = [LUMIDOCK, "serve", str(self.sequence), "--loop", *map(str, words)]
        environment = os.environ | {"TMPDIR": str(self.folder / "temporary")}
        process = subprocess.Popen(command, start_new_session=True, env=environment, **pipes)
        process.out, process.said = out, self.folder / f"stderr-{number}"
        return process


def left_of(session):
    """Processes of a session that still run."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            state, _, _, of = path.read_text().rpartition(")")[2].split()[:4]
            found += [path.parent.name] if int(of) == session and state != "Z" else []
    return found


def health(page):
    return json.loads(urllib.request.urlopen(page + "health.json", timeout=30).read())


def lines(process):
    """What a server said on standard error, without that a simulated camera has no distortion."""
    return [line for line in process.said.read_text().splitlines() if not line.startswith(NO_DISTORTION)]


def is_refused(process):
    """Whether a server ended in one line that says why, before it served."""
    assert (process.wait(60), process.stdout.read()) == (2, ""), lines(process)
    assert len(lines(process)) == 1
    return "another process is writing" in lines(process)[0] or "Address already in use" in lines(process)[0]


def winner_of(first, second):
    """The server that serves and its page, after the other one was refused."""
    wait_for(lambda: first.poll() is not None or second.poll() is not None)
    winner, loser = (first, second) if second.poll() is not None else (second, first)
    assert is_refused(loser)
    return winner, winner.stdout.readline().split()[-1].partition("#")[0]


def check_ended(process, fate, written):
    """Every row that was written is there, whole and once; nothing runs any more and nothing was thrown."""
    process.send_signal(fate)
    assert process.wait(30) == (-fate if fate == signal.SIGKILL else 0), lines(process)
    process.stdout.close()
    assert not lines(process)
    assert not left_of(process.pid)
    table = fixes(process.out)
    assert len(table) >= written
    assert [row["frame"] for row in table[:7]] == [f"{k:06d}" for k in range(7)][: len(table)]
    assert len({row["frame"] for row in table}) == len(table)
    assert all(row["status"] and None not in row for row in table)
    described = json.loads((process.out / "run.json").read_text())
    assert described["counts"]["finished"] is (fate != signal.SIGKILL)


def check_attacked(pair, fate, apart_s, served_s):
    """One start of two servers `apart_s` apart, and the end of the one that came first, `served_s` after the other."""
    first = pair.start(1)
    time.sleep(apart_s)
    second = pair.start(2)
    try:
        winner, page = winner_of(first, second)
        time.sleep(served_s)
        written = health(page)["sinks"][winner.out.name]["sent"]
        check_ended(winner, fate, written)
    finally:
        for process in (first, second):
            process.kill()
            process.wait()
            process.stdout.close()


@pytest.mark.parametrize(("fate", "apart_s"), [(signal.SIGKILL, 0.0), (signal.SIGTERM, 0.5)])
def test_of_two_servers_one_serves_and_the_other_is_refused(sequence, tmp_path, fate, apart_s):
    (tmp_path / "temporary").mkdir()
    check_attacked(Pair(sequence, tmp_path, "folder and ports"), fate, apart_s, 0.7)


@pytest.mark.slow
@pytest.mark.parametrize("part", range(5))
def test_two_hundred_starts_and_ends_under_attack(sequence, tmp_path, rng, part):
    """The folders of one server after another are the same, so that each start finds what the last one left."""
    (tmp_path / "temporary").mkdir()
    for number in range(40):
        wanted, fate = WANTED[number % 3], FATES[number // 3 % 4]
        apart_s, served_s = rng.uniform(0.0, 2.0), rng.uniform(0.0, 1.2)
        print(f"{part}.{number}: {wanted}, {fate.name}, {apart_s:.3f} s, {served_s:.3f} s")  # noqa: T201
        check_attacked(Pair(sequence, tmp_path, wanted), fate, apart_s, served_s)
    assert len(list((tmp_path / "temporary").iterdir())) <= 1  # the last one's
