"""`run` of several recordings: the same rows as one by one, whatever fails, is killed or is asked for again."""

import json
import shutil
import subprocess
import time

import pytest
from commandline import LUMIDOCK, fixes, start
from test_run import simulate

from lumidock.cli.recordings import RunOptions, jobs_of

NAMES = tuple("abcdefghij")
DAMAGED = "d"


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Ten sequences of bare detections, the table of stamps of one damaged."""
    folder = tmp_path_factory.mktemp("recordings")
    for number, name in enumerate(NAMES):
        simulate(folder / name, f"path.start_z_m={4.0 + 0.1 * number}", bare=True)
    (folder / DAMAGED / "timestamps.csv").write_bytes(b"\xff\xfe nonsense")
    return folder


def rows(run):
    return [{name: value for name, value in row.items() if name != "latency_us"} for row in fixes(run)]


def lumidock(*words):
    return subprocess.run(list(map(str, [LUMIDOCK, *words])), capture_output=True, text=True, timeout=300)


@pytest.fixture(scope="module")
def one_by_one(recordings, tmp_path_factory):
    """Rows of each recording on its own; None for the one that is refused."""
    out, found = tmp_path_factory.mktemp("single"), {}
    for name in NAMES:
        done = lumidock("run", recordings / name, "--out", out / name)
        assert done.returncode == (2 if name == DAMAGED else 0), done.stderr
        found[name] = None if name == DAMAGED else rows(out / name)
    return found


def is_finished(run):
    try:
        return json.loads((run / "run.json").read_text())["counts"]["finished"]
    except FileNotFoundError:
        return False


def test_many_over_two_workers_killed_and_resumed_give_the_rows_of_one_by_one(recordings, one_by_one, tmp_path):
    out = tmp_path / "runs"
    words = ["run", *(str(recordings / name) for name in NAMES), "--out", str(out), "--workers", "2"]
    process, end = start(*words), time.monotonic() + 120
    while sum((out / name / "run.json").exists() for name in NAMES) < 3 and time.monotonic() < end:
        time.sleep(0.005)
    process.kill()
    process.communicate()
    finished = {name for name in NAMES if is_finished(out / name)}
    assert finished
    before = {name: (out / name / "fixes.csv").stat().st_mtime_ns for name in finished}
    done = lumidock(*words)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith(f"lumidock: {DAMAGED}: ")
    assert "Traceback" not in done.stderr
    for name, wanted in one_by_one.items():
        assert (rows(out / name) if (out / name / "fixes.csv").exists() else None) == wanted
    assert before == {name: (out / name / "fixes.csv").stat().st_mtime_ns for name in finished}
    found = json.loads(lumidock("eval", out, "--json").stdout)
    assert [row["run"] for row in found] == [name for name in NAMES if name != DAMAGED]
    assert [row["frames"] for row in found] == [len(one_by_one[row["run"]]) for row in found]


def test_truth_beside_the_recordings_is_found_and_its_lack_leaves_a_row(recordings, tmp_path):
    for name in "ab":
        shutil.copytree(recordings / name, tmp_path / name)
    (tmp_path / "b" / "truth.csv").unlink()
    assert lumidock("run", tmp_path / "a", tmp_path / "b", "--out", tmp_path / "runs", "--workers", 1).returncode == 0
    head, first, second = lumidock("eval", tmp_path / "runs").stdout.splitlines()
    assert head.split()[:3] == ["run", "method", "frames"]
    assert (first.split()[5], second.split()[5]) == ("0", "-")


def test_another_run_in_the_way_is_not_overwritten(recordings, tmp_path):
    command = ["run", recordings / "a", recordings / "b", "--out", tmp_path / "runs", "--workers", 1]
    assert lumidock(*command).returncode == 0
    before = rows(tmp_path / "runs" / "a")
    done = lumidock(*command, "--cold")
    assert done.returncode == 2
    assert done.stderr.count("holds something else than this run; give --force") == 2
    assert rows(tmp_path / "runs" / "a") == before
    assert lumidock(*command, "--cold", "--force").returncode == 0
    assert {row["status"] for row in rows(tmp_path / "runs" / "a")} <= {"none", "acquired"}


def test_recordings_of_the_same_name_have_folders_of_their_own(tmp_path):
    sources = [str(tmp_path / place / "dive.mcap") for place in "xyz"]
    jobs = jobs_of([*sources, "dive.mp4"], tmp_path, RunOptions(), force=False)
    assert list(jobs) == ["dive", "dive-2", "dive-3", "dive-4"]
    assert [job.source for job in jobs.values()] == [*sources, "dive.mp4"]
    assert [job.out.name for job in jobs.values()] == list(jobs)


def test_a_simulation_among_them_is_refused(tmp_path):
    done = lumidock("run", "sim:approach", "a.mcap", "--out", tmp_path / "runs")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "campaign" in done.stderr
    assert not (tmp_path / "runs").exists()
