"""Commands that are killed, interrupted, or whose output nobody takes."""

import json
import os
import signal
from pathlib import Path

import pytest
from commandline import PAPER, PLAIN, fixes, start, wait_for
from test_run import simulate


@pytest.fixture(scope="module")
def long(tmp_path_factory):
    """Bare detections that take some ten seconds to run."""
    return simulate(tmp_path_factory.mktemp("long"), "path.frame_interval_s=0.001", bare=True)


def whole_rows(folder):
    """Number of rows of fixes.csv, all of them whole."""
    content = (folder / "fixes.csv").read_text()
    assert content.endswith("\n")
    assert len({line.count(",") for line in content.splitlines()}) == 1
    return content.count("\n") - 1


def stopped(folder, long, number):
    """A run stopped by a signal after some rows: its process."""
    process = start("run", long, *PAPER, "--out", folder)
    wait_for(lambda: (folder / "fixes.csv").exists() and (folder / "fixes.csv").read_text().count("\n") > 20)
    os.killpg(process.pid, number)
    return process, *process.communicate(timeout=30)


def test_a_killed_run_leaves_whole_rows(lumidock, long, tmp_path):
    process, _, _ = stopped(tmp_path / "run", long, signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    count = whole_rows(tmp_path / "run")
    assert 20 <= count < 1501
    assert json.loads((tmp_path / "run" / "run.json").read_text())["counts"]["finished"] is False
    assert [row["frame"] for row in fixes(tmp_path / "run")] == [f"{i:06d}" for i in range(count)]
    code, out, _ = lumidock("eval", tmp_path / "run", long, "--json")
    assert (code, json.loads(out)["frames"]) == (0, count)


def test_an_interrupted_run_leaves_valid_files(lumidock, long, tmp_path):
    process, out, err = stopped(tmp_path / "run", long, signal.SIGINT)
    assert (process.returncode, out) == (130, "")
    assert err.splitlines()[-1] == (  # above it perhaps progress, on a slow machine
        f"lumidock: interrupted; {tmp_path / 'run'} holds a complete row for every frame so far; `run` with --force "
        "begins again"
    )
    counts = json.loads((tmp_path / "run" / "run.json").read_text())["counts"]
    assert 20 <= counts["frames"] == whole_rows(tmp_path / "run") < 1501
    assert counts["finished"] is False
    assert lumidock("eval", tmp_path / "run", long)[0] == 0


def test_an_interrupted_simulation_can_be_done_again(lumidock, tmp_path):
    process = start("sim", "approach", "--out", tmp_path / "sim")
    wait_for(lambda: len(list((tmp_path / "sim").glob("frames/*"))) > 2)
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=30)
    assert (process.returncode, out) == (130, "")
    assert err.splitlines()[-1].startswith(f"lumidock: interrupted; {tmp_path / 'sim'} holds an incomplete sequence")
    assert lumidock("run", tmp_path / "sim", "--out", tmp_path / "run")[0] == 2
    assert lumidock("sim", "trials", "--detections", "--out", tmp_path / "sim", "--force")[0] == 0


def group(pid):
    """Processes of the group of a process that has begun its own."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[2]) == pid and fields[0] != "Z":
            found.append(int(stat.parent.name))
    return found


@pytest.mark.parametrize(
    ("command", "number"), [("serve", signal.SIGTERM), ("run", signal.SIGTERM), ("sim", signal.SIGKILL)]
)
def test_a_rendering_that_is_ended_leaves_no_process_and_no_temporary_folder(tmp_path, command, number):
    (tmp_path / "tmp").mkdir()
    environment = PLAIN | {"TMPDIR": str(tmp_path / "tmp")}
    words = {
        "serve": ["sim:approach", "--health-port", "0"],
        "run": ["sim:approach", "--out", tmp_path / "run"],
        "sim": ["approach", "--out", tmp_path / "sim", "--workers", "2"],
    }
    process = start(command, *words[command], env=environment)
    wait_for(lambda: len(list(tmp_path.rglob("frames/*"))) > 2)
    os.kill(process.pid, number)
    out, err = process.communicate(timeout=30)
    assert (process.returncode, out) == (143 if number == signal.SIGTERM else -number, "")
    assert "Traceback" not in err
    wait_for(lambda: not group(process.pid), 10)
    if number == signal.SIGTERM:
        assert list((tmp_path / "tmp").iterdir()) == []


@pytest.mark.parametrize("words", [["--help"], ["run", "--help"], ["eval", "RUN", "TRUTH"]], ids=" ".join)
def test_a_closed_pipe_is_no_traceback(earlier, bare, words):
    names = {"RUN": earlier, "TRUTH": bare}
    reading, writing = os.pipe()
    os.close(reading)
    process = start(*(names.get(word, word) for word in words), stdout=writing)
    os.close(writing)
    assert process.communicate(timeout=30)[1] == ""
    assert process.returncode == 1


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_a_full_disk_behind_the_output_is_one_line():
    with open("/dev/full", "w") as full:
        process = start("--help", stdout=full)
        assert process.communicate(timeout=30)[1] == "lumidock: file system: No space left on device\n"
    assert process.returncode == 2
