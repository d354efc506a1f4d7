"""Campaigns: what is counted, that it is counted once, and that nothing is lost on the way."""

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bench.shipped import CAMERA_FILE, STATION_FILE, shipped_camera, shipped_station

from lumidock import campaign as module
from lumidock import cli, trust
from lumidock.campaign import plan, prepare, run_campaign, tabulate
from lumidock.campaign_table import row_of
from lumidock.datatypes import Fix, Guide, Match, Protection
from lumidock.errors import InputError, LumidockError
from lumidock.geometry import bearing_and_range, so3_exp, so3_log
from lumidock.sim.scenario import load_scenario
from lumidock.sim.spots import spot_frames
from lumidock.tally import Run, Tally, guide_claims, pose_claims, rotation_vectors, tally_run

STATION, CAMERA = shipped_station(), shipped_camera()
LUMIDOCK = str(Path(sys.executable).with_name("lumidock"))
SMALL = ("missing-1", ("path.count=8",))


# What is counted


def right(frame, **changes):
    """A fix that says the truth, but for `changes`."""
    T = changes.pop("T_dock_cam", frame.T_dock_cam)
    guide = Guide(*bearing_and_range(frame.T_dock_cam), 0.01, 0.1)
    fix = Fix(frame.detections.frame, frame.detections.t_ns, "acquired", "front", T_dock_cam=T)
    answer = {"match": Match(frame.detections, frame.light), "guide": guide}
    return replace(fix, **(answer | changes))


def nothing(frame):
    return Fix(frame.detections.frame, frame.detections.t_ns, "none", "search", reason="ambiguous")


def moved(frame, xyz=(0, 0, 0), w=(0, 0, 0)):
    T = frame.T_dock_cam.copy()
    T[:3, 3] += xyz
    T[:3, :3] = so3_exp(np.array(w, float)) @ T[:3, :3]
    return T


def a_run(name, answer, *settings, seed=0, **kwargs):
    """A run in which `answer(i, frame)` is the fix of frame i."""
    scenario = load_scenario(name, settings)
    frames = list(spot_frames(scenario, STATION, CAMERA, seed))
    return Run(scenario, seed, frames, [answer(i, frame) for i, frame in enumerate(frames)], **kwargs)


def test_a_method_that_is_always_right_has_no_fault():
    tally = tally_run(a_run("nominal", lambda _, frame: right(frame) if (frame.light >= 0).any() else nothing(frame)))
    counts = tally.counts
    seen = counts["frames"] - counts["frames_blind"]
    assert counts["accepted"] == counts["valid"] == counts["guide"] == seen > 0
    assert counts["named"] > 5 * seen
    assert counts["frames"] == sum(counts[f"frames_{word}"] for word in ("few", "some", "full"))
    faults = ("wrong", "hazardous", "over_level", "stale_v", "stale_g", "never")
    assert not any(count for name, count in counts.items() if name.startswith(faults))
    assert counts["reason ambiguous"] == counts["frames_blind"]
    assert tally.largest["error_lateral"] == 0.0
    assert tally.quantile("level_bearing", 0.5) == pytest.approx(0.01, rel=0.02)


def test_each_kind_of_error_is_hazardous_over_its_limit():
    shifts = {
        "lateral": [{"xyz": (1.1, 0, 0)}, {"xyz": (0.8, 0.8, 0)}],
        "axial": [{"xyz": (0, 0, 1.1)}, {"xyz": (0, 0, -1.1)}],
        "angle": [{"w": (0.0, 0.15, 0.0)}, {"w": (0.1, 0.0, 0.1)}],
    }
    harmless = [{"xyz": (0.6, 0.6, 0.9)}, {"w": (0.07, 0.07, 0.07)}]
    for kind, changes in [*shifts.items(), ("none", harmless)]:
        run = a_run(
            *("missing-1", lambda i, frame, changes=changes: right(frame, T_dock_cam=moved(frame, **changes[i % 2]))),
            *("path.z_m=[8, 10]", "path.count=10"),
        )
        counts = tally_run(run).counts
        hazardous = {name: counts[f"hazardous_{name}"] for name in ("lateral", "axial", "angle")}
        assert hazardous == {name: 10 * (name == kind) for name in hazardous}
        assert counts["hazardous_valid"] == 10 * (kind != "none")
        assert counts["hazardous_guide"] == 0


def test_protection_levels_make_the_limits_stricter_and_are_counted():
    def answer(i, frame):
        shift = (0, 0, -1.1 if i % 2 else -0.9)
        return right(frame, T_dock_cam=moved(frame, shift), protection=Protection(0.1, 1.0, 0.1), covariance=np.eye(6))

    settings = ("path.z_m=[13.5, 13.6]", "path.count=10")
    tally = tally_run(a_run("missing-1", answer, *settings))
    assert tally.counts["hazardous_axial"] == 5  # 1.0 m and not 1.24 m, since it may be below 12 m
    assert {name: tally.counts[f"levels_{name}"] for name in ("lateral", "axial", "angle")} == dict.fromkeys(
        ("lateral", "axial", "angle"), 10
    )
    assert (tally.counts["over_level_axial"], tally.counts["over_level_lateral"]) == (5, 0)
    assert tally.quantile("level_axial", 0.5) == pytest.approx(1.0, rel=0.02)
    assert row_of(tally)["errors"]["axial_m"]["level_over_p95"] == pytest.approx(1.0 / 1.1, rel=0.03)


@pytest.mark.parametrize(
    ("off", "hazardous"), [((0.03, 0.0, 0.0), 1), ((0.0, 0.03, 0.0), 1), ((0, 0, 1.3), 1), ((0.02, 0.01, 0.9), 0)]
)
def test_a_guide_misleads_over_a_bearing_or_a_range_limit(off, hazardous):
    def answer(_, frame):
        x, y, r = bearing_and_range(frame.T_dock_cam)
        return replace(nothing(frame), guide=Guide(x + off[0], y + off[1], r + off[2], 0.01, 0.1), status="acquired")

    counts = tally_run(a_run("missing-1", answer, "path.z_m=[10, 11]", "path.count=10")).counts
    assert counts["hazardous_guide"] == 10 * hazardous
    assert counts["hazardous_valid"] == counts["valid"] == 0
    assert (counts["over_level_bearing"], counts["over_level_range"]) == (10 * any(off[:2]), 10 * (off[2] > 0.1))


def test_near_the_origin_a_guide_has_no_limits():
    def answer(_, frame):
        return replace(nothing(frame), guide=Guide(1.0, 1.0, 30.0, 0.01, 0.1), status="acquired")

    run = a_run("approach", answer, "path.start_z_m=2.5")
    assert tally_run(run).counts["hazardous_guide"] == 0


def test_wrong_names_are_told_from_harmful_coincidences():
    def answer(i, frame):
        light = frame.light.copy()
        light[[0, 1]] = light[[1, 0]]
        return right(frame, match=Match(frame.detections, light)) if i < 4 else right(frame)

    run = a_run("missing-1", answer, "path.count=10")
    counts = tally_run(run).counts
    assert (counts["named"], counts["frames_with_wrong"]) == (60, 4)
    assert (counts["wrong_else"], counts["wrong_coincident"]) == (8, 0)


@pytest.mark.parametrize(("off_px", "coincident"), [(1.4, True), (1.6, False)])
def test_a_stray_where_a_missing_light_would_be_is_a_coincidence(off_px, coincident):
    def answer(_, frame):
        fix = right(frame, match=Match(frame.detections, frame.light.copy()))
        frame.detections.uv[0] = frame.uv[frame.light[0]] + [off_px, 0.0]
        frame.light[0] = -1
        return fix

    counts = tally_run(a_run("missing-1", answer, "path.count=10")).counts
    assert counts["frames_with_wrong"] == 10
    assert (counts["wrong_coincident"], counts["wrong_else"]) == (10 * coincident, 10 * (not coincident))


@pytest.mark.parametrize("name", ["clutter", "mirror-only"])
def test_without_the_dock_every_answer_is_hazardous_and_every_name_wrong(name):
    def answer(i, frame):
        light = np.where(np.arange(len(frame.light)) < 4, np.arange(len(frame.light)), -1)
        return right(frame, match=Match(frame.detections, light)) if i < 3 else nothing(frame)

    counts = tally_run(a_run(name, answer, "path.count=10")).counts
    assert (counts["hazardous_valid"], counts["hazardous_guide"]) == (3, 3)
    assert (counts["wrong_else"], counts["wrong_coincident"], counts["frames_few"]) == (12, 0, 10)
    assert counts["stale_valid"] == 3


def test_honest_covariances_have_a_nees_of_six_and_one_frame_a_sequence_and_stage(rng):
    spread = np.array([0.05, 0.05, 0.2, 0.01, 0.02, 0.01])
    mix = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    covariance = (mix * spread**2) @ mix.T

    def answer(_, frame):
        off = mix @ (spread * rng.normal(size=6))
        T = moved(frame, off[:3], off[3:])
        return right(frame, T_dock_cam=T, covariance=covariance, protection=Protection(1.0, 1.0, 0.1))

    tally = tally_run(a_run("three-lights", answer, "path.count=800"))
    frames, total = tally.nees["front"]
    assert frames == 800
    assert total / frames == pytest.approx(6.0, abs=0.5)
    assert row_of(tally)["nees"]["all"] == {"frames": 800, "mean": total / 800}


def test_which_frame_is_taken_for_nees_depends_on_the_seed_and_on_nothing_else():
    def answer(i, frame):
        T = moved(frame, (0.001 * i, 0, 0))
        return right(frame, T_dock_cam=T, covariance=1e-6 * np.eye(6), protection=Protection(1.0, 1.0, 0.1))

    taken = [tally_run(a_run("nominal-near", answer, "path.speed_spread_m_s=0", seed=seed)) for seed in (1, 1, 2, 3)]
    chosen = [tally.nees["front"] for tally in taken]
    assert [frames for frames, _ in chosen] == [1, 1, 1, 1]
    assert chosen[0] == chosen[1]
    assert len({round(total) for _, total in chosen[1:]}) == 3


def test_an_improper_covariance_is_counted_apart():
    def answer(_, frame):
        return right(frame, covariance=-np.eye(6), protection=Protection(1.0, 1.0, 0.1))

    tally = tally_run(a_run("missing-1", answer, "path.count=10"))
    assert tally.counts["improper_covariances"] == 10
    assert not tally.nees


def test_gaps_are_within_a_sequence():
    def answer(i, frame):
        return right(frame) if not 100 <= i < 130 else nothing(frame)

    tally = tally_run(a_run("nominal", answer))
    assert tally.largest["gap_s_valid"] == pytest.approx(31 / 15, rel=1e-4)
    assert tally.counts["gaps_over_half_second_guide"] == 1
    assert "gap_s_valid" not in tally_run(a_run("missing-1", answer, "path.count=200")).largest
    held = tally_run(a_run("three-lights", lambda i, f: right(f) if i % 5 in (0, 4) else nothing(f), "path.count=20"))
    assert held.largest["gap_s_valid"] == pytest.approx(4 / 15, rel=1e-4)


def test_answers_by_the_kth_frame_are_cumulative():
    def answer(i, frame):
        sequence, step = divmod(i, 5)
        return right(frame) if step == sequence else nothing(frame)

    counts = tally_run(a_run("three-lights", answer, "path.count=10")).counts
    assert counts["sequences"] == 10
    assert [counts[f"accepted_by_{k}"] for k in range(1, 6)] == [1, 2, 3, 4, 5]


def test_black_outs_show_stale_answers_and_the_way_back():
    """A method that goes on through a black-out as if nothing were, and needs three frames after it."""
    scenario = load_scenario("nominal", ("spots.black_outs.at_s=[[15, 16]]", "path.speed_spread_m_s=0"))
    frames = list(spot_frames(scenario, STATION, CAMERA, 0))
    seen = np.array([(frame.light >= 0).any() for frame in frames])
    dark = np.flatnonzero(~seen & (np.arange(len(seen)) > seen.argmax()))
    assert (len(dark), dark[-1] - dark[0]) == (15, 14)
    lost = {*range(seen.argmax()), dark[-1] + 1, dark[-1] + 2}
    fixes = [nothing(frame) if i in lost else right(frame) for i, frame in enumerate(frames)]
    tally = tally_run(Run(scenario, 0, frames, fixes))
    assert tally.counts["stale_valid"] == tally.counts["stale_guide"] == 15 - 4  # four whole frames in 0.3 s
    assert (tally.counts["blinded_valid"], tally.counts["never_back_valid"]) == (1, 0)
    assert tally.largest["frames_back_valid"] == 3.0
    assert row_of(tally)["frames_back"]["guide"]["median"] == pytest.approx(3.0, rel=0.02)
    never = [nothing(frame) if i > dark[-1] else fix for i, (frame, fix) in enumerate(zip(frames, fixes, strict=True))]
    counts = tally_run(Run(scenario, 0, frames, never)).counts
    assert (counts["blinded_valid"], counts["never_back_valid"]) == (1, 1)


def test_what_a_method_owes_is_counted_once_somebody_says_what():
    eligible = np.arange(10) < 6
    counts = tally_run(
        a_run(
            *("missing-1", lambda i, frame: right(frame) if i % 2 else nothing(frame), "path.count=10"),
            eligible=eligible,
        )
    ).counts
    assert (counts["frames_eligible"], counts["accepted_eligible"], counts["valid_eligible"]) == (6, 3, 3)


def test_rotation_vectors_are_those_of_one_at_a_time(rng):
    w = rng.normal(size=(100, 3))
    w *= (rng.uniform(0, np.pi, 100) / np.linalg.norm(w, axis=1))[:, None]
    w = np.concatenate([w, 1e-10 * w[:5], np.zeros((1, 3)), [[np.pi, 0, 0], [0, 0, np.pi]]])
    R = np.array([so3_exp(one) for one in w])
    np.testing.assert_allclose(rotation_vectors(R)[:-2], [so3_log(one) for one in R[:-2]], atol=1e-8)
    np.testing.assert_allclose(np.linalg.norm(rotation_vectors(R)[-2:], axis=1), np.pi)


def test_claims_agree_with_those_of_one_at_a_time():
    frames = list(spot_frames(load_scenario("any-roll", ("path.count=30",)), STATION, CAMERA, 0))
    pairs = [(frame, right(frame, T_dock_cam=moved(frame, (0.1, 0.2, 0.3), (0.1, -0.3, 0.2)))) for frame in frames]
    errors = [trust.pose_error(fix.T_dock_cam, frame.T_dock_cam) for frame, fix in pairs]
    np.testing.assert_allclose(pose_claims(pairs).errors, errors, atol=1e-12)
    true = [trust.true_guide(frame.T_dock_cam) for frame in frames]
    np.testing.assert_allclose(guide_claims(pairs).true, true, atol=1e-12)


def test_quantiles_of_a_histogram_are_good_to_a_hundredth(rng):
    tally, values = Tally(), 10.0 ** rng.uniform(-4, 2, 20_000)
    tally.spread("x", values)
    for share in (0.05, 0.5, 0.95):
        assert tally.quantile("x", share) == pytest.approx(np.quantile(values, share), rel=0.025)
    assert tally.largest["x"] == values.max()
    assert tally.quantile("y", 0.5) is None


def test_tallies_add_up_in_any_grouping_and_survive_a_file():
    runs = [a_run("nominal", lambda _, frame: right(frame), "path.frame_interval_s=0.5", seed=s) for s in range(4)]
    parts = [tally_run(run) for run in runs]
    one, two, three = Tally(), Tally(), Tally()
    for part in parts:
        one.merge(part)
        (two if part in parts[:2] else three).merge(part)
    two.merge(Tally.from_dict(json.loads(json.dumps(three.as_dict()))))
    assert json.dumps(one.as_dict(), sort_keys=True) == json.dumps(two.as_dict(), sort_keys=True)


def test_evaluation_takes_microseconds():
    """Thirty are the bound for a frame; alone it takes about five."""
    run, best = a_run("nominal", lambda _, frame: right(frame)), np.inf
    for _ in range(3):
        start = time.perf_counter()
        tally_run(run)
        best = min(best, time.perf_counter() - start)
    assert best / len(run.frames) < 30e-6


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
    assert table["rows"][0]["counts"]["named"] == 12 * 8 * 6


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


def wait_for(condition, seconds=60.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


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


def test_an_interrupt_ends_the_campaign_without_a_word(tmp_path):
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
    assert (*process.communicate(), process.returncode) == (b"", b"", 130)


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


@pytest.fixture
def lumidock(monkeypatch, capfd):
    """Run the command line in this process; returns (exit code, standard output, standard error)."""

    def call(*words):
        monkeypatch.setattr(sys, "argv", ["lumidock", *map(str, words)])
        with pytest.raises(SystemExit) as exited:
            cli.main()
        return exited.value.code, *capfd.readouterr()

    return call


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


def test_a_scenario_file_and_its_config_are_used(lumidock, tmp_path):
    (tmp_path / "my.yaml").write_text(
        "name: a|b/../c\nabout: x\npath: {kind: draws, count: 3}\nconfig: {paper: {max_spots: 2}}\n"
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
    assert "every frame cold" in (tmp_path / "out" / "table.md").read_text()


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
def test_errors_are_one_line(lumidock, tmp_path, words, match):
    code, out, err = lumidock("campaign", *words, "--out", tmp_path / "out")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert match in err


def test_without_dask_the_extra_is_named(lumidock, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    code, _, err = lumidock("campaign", "missing-1", *PAPER[:4], "--cluster", "tcp://x:1", "--out", tmp_path / "out")
    assert (code, err.count("\n")) == (2, 1)
    assert "lumidock[cluster]" in err
