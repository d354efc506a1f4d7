"""`run` of several recordings: the same rows as one by one, whatever fails, is killed or is asked for again."""

import json
import shutil
import time
from dataclasses import replace

import pytest
from commandline import fixes, start
from test_run import simulate

from lumidock.cli.recordings import Job, RunOptions, jobs_of, run_job

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


@pytest.fixture(scope="module")
def one_by_one(recordings, tmp_path_factory):
    """Rows of each recording on its own, in this process; None for the one that is refused."""
    out, found = tmp_path_factory.mktemp("single"), {}
    for name in NAMES:
        outcome = run_job(Job(str(recordings / name), out / name, RunOptions()))
        assert bool(outcome.error) == (name == DAMAGED)
        found[name] = None if outcome.error else rows(out / name)
    return found


def is_finished(run):
    try:
        return json.loads((run / "run.json").read_text())["counts"]["finished"]
    except FileNotFoundError:
        return False


def test_many_over_two_workers_killed_and_resumed_give_the_rows_of_one_by_one(
    lumidock, recordings, one_by_one, tmp_path
):
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
    again = start(*words)
    _, err = again.communicate(timeout=300)
    assert again.returncode == 2
    assert err.splitlines()[-1].startswith(f"lumidock: {DAMAGED}: ")
    assert "Traceback" not in err
    for name, wanted in one_by_one.items():
        assert (rows(out / name) if (out / name / "fixes.csv").exists() else None) == wanted
    assert before == {name: (out / name / "fixes.csv").stat().st_mtime_ns for name in finished}
    found = json.loads(lumidock("eval", out, "--json")[1])
    assert [row["run"] for row in found] == [name for name in NAMES if name != DAMAGED]
    assert [row["frames"] for row in found] == [len(one_by_one[row["run"]]) for row in found]


def test_truth_beside_the_recordings_is_found_and_its_lack_leaves_a_row(lumidock, recordings, tmp_path):
    for name in "ab":
        shutil.copytree(recordings / name, tmp_path / name)
        assert not run_job(Job(str(tmp_path / name), tmp_path / "runs" / name, RunOptions())).error
    (tmp_path / "b" / "truth.csv").unlink()
    code, out, _ = lumidock("eval", tmp_path / "runs")
    head, first, second = out.splitlines()
    assert code == 0
    assert head.split()[:3] == ["run", "method", "frames"]
    assert (first.split()[5], second.split()[5]) == ("0", "-")


def test_a_finished_run_is_kept_and_another_in_the_way_is_not_overwritten(recordings, tmp_path):
    job = Job(str(recordings / "a"), tmp_path / "a", RunOptions())
    first = run_job(job)
    before = rows(job.out)
    again = run_job(job)
    assert (first.kept, again.kept, again.counts) == (False, True, first.counts)
    cold = replace(job, options=RunOptions(cold=True))
    for other in (cold, replace(job, options=RunOptions(delay_ms=5.0)), replace(job, source=str(recordings / "b"))):
        assert "holds something else than this run; give --force" in run_job(other).error
    assert rows(job.out) == before
    assert not run_job(replace(cold, force=True)).error
    assert {row["status"] for row in rows(job.out)} <= {"none", "acquired"}


def test_a_run_that_was_cut_short_is_done_again(recordings, one_by_one, tmp_path):
    job = Job(str(recordings / "a"), tmp_path / "a", RunOptions())
    run_job(job)
    described = json.loads((job.out / "run.json").read_text())
    described["counts"]["finished"] = False
    (job.out / "run.json").write_text(json.dumps(described))
    (job.out / "fixes.csv").write_text("cut")
    assert not run_job(job).kept
    assert rows(job.out) == one_by_one["a"]


def test_recordings_of_the_same_name_have_folders_of_their_own(tmp_path):
    sources = [str(tmp_path / place / "dive.mcap") for place in "xyz"]
    jobs = jobs_of([*sources, "dive.mp4"], tmp_path, RunOptions(), force=False)
    assert list(jobs) == ["dive", "dive-2", "dive-3", "dive-4"]
    assert [job.source for job in jobs.values()] == [*sources, "dive.mp4"]
    assert [job.out.name for job in jobs.values()] == list(jobs)


def test_a_simulation_among_them_is_refused(lumidock, tmp_path):
    code, _, err = lumidock("run", "sim:approach", "a.mcap", "--out", tmp_path / "runs")
    assert (code, err.count("\n")) == (2, 1)
    assert "campaign" in err
    assert not (tmp_path / "runs").exists()
