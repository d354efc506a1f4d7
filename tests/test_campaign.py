"""Campaigns: nothing is lost on the way, and the table does not depend on how it was made."""

import json
import multiprocessing
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from bench.shipped import CAMERA_FILE, STATION_FILE
from commandline import LUMIDOCK, wait_for

from lumidock.errors import InputError, LumidockError
from lumidock.evaluation import campaign as module
from lumidock.evaluation.campaign import plan, prepare, run_campaign, tabulate
from lumidock.sim.scenario import load_scenario

SMALL = ("missing-1", ("path.count=8",))


# Shards


def small(seeds=(0, 12), methods=("paper",), **kwargs):
    return plan([load_scenario(*SMALL)], methods, seeds, STATION_FILE, CAMERA_FILE, **kwargs)


def finish(campaign, out, **kwargs):
    """The campaign's tables, as bytes."""
    prepare(campaign, out)
    run_campaign(campaign, out, **kwargs)
    tabulate(campaign, out)
    return [(out / name).read_bytes() for name in ("table.json", "table.md")]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The tables of the small campaign, made in this process."""
    return finish(small(), tmp_path_factory.mktemp("whole") / "out", workers=0)


def test_shards_are_blocks_that_a_longer_campaign_has_too():
    short, longer = small((3, 12)), small((3, 21))
    assert [(shard.first, shard.stop) for shard in short.shards] == [(3, 5), (5, 10), (10, 12)]
    assert [(shard.first, shard.stop) for shard in longer.shards] == [(3, 5), (5, 10), (10, 15), (15, 20), (20, 21)]
    assert [shard.key for shard in short.shards[:2]] == [shard.key for shard in longer.shards[:2]]
    assert not {shard.key for shard in short.shards} & {shard.key for shard in small((3, 12), cold=True).shards}


def test_the_table_is_the_same_for_any_number_of_workers(whole, tmp_path):
    assert finish(small(), tmp_path / "one", workers=1) == whole
    assert finish(small(), tmp_path / "two", workers=2) == whole
    table = json.loads(whole[0])
    assert table["rows"][0]["counts"]["frames"] == 12 * 8
    assert table["rows"][0]["counts"]["identified"] == 12 * 8 * 6


def test_a_campaign_takes_up_where_it_was(whole, tmp_path, monkeypatch):
    campaign, made = small(), []
    original = module.run_shard
    prepare(campaign, tmp_path / "out")

    def once(shard):
        if made:
            raise KeyboardInterrupt
        made.append(shard.file)
        return original(shard)

    monkeypatch.setattr(module, "run_shard", once)
    with pytest.raises(KeyboardInterrupt):
        run_campaign(campaign, tmp_path / "out", workers=0)
    with pytest.raises(LumidockError, match="is not there"):
        tabulate(campaign, tmp_path / "out")
    again = []
    monkeypatch.setattr(module, "run_shard", lambda shard: again.append(shard.file) or original(shard))
    assert finish(small(), tmp_path / "out", workers=0) == whole
    assert len(again) == 2
    assert not set(again) & set(made)


def test_a_shard_that_was_cut_off_is_made_again(whole, tmp_path):
    assert finish(small(), tmp_path / "out", workers=0) == whole
    file = next((tmp_path / "out" / "shards").iterdir())
    file.write_bytes(file.read_bytes()[:100])
    assert finish(small(), tmp_path / "out", workers=0) == whole


def test_a_folder_of_another_campaign_is_refused_without_force(tmp_path):
    out = tmp_path / "out"
    prepare(small(), out)
    prepare(small(), out)
    with pytest.raises(InputError, match="another campaign"):
        prepare(small((0, 20)), out)
    for name in ("missing", small().shards[0].file):
        (out / "shards" / f"{name}.json").write_text("{}")
    kept = out / "shards" / small().shards[0].file
    kept.write_text("{}")
    prepare(small((0, 20)), out, force=True)
    assert [path.name for path in (out / "shards").iterdir()] == [kept.name]
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "note.txt").write_text("mine")
    with pytest.raises(InputError, match="--force"):
        prepare(small(), tmp_path / "other")
    with pytest.raises(InputError, match="is a file"):
        prepare(small(), tmp_path / "other" / "note.txt", force=True)


def test_a_worker_that_dies_loses_nothing(whole, tmp_path):
    campaign, killed = small(), []
    prepare(campaign, tmp_path)

    def kill_one(done, _total):
        if done == 1 and not killed:
            victim = multiprocessing.active_children()[0]
            killed.append(victim.pid)
            victim.kill()

    run_campaign(campaign, tmp_path, workers=2, progress=kill_one)
    tabulate(campaign, tmp_path)
    assert killed
    assert [(tmp_path / name).read_bytes() for name in ("table.json", "table.md")] == whole


def deadly(_shard):
    os._exit(3)


def test_workers_that_keep_dying_end_the_campaign(tmp_path, monkeypatch):
    prepare(small(), tmp_path)
    monkeypatch.setattr(module, "run_shard", deadly)
    with pytest.raises(LumidockError, match="workers died 4 times; 3 shards are left"):
        run_campaign(small(), tmp_path, workers=2)


def children(pid):
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs /proc to see the workers")
def test_a_killed_campaign_goes_on_and_leaves_no_workers(tmp_path):
    words = [LUMIDOCK, "campaign", "missing-1", "--set", "path.count=20", "--method", "paper", "--seeds", "0:30"]
    process = subprocess.Popen([*words, "--workers", "2", "--out", tmp_path / "out"], stderr=subprocess.PIPE)
    wait_for(lambda: list((tmp_path / "out").glob("shards/*.json")))
    workers = children(process.pid)
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stderr.close()
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "out" / "shards").glob("*.json")}
    assert 0 < len(kept) < 6
    wait_for(lambda: not any(Path(f"/proc/{pid}/exe").exists() for pid in workers), 20.0)
    assert subprocess.run([*words, "--workers", "2", "--out", tmp_path / "out"], capture_output=True).returncode == 0
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert len(list((tmp_path / "out" / "shards").iterdir())) == 6
    again = subprocess.run([*words, "--out", tmp_path / "out"], capture_output=True, text=True)
    assert "nothing was left to do" in again.stdout
    table = json.loads((tmp_path / "out" / "table.json").read_text())
    assert table["rows"][0]["counts"]["frames"] == 600


def test_an_interrupt_ends_the_campaign_and_says_what_is_left(tmp_path):
    words = (
        "campaign",
        "missing-1",
        "--set",
        "path.count=20",
        "--method",
        "paper",
        "--seeds",
        "0:30",
        "--workers",
        "1",
    )
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "start_new_session": True}
    process = subprocess.Popen([LUMIDOCK, *words, "--out", tmp_path / "out"], **pipes)
    wait_for(lambda: list((tmp_path / "out").glob("shards/*.json")))
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate()
    assert (out, process.returncode) == (b"", 130)
    assert err.splitlines()[-1].endswith(b"holds the finished shards; the same command continues with the others")


@pytest.mark.filterwarnings("ignore")
def test_a_dask_cluster_gives_the_same_table_though_a_worker_is_killed(whole, tmp_path):
    distributed = pytest.importorskip("distributed", reason="dask distributed is not installed")
    with distributed.LocalCluster(2, threads_per_worker=1, dashboard_address=None) as cluster:
        with distributed.Client(cluster, set_as_default=False) as client:
            workers = list(client.run(os.getpid).values())
        killed = []

        def kill_one(done, _total):
            if done == 1 and not killed:
                killed.append(workers[0])
                os.kill(workers[0], signal.SIGKILL)

        prepare(small(), tmp_path)
        run_campaign(small(), tmp_path, cluster=cluster.scheduler_address, progress=kill_one)
        tabulate(small(), tmp_path)
    assert killed
    assert [(tmp_path / name).read_bytes() for name in ("table.json", "table.md")] == whole


# The command


PAPER = ("--method", "paper", "--set", "path.count=4", "--workers", 1)


def test_a_campaign_prints_its_table(lumidock, tmp_path):
    words = ("campaign", "missing-1", "three-lights", "--seeds", "0:2", *PAPER, "--out", tmp_path / "out")
    code, out, err = lumidock(*words)
    assert (code, err) == (0, "")
    assert out.startswith((tmp_path / "out" / "table.md").read_text())
    assert "frames a second and core" in out
    code, out, _ = lumidock(*words, "--json")
    assert (code, json.loads(out)) == (0, json.loads((tmp_path / "out" / "table.json").read_text()))
    rows = json.loads(out)["rows"]
    assert [(row["scenario"], row["counts"]["frames"]) for row in rows] == [("missing-1", 8), ("three-lights", 40)]
    assert "nothing was left to do" in lumidock(*words)[1]


def test_a_campaign_of_faults_has_a_table_of_its_own(lumidock, tmp_path):
    few = ("--set", "path.frame_interval_s=0.5", "--set", "path.start_z_m=12", "--workers", 1)
    code, out, _ = lumidock("campaign", "faults/none", "faults/twin", "--seeds", "0:1", *few, "--out", tmp_path / "out")
    assert code == 0
    rows = [line.strip("| ").split(" | ") for line in out.split("**Avail")[0].splitlines() if "|" in line]
    head = dict(zip(rows[0], rows[2], strict=True))
    assert (head["fault"], head["assumptions"], head["misleading"], head["over level"]) == ("none", "inside", "0", "0")
    assert int(head["frames"]) > 20
    assert rows[3][:2] == ["twin", "outside"]
    table = json.loads((tmp_path / "out" / "table.json").read_text())
    for row in table["rows"]:
        assert row["counts"]["over_level"] >= max(row["counts"].get(f"over_level_{k}", 0) for k in ("lateral", "axial"))


def test_a_scenario_file_and_its_config_are_used(lumidock, tmp_path):
    (tmp_path / "my.yaml").write_text(
        "name: a|b/../c\nabout: x\npath: {kind: draws, count: 3}\nconfig: {paper: {max_detections: 2}}\n"
    )
    words = ("campaign", tmp_path / "my.yaml", "--seeds", "0:1", *PAPER[:2], "--out", tmp_path / "out")
    code, out, _ = lumidock(*words, "--json")
    counts = json.loads(out)["rows"][0]["counts"]
    assert (code, counts["accepted"], counts["reason too_many"]) == (0, 0, 3)
    assert [path.parent for path in tmp_path.rglob("*paper*.json")] == [tmp_path / "out" / "shards"]


def test_cold_and_warm_are_different_campaigns(lumidock, tmp_path):
    words = ("campaign", "three-lights", "--seeds", "0:1", *PAPER, "--out", tmp_path / "out")
    assert lumidock(*words)[0] == 0
    code, _, err = lumidock(*words, "--cold")
    assert (code, err.count("\n")) == (2, 1)
    assert lumidock(*words, "--cold", "--force")[0] == 0
    assert "every frame without history" in (tmp_path / "out" / "table.md").read_text()


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (("nowhere",), "no such scenario; there are any-roll"),
        (("missing-1", "--method", "other"), "no such method"),
        (("missing-1", "--seeds", "3"), "--seeds 3"),
        (("missing-1", "--seeds", "3:3"), "A below B"),
        (("missing-1", "--seeds=-1:3"), "whole numbers"),
        (("missing-1", "--seeds", "0:9999999999"), "--seeds"),
        (("missing-1", "--set", "path.count=0"), "path.count"),
        (("missing-1", "--set", "config.nothing=1"), "missing-1: config: nothing: unknown key"),
        (("missing-1", "--workers", "0"), "--workers"),
        (("missing-1", "--station", "none.yaml"), "none.yaml"),
        (("missing-1", *PAPER[:4], "--cluster", "nonsense://x"), "--cluster"),
        (("missing-1", *PAPER[:2], "--seeds", "0:1", "--set", "path.z_m=0.3", "--set", "path.count=1"), "no pose at"),
        ((), "SCENARIO"),
    ],
)
def test_errors_are_one_line(refusal, tmp_path, words, match):
    assert match in refusal("campaign", *words, "--out", tmp_path / "out")


def test_without_dask_the_extra_is_named(refusal, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    words = ("campaign", "missing-1", *PAPER[:4], "--cluster", "tcp://x:1", "--out", tmp_path / "out")
    assert "lumidock[cluster]" in refusal(*words)
