"""What is counted of a run: errors over their limits, names, gaps, black-outs, and how counts add up."""

import json
import time
from dataclasses import replace

import numpy as np
import pytest
from bench.shipped import shipped_camera, shipped_station

from lumidock.datatypes import Fix, Guide, Match, Protection
from lumidock.evaluation import claims
from lumidock.evaluation.campaign_table import row_of
from lumidock.evaluation.counts import SimulatedRun, Tally, guide_claims, pose_claims, rotation_vectors, tally_run
from lumidock.geometry import bearing_and_range, so3_exp, so3_log
from lumidock.sim.detections import simulated_frames
from lumidock.sim.scenario import load_scenario

STATION, CAMERA = shipped_station(), shipped_camera()


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
    frames = list(simulated_frames(scenario, STATION, CAMERA, seed))
    return SimulatedRun(scenario, seed, frames, [answer(i, frame) for i, frame in enumerate(frames)], **kwargs)


def test_a_method_that_is_always_right_has_no_fault():
    tally = tally_run(a_run("nominal", lambda _, frame: right(frame) if (frame.light >= 0).any() else nothing(frame)))
    counts = tally.counts
    seen = counts["frames"] - counts["frames_blind"]
    assert counts["accepted"] == counts["valid"] == counts["guide"] == seen > 0
    assert counts["identified"] > 5 * seen
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
    assert (counts["identified"], counts["frames_with_wrong"]) == (60, 4)
    assert (counts["wrong_else"], counts["wrong_coincident"]) == (8, 0)


@pytest.mark.parametrize(("off_px", "coincident"), [(1.4, True), (1.6, False)])
def test_a_spurious_detection_where_a_missing_light_would_be_is_a_coincidence(off_px, coincident):
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
    scenario = load_scenario("nominal", ("detections.black_outs.at_s=[[15, 16]]", "path.speed_spread_m_s=0"))
    frames = list(simulated_frames(scenario, STATION, CAMERA, 0))
    seen = np.array([(frame.light >= 0).any() for frame in frames])
    dark = np.flatnonzero(~seen & (np.arange(len(seen)) > seen.argmax()))
    assert (len(dark), dark[-1] - dark[0]) == (15, 14)
    lost = {*range(seen.argmax()), dark[-1] + 1, dark[-1] + 2}
    fixes = [nothing(frame) if i in lost else right(frame) for i, frame in enumerate(frames)]
    tally = tally_run(SimulatedRun(scenario, 0, frames, fixes))
    assert tally.counts["stale_valid"] == tally.counts["stale_guide"] == 15 - 4  # four whole frames in 0.3 s
    assert (tally.counts["blinded_valid"], tally.counts["never_back_valid"]) == (1, 0)
    assert tally.largest["frames_back_valid"] == 3.0
    assert row_of(tally)["frames_back"]["guide"]["median"] == pytest.approx(3.0, rel=0.02)
    never = [nothing(frame) if i > dark[-1] else fix for i, (frame, fix) in enumerate(zip(frames, fixes, strict=True))]
    counts = tally_run(SimulatedRun(scenario, 0, frames, never)).counts
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
    frames = list(simulated_frames(load_scenario("any-roll", ("path.count=30",)), STATION, CAMERA, 0))
    pairs = [(frame, right(frame, T_dock_cam=moved(frame, (0.1, 0.2, 0.3), (0.1, -0.3, 0.2)))) for frame in frames]
    errors = [claims.pose_error(fix.T_dock_cam, frame.T_dock_cam) for frame, fix in pairs]
    np.testing.assert_allclose(pose_claims(pairs).errors, errors, atol=1e-12)
    true = [claims.true_guide(frame.T_dock_cam) for frame in frames]
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
        start = time.process_time()
        tally_run(run)
        best = min(best, time.process_time() - start)
    assert best / len(run.frames) < 30e-6
