import csv
import json
from dataclasses import replace

import numpy as np
import pytest
import yaml
from conftest import assert_close, refused
from test_run import LIGHTS, STATION

from lumidock.camera import Camera, save_camera
from lumidock.datatypes import Detections, Fix, Guide, LayerPose, Match, Protection
from lumidock.evaluation.claims import stanford
from lumidock.evaluation.metrics import evaluate, layer_offset_m, true_poses
from lumidock.geometry import bearing_and_range, quat_xyzw_from_rotation, so3_exp
from lumidock.station import load_station
from lumidock.streams.run_folder import RunFolder

HEAD_ON = np.diag([1.0, -1.0, -1.0])
TRUTH = "frame,t_ns,x_m,y_m,z_m,qx,qy,qz,qw\n"
NAMES = tuple(LIGHTS)


def pose(x, y, z, w=(0.0, 0.0, 0.0)):
    """T_dock_cam (4, 4) head-on at (x, y, z), turned by `w` rad in dock axes."""
    T = np.eye(4)
    T[:3, :3] = so3_exp(np.array(w)) @ HEAD_ON
    T[:3, 3] = x, y, z
    return T


def write_truth(folder, poses):
    """truth.csv of `poses` by frame name."""
    folder.mkdir(exist_ok=True)
    rows = ([name, 0, *T[:3, 3], *quat_xyzw_from_rotation(T[:3, :3])] for name, T in poses.items())
    (folder / "truth.csv").write_text(TRUTH + "".join(",".join(map(str, row)) + "\n" for row in rows))


def write_run(folder, poses, *, t_ns=None, layers=(), lights=None, claims=False):
    """A run folder with these poses; None is no fix. `lights` name the detections of each frame, at (10 i, 20)."""
    claimed = {"covariance": np.eye(6), "protection": Protection(1, 1, 1), "guide": Guide(0.0, 0.0, 9.0, 1.0, 1.0)}
    with RunFolder(folder, NAMES) as run:
        for number, (name, T) in enumerate(poses.items()):
            light = np.array((lights or {}).get(name, []), np.int64)
            uv = np.stack([10.0 * np.arange(len(light)), np.full(len(light), 20.0)], axis=1)
            t = number * 10**9 if t_ns is None else t_ns[number]
            match = Match(Detections.from_uv(name, t, uv), light)
            status, reason = ("none", "too_few") if T is None else ("tracking", "")
            by_layer = tuple(LayerPose(layer, T_layer, 4, "pso") for layer, T_layer in layers if T is not None)
            fix = Fix(name, t, status, "front", T_dock_cam=T, reason=reason, match=match, by_layer=by_layer)
            fix = replace(fix, **claimed) if claims else fix
            run.add(fix, 1, t_ns=t)


@pytest.fixture
def judge(tmp_path):
    """Evaluate a run with poses `found` against poses `true`."""

    def evaluate_poses(found, true, **options):
        write_truth(tmp_path / "truth", true)
        write_run(tmp_path / "run", found, **options)
        return evaluate(tmp_path / "run", tmp_path / "truth")

    return evaluate_poses


def test_errors_are_lateral_axial_and_total_rotation(judge):
    found = {"a": pose(0.3, 0.4, 9.5, (0.0, 0.1, 0.0)), "b": pose(0, 0, 10), "c": pose(0, 0, 10)}
    result = judge(found, {name: pose(0, 0, 10) for name in "abc"})
    assert_close([result["error"][name]["median"] for name in ("lateral_m", "axial_m", "angle_deg")], 0, atol=1e-6)
    assert_close(result["error"]["lateral_m"]["p95"], 0.9 * 0.5, atol=1e-8)
    assert_close(result["error"]["axial_m"]["p95"], 0.9 * 0.5, atol=1e-8)
    assert_close(result["error"]["angle_deg"]["p95"], 0.9 * np.rad2deg(0.1), atol=1e-6)


def test_every_true_frame_of_the_approach_is_in_one_range(judge):
    true = {f"{z:g}": pose(0, 0, z) for z in np.linspace(30, -3, 67)}
    table = judge(true | {"30": None, "8": None}, true)["by_true_z"]
    assert [row["z_m"] for row in table] == [[-3, 0], [0, 3], [3, 8], [8, 12], [12, 18], [18, 24], [24, 30]]
    assert [row["frames"] for row in table] == [6, 6, 10, 8, 12, 12, 13]
    assert [row["frames"] - row["valid"] for row in table] == [0, 0, 0, 1, 0, 0, 1]


def test_counts_reasons_and_the_longest_gap(judge):
    found = {"a": pose(0, 0, 9), "b": None, "c": pose(0, 0, 9), "d": pose(0, 0, 9), "e": None}
    stamps = [0, 10**9, 1795368000 * 10**9, 1795368001 * 10**9, 1795368009 * 10**9]
    result = judge(found, {name: pose(0, 0, 9) for name in found}, t_ns=stamps)
    assert (result["frames"], result["valid"], result["reasons"]) == (5, 3, {"too_few": 2})
    assert_close(result["longest_gap_s"], 1795368000.0)


def test_a_run_without_fixes_has_no_errors(judge):
    result = judge({"a": None}, {"a": pose(0, 0, 9)})
    assert (result["valid"], result["error"], result["longest_gap_s"], result["layers"]) == (0, {}, None, {})


def test_a_run_that_was_killed_at_once_is_no_error(judge):
    assert judge({}, {"a": pose(0, 0, 9)})["frames"] == 0


def write_lights_truth(folder, rows):
    folder.mkdir(exist_ok=True)
    (folder / "lights_truth.csv").write_text("frame,light,u_px,v_px,visible,snr\n" + "\n".join(rows) + "\n")


def test_an_identity_is_wrong_when_another_lit_lamp_is_nearer(judge, tmp_path):
    one = {"a": pose(0, 0, 9)}
    # A and C are right, though C saturates and has no SNR; B is too far off its own lamp; D is not in view at all
    write_lights_truth(tmp_path / "truth", ["a,A,0,22.9,1,9", "a,B,10,23.1,1,9", "a,C,20,20,0,0"])
    result = judge(one, one, lights={"a": [0, 1, 2, 3, -1]})
    assert result["identities"] == {"identified": 4, "wrong": 1, "displaced": 1}
    # A and B are exchanged; a dark lamp at the place of C's detection makes no light that C could be confused with
    write_lights_truth(tmp_path / "truth", ["a,A,10,20,1,9", "a,B,0,20,1,9", "a,C,20,21,1,9", "a,D,20,20,0,0"])
    result = judge(one, one, lights={"a": [0, 1, 2]})
    assert result["identities"] == {"identified": 3, "wrong": 2, "displaced": 0}


def test_frames_that_the_truth_lacks_are_not_judged(judge, tmp_path):
    write_lights_truth(tmp_path / "truth", ["a,A,0,20,1,9"])
    found = {"a": pose(0, 0, 9), "b": pose(5, 5, 5)}
    result = judge(found, {"a": pose(0, 0, 9)}, lights={"a": [0], "b": [1, 2]}, layers=[("front", pose(0, 0, 9))])
    assert (result["frames"], result["valid"]) == (2, 2)
    assert_close(result["error"]["lateral_m"]["p95"], 0)
    assert result["identities"] == {"identified": 1, "wrong": 0, "displaced": 0}
    assert result["layers"]["front"]["fixes"] == 1


def two_layers(folder):
    content = STATION | {"lights": [*STATION["lights"], {"id": "R", "layer": "rear", "position": [0, 0, -5]}]}
    (folder / "station.yaml").write_text(yaml.safe_dump(content))
    return load_station(folder / "station.yaml")


def test_the_offset_of_the_layers_is_that_of_the_docks_axis(tmp_path):
    station = two_layers(tmp_path)
    exact, shifted = pose(1, 2, 9), pose(1.3, 2.4, 9)
    assert_close(layer_offset_m(station, {"front": {"a": exact}, "rear": {"a": exact}}), 0)
    assert_close(layer_offset_m(station, {"front": {"a": exact}, "rear": {"a": shifted}}), 0.5)
    assert layer_offset_m(station, {"front": {"a": exact}, "rear": {"b": exact}}) is None


def test_layers_have_a_reach_and_an_offset(judge, tmp_path):
    layers = [("front", pose(0, 0, 9)), ("rear", pose(0, 0.25, 9))]
    (tmp_path / "run").mkdir()
    two_layers(tmp_path / "run")
    poses = {"a": pose(0, 0, 9), "b": pose(0, 0, 7), "c": None}
    result = judge(poses, poses | {"c": pose(0, 0, 5)}, layers=layers)["layers"]
    assert result["rear"] == {"fixes": 2, "first_z_m": 9.0, "last_z_m": 7.0}
    assert_close(result["offset_m"], 0.25, atol=1e-8)


def test_layers_of_another_station_have_no_offset(judge, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "station.yaml").write_text(yaml.safe_dump(STATION))
    layers = [("front", pose(0, 0, 9)), ("rear", pose(0, 0, 9))]
    assert "offset_m" not in judge({"a": pose(0, 0, 9)}, {"a": pose(0, 0, 9)}, layers=layers)["layers"]


def test_a_truth_file_alone_will_do(tmp_path):
    write_truth(tmp_path, {"a": pose(1, 2, 3)})
    (tmp_path / "other.csv").write_bytes(b"\xef\xbb\xbf" + (tmp_path / "truth.csv").read_bytes())
    assert_close(true_poses(tmp_path / "other.csv")["a"], pose(1, 2, 3))


@pytest.fixture
def judge_fixes(tmp_path):
    """Evaluate a run of whole fixes against poses `true`."""

    def evaluate_fixes(fixes, true):
        write_truth(tmp_path / "truth", true)
        with RunFolder(tmp_path / "run", NAMES) as run:
            for fix in fixes:
                run.add(fix, 1, t_ns=fix.t_ns)
        return evaluate(tmp_path / "run", tmp_path / "truth")

    return evaluate_fixes


def guide_at(T, off=(0.0, 0.0, 0.0)):
    """A guide of a true pose, wrong by `off` (rad, rad, m)."""
    return Guide(*np.add(bearing_and_range(T), off), 0.02, 0.5)


def fix_at(name, t_ms, T, guide, *, stage="front", reason="", covariance=None, protection=None):
    t_ns = t_ms * 1_000_000
    return Fix(
        *(name, t_ns, "tracking", stage, 5, 5, T, reason), covariance=covariance, protection=protection, guide=guide
    )


def test_a_guide_counts_beside_the_pose(judge_fixes):
    T, near = pose(0, 0, 20), pose(0, 0, 6)
    wrong = guide_at(T, (0.0, 0.027, 0.0))  # 1.55 degrees
    fixes = [
        fix_at("a", 0, T, guide_at(T)),
        fix_at("b", 200, None, wrong, reason="protection"),
        fix_at("c", 1000, None, guide_at(T, (0, 0, 0.6)), reason="protection"),
        fix_at("d", 1100, None, None, reason="too_few"),
        fix_at("e", 1500, near, guide_at(near)),
        fix_at("f", 1700, near, None),
        fix_at("unlike", 1800, near, None),
    ]
    result = judge_fixes(fixes, dict.fromkeys("abcd", T) | dict.fromkeys("efg", near))
    assert [result[name] for name in ("frames", "valid", "guide", "guide_only")] == [7, 4, 4, 2]
    assert_close([result["availability"][name] for name in ("valid", "guide")], 4 / 7)
    far, close = result["by_true_z"][1], result["by_true_z"][0]
    assert [far[name] for name in ("frames", "valid", "guide")] == [4, 1, 3]
    assert far["availability"] == {"valid": 0.25, "guide": 0.75}
    assert [close[name] for name in ("frames", "valid", "guide")] == [3, 2, 1]
    valid, guide = result["continuity"]["valid"], result["continuity"]["guide"]
    assert_close([valid["longest_gap_s"], guide["longest_gap_s"]], [1.5, 0.8])
    assert (valid["long_gaps"], guide["long_gaps"]) == (1, 2)
    assert result["hazardous"]["frames"] == 6
    assert result["hazardous"]["guide"] == {"any": 1, "bearing": 1, "range": 0}
    assert result["over_level"]["bearing"] == {"frames": 4, "over": 1}
    assert result["over_level"]["range"] == {"frames": 4, "over": 1}


def test_what_poses_claim_is_held_against_the_truth(judge_fixes):
    true = {name: pose(0, 0, 3) for name in "abcd"}
    level, sure = Protection(0.2, 0.2, 0.05), np.diag([0.01, 0.01, 0.01, 1e-4, 1e-4, 1e-4])
    fixes = [
        fix_at("a", 0, pose(0.1, 0, 3), None, covariance=sure, protection=level),
        fix_at("b", 1, pose(0.3, 0, 3), None, covariance=sure, protection=level, stage="rear"),
        fix_at("c", 2, pose(0, 0, 2.4, (0.0, 0.0, -0.02)), None, covariance=sure, protection=level, stage="rear"),
        fix_at("d", 3, None, None, reason="ambiguous"),
    ]
    result = judge_fixes(fixes, true)
    assert result["hazardous"]["valid"] == {"any": 1, "lateral": 0, "axial": 1, "angle": 0}
    assert {name: result["over_level"][name]["over"] for name in ("lateral", "axial", "angle")} == {
        **dict.fromkeys(("lateral", "axial"), 1),
        "angle": 0,
    }
    assert result["stanford"] == {
        "lateral": {"nominal": 2, "misleading": 1, "hazardous": 0, "unavailable": 1},
        "axial": {"nominal": 2, "misleading": 0, "hazardous": 1, "unavailable": 1},
        "angle": {"nominal": 3, "misleading": 0, "hazardous": 0, "unavailable": 1},
    }
    stages = result["nees"]["by_stage"]
    assert_close([stages["front"]["mean"], stages["rear"]["mean"]], [1.0, (9.0 + 36.0 + 4.0) / 2], atol=1e-5)
    assert [stages[name]["frames"] for name in ("front", "rear")] == [1, 2]


def test_an_honest_covariance_that_went_through_files_has_a_nees_of_six(judge_fixes, rng):
    sigma = np.array([1.5, 0.4, 0.05, 0.003, 0.1, 0.02])
    A = rng.normal(size=(6, 9))
    P = A @ A.T
    P *= np.outer(sigma, sigma) / np.sqrt(np.outer(np.diag(P), np.diag(P)))
    names = [str(i) for i in range(500)]
    true = {name: pose(*rng.normal(size=2), 18, rng.normal(size=3)) for name in names}
    fixes = []
    for i, (name, e) in enumerate(zip(names, rng.multivariate_normal(np.zeros(6), P, 500), strict=True)):
        T = true[name].copy()
        T[:3, 3] += e[:3]
        T[:3, :3] = so3_exp(e[3:]) @ T[:3, :3]
        fixes.append(fix_at(name, i, T, None, covariance=P, protection=Protection(9.0, 1.0, 1.0)))
    assert_close(judge_fixes(fixes, true)["nees"]["mean"], 6.0, atol=4 * np.sqrt(12 / 500))


def test_a_method_that_claims_nothing_is_judged_by_its_errors(judge):
    found = {"a": pose(0, 0, 9), "b": pose(1.2, 0, 9), "c": None}
    result = judge(found, {name: pose(0, 0, 9) for name in found})
    assert (result["guide"], result["availability"]["guide"]) == (0, 0.0)
    assert result["continuity"]["guide"] == {"longest_gap_s": None, "long_gaps": 0}
    assert result["hazardous"]["valid"] == {"any": 1, "lateral": 1, "axial": 0, "angle": 0}
    assert {row["frames"] for row in result["over_level"].values()} == {0}
    assert result["nees"] == {"frames": 0, "mean": None, "improper": 0, "by_stage": {}}
    assert "stanford" not in result


def test_a_table_of_poses_alone_will_do(tmp_path):
    T = {"a": pose(0, 0, 9)}
    write_truth(tmp_path / "truth", T)
    (tmp_path / "run").mkdir()
    rows = (tmp_path / "truth" / "truth.csv").read_text().splitlines()
    lines = (f"{rows[0]},valid,reason", f"{rows[1]},1,")
    (tmp_path / "run" / "fixes.csv").write_text("\n".join(lines) + "\n")
    result = evaluate(tmp_path / "run", tmp_path / "truth")
    assert (result["valid"], result["guide"], result["hazardous"]["valid"]["any"]) == (1, 0, 0)


def test_no_rows_have_no_availability(judge):
    assert judge({}, {"a": pose(0, 0, 9)})["availability"] == {"valid": None, "guide": None}


def test_the_residual_is_that_of_named_lights_at_the_estimated_pose(judge, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "station.yaml").write_text(yaml.safe_dump(STATION))
    # light A at (-0.9, 0.7): seen head-on from 10 m, 1000 px of focal length put it 90 px left of (90, 90), 70 px up
    save_camera(Camera(200, 200, np.array([[1000.0, 0, 90], [0, 1000.0, 90], [0, 0, 1]])), tmp_path / "run/camera.yaml")
    T = pose(0, 0, 10)
    # detections at (0, 20), (10, 20); identified as A the first is exact, the second is off by (10, 0)
    poses = {"a": T, "b": T, "c": None}
    result = judge(poses, dict.fromkeys("abc", T), lights={"a": [0], "b": [-1, 0], "c": [0]})
    assert_close(result["residual_rms_px"], np.sqrt(10.0**2 / 4), atol=1e-4)
    assert judge({"c": None}, {"c": T}, lights={"c": [0]})["residual_rms_px"] is None
    assert judge({"a": pose(0, 0, -10)}, {"a": T}, lights={"a": [0]})["residual_rms_px"] is None  # behind the camera


def test_the_stanford_regions_can_be_had_alone():
    counts = stanford(np.array([0.1, 0.3]), np.array([0.2, 0.2]), np.array([0.5, 0.5]))
    assert counts == {"nominal": 1, "misleading": 1, "hazardous": 0, "unavailable": 0}


def spoil(name, column, value):
    """Set a field of the first row of a CSV file below a folder; an empty `column` drops the file's header."""

    def change(folder):
        with (folder / name).open(newline="") as file:
            rows = list(csv.reader(file))
        if column:
            rows[1][rows[0].index(column)] = value
        else:
            del rows[0]
        with (folder / name).open("w", newline="") as file:
            csv.writer(file).writerows(rows)

    return change


SPOILS = {
    "no run": (lambda folder: (folder / "run" / "fixes.csv").unlink(), "run/fixes.csv: No such file"),
    "no truth": (lambda folder: (folder / "truth" / "truth.csv").unlink(), "truth/truth.csv: No such file"),
    "no lights": (lambda folder: (folder / "run" / "lights.csv").unlink(), "run/lights.csv: No such file"),
    "empty run": (lambda folder: (folder / "run" / "fixes.csv").write_text(""), "run/fixes.csv: no column frame"),
    "binary run": (lambda folder: (folder / "run" / "fixes.csv").write_bytes(bytes(range(256))), "run/fixes.csv: "),
    "no header": (spoil("truth/truth.csv", "", ""), "truth/truth.csv: no column frame"),
    "other frames": (spoil("truth/truth.csv", "frame", "z"), "truth: knows none"),
    "word for a number": (spoil("run/fixes.csv", "x_m", "far"), "run/fixes.csv: frame a: could not convert"),
    "empty number": (spoil("run/fixes.csv", "qw", ""), "run/fixes.csv: frame a: could not convert"),
    "number not finite": (spoil("truth/truth.csv", "y_m", "inf"), "truth/truth.csv: frame a: a number is not finite"),
    "guide without a bearing": (spoil("run/fixes.csv", "bearing_x_rad", ""), "run/fixes.csv: frame a: could not"),
    "half a covariance": (spoil("run/fixes.csv", "c33", ""), "run/fixes.csv: frame a: could not convert"),
    "covariance not finite": (spoil("run/fixes.csv", "c00", "nan"), "run/fixes.csv: frame a: a number is not finite"),
    "word for a level": (spoil("run/fixes.csv", "pl_axial_m", "low"), "run/fixes.csv: frame a: could not convert"),
    "endless level": (spoil("run/fixes.csv", "pl_range_m", "inf"), "run/fixes.csv: frame a: a number is not finite"),
    "no camera": (lambda folder: (folder / "run" / "camera.yaml").write_text("a: 1"), "run/camera.yaml: "),
    "no rotation": (spoil("truth/truth.csv", "qx", "0"), "truth/truth.csv: frame a: "),
    "no stamp": (spoil("run/fixes.csv", "t_ns", ""), "run/fixes.csv: t_ns: "),
    "layer without a pose": (spoil("run/layers.csv", "z_m", "?"), "run/layers.csv: frame a: "),
    "light nowhere": (spoil("run/lights.csv", "u_px", ""), "run/lights.csv: frame a: "),
    "light truly nowhere": (spoil("truth/lights_truth.csv", "v_px", "nan"), "truth/lights_truth.csv: frame a: "),
}


@pytest.mark.parametrize(("change", "match"), SPOILS.values(), ids=SPOILS)
def test_what_cannot_be_judged_is_refused(tmp_path, change, match):
    T = {"a": pose(0, 0, 9)}
    write_truth(tmp_path / "truth", T)
    write_lights_truth(tmp_path / "truth", ["a,A,0,20,1,9"])
    write_run(tmp_path / "run", T, lights={"a": [0]}, layers=[("front", T["a"])], claims=True)
    (tmp_path / "run" / "station.yaml").write_text(yaml.safe_dump(STATION))
    save_camera(Camera(200, 200, np.diag([1000.0, 1000.0, 1.0])), tmp_path / "run" / "camera.yaml")
    evaluate(tmp_path / "run", tmp_path / "truth")
    change(tmp_path)
    with refused(tmp_path, match):
        evaluate(tmp_path / "run", tmp_path / "truth")


@pytest.mark.parametrize(
    ("true_ns", "kind", "good"),
    [
        ([0, 1, 2, 3, 4], "sequence", True),
        ([7, 8, 9, 10, 11], "sequence", True),  # another epoch
        ([0, 1, 2, 9, 4], "sequence", True),  # a broken stamp
        ([0, 0, 0, 0, 0], "sequence", True),  # a truth without times
        ([0, 2, 4, 6, 8], "sequence", False),
        ([0, 2, 4, 6, 8], "bag", False),
        ([0, 2, 4, 6, 8], "images", True),  # whose times are of --fps
        ([0, 2, 4, 6, 8], "stream", True),  # whose times are of this machine
    ],
)
def test_the_truth_of_other_frames_is_told_by_their_times(tmp_path, true_ns, kind, good):
    poses = {f"{k:06d}": pose(0, 0, 10 - k) for k in range(5)}
    write_run(tmp_path / "run", poses)
    (tmp_path / "run" / "run.json").write_text(json.dumps({"source": {"kind": kind}}))
    write_truth(tmp_path / "truth", poses)
    lines = (tmp_path / "truth" / "truth.csv").read_text().splitlines()
    rows = [line.replace(",0,", f",{t}000000000,", 1) for line, t in zip(lines[1:], true_ns, strict=True)]
    (tmp_path / "truth" / "truth.csv").write_text("\n".join([lines[0], *rows]) + "\n")
    if good:
        assert evaluate(tmp_path / "run", tmp_path / "truth")["valid"] == 5
    else:
        with refused(tmp_path / "truth", "another sequence"):
            evaluate(tmp_path / "run", tmp_path / "truth")
