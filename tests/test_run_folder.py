import csv
import hashlib
import json
import resource
import time
from collections import deque
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from conftest import assert_close

from lumidock.datatypes import Detections, Fix, Guide, LayerPose, Match, Protection
from lumidock.geometry import pose_from_quat
from lumidock.streams.run_folder import RunFolder, identities, sha256

COLUMNS = (
    "frame,t_ns,valid,guide,status,stage,n_seen,n_used,x_m,y_m,z_m,qx,qy,qz,qw,"
    "c00,c01,c02,c03,c04,c05,c11,c12,c13,c14,c15,c22,c23,c24,c25,c33,c34,c35,c44,c45,c55,"
    "pl_lateral_m,pl_axial_m,pl_angle_rad,bearing_x_rad,bearing_y_rad,range_m,pl_bearing_rad,pl_range_m,reason,latency_us,"
    "vx_m_s,vy_m_s,vz_m_s,wx_rad_s,wy_rad_s,wz_rad_s,"
    "sigma_vx_m_s,sigma_vy_m_s,sigma_vz_m_s,sigma_wx_rad_s,sigma_wy_rad_s,sigma_wz_rad_s,aiding"
)
HALF = np.sqrt(0.5)
T_DOCK_CAM = pose_from_quat(np.array([1.0, -2.0, 10.0]), np.array([HALF, 0.0, 0.0, HALF]))
DETECTIONS = Detections(
    "f1",
    5,
    np.array([[10.5, 20.25], [30.0, 40.0]]),
    np.array([2.0, np.nan]),
    np.array([100.0, np.nan]),
    np.array([1.0, 0.25]),
    np.array([0.5, np.nan]),
)
FIX = Fix(
    "f1",
    1795368000123456789,
    "tracking",
    "transition",
    n_seen=2,
    n_used=1,
    T_dock_cam=T_DOCK_CAM,
    match=Match(DETECTIONS, np.array([1, -1])),
    by_layer=(LayerPose("front", T_DOCK_CAM, 1, "pso"),),
)
LOST = Fix("f2", 0, "none", "search", reason="bad_frame")


def rows(path):
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.fixture
def write(tmp_path):
    """Write fixes, each (fix, latency_us, t_ns), into a run folder; returns the folder."""

    def write_run(*fixes):
        with RunFolder(tmp_path / "run", ("F1", "F2")) as folder:
            for fix, latency_us, t_ns in fixes:
                folder.add(fix, latency_us, t_ns=t_ns)
        return tmp_path / "run"

    return write_run


@contextmanager
def room_for(size):
    """No file can grow beyond `size` bytes, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_the_columns_are_those_of_the_contract(write):
    folder = write()
    assert (folder / "fixes.csv").read_text() == COLUMNS + "\n"
    assert (folder / "lights.csv").read_text() == "frame,u_px,v_px,radius_px,flux,p_light,p_rear,light\n"
    assert (folder / "trajectory.tum").read_text() == ""


def test_a_fix_is_written_whole(write):
    (row,) = rows(write((FIX, 42, FIX.t_ns)) / "fixes.csv")
    words = ("frame", "t_ns", "valid", "guide", "status", "stage", "n_seen", "n_used", "reason", "latency_us")
    wanted = ["f1", "1795368000123456789", "1", "0", "tracking", "transition", "2", "1", "", "42"]
    assert [row[name] for name in words] == wanted
    pose = [float(row[name]) for name in ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")]
    assert_close(pose, [1, -2, 10, HALF, 0, 0, HALF], atol=1e-9)
    # (-1, 2, -10) leads to the dock's origin; after a quarter turn about x it is (-1, -10, -2) in cam
    bearing = [float(row[name]) for name in ("bearing_x_rad", "bearing_y_rad", "range_m")]
    assert_close(bearing, [np.arctan2(-1, -2), np.arctan2(-10, -2), np.sqrt(105)], atol=1e-9)
    assert {row[name] for name in row if name.startswith(("c", "pl_"))} == {""}


GUIDE = Guide(0.25, -0.5, 12.125, 0.0078125, 0.75)
COVARIANCE = [name for name in COLUMNS.split(",") if name[0] == "c"]
LEVELS = ("pl_lateral_m", "pl_axial_m", "pl_angle_rad")
GUIDANCE = ("bearing_x_rad", "bearing_y_rad", "range_m", "pl_bearing_rad", "pl_range_m")


def test_a_covariance_is_written_as_its_upper_triangle(write):
    A = np.arange(36.0).reshape(6, 6)
    fix = replace(FIX, covariance=A + A.T, protection=Protection(0.5, 1e-7, 0.03125), guide=GUIDE)
    (row,) = rows(write((fix, 42, 5)) / "fixes.csv")
    assert len(COVARIANCE) == 21
    assert {name: float(row[name]) for name in COVARIANCE} == {
        name: (A + A.T)[int(name[1]), int(name[2])] for name in COVARIANCE
    }
    assert [float(row[name]) for name in LEVELS] == [0.5, 1e-7, 0.03125]
    assert [float(row[name]) for name in GUIDANCE] == [0.25, -0.5, 12.125, 0.0078125, 0.75]  # not of the pose
    assert (row["valid"], row["guide"]) == ("1", "1")


def test_a_written_covariance_of_a_planar_array_far_away_stays_one(write, rng):
    # the lateral error is z times the tilt but for a tenth of a millimetre
    tilt, rest = 0.1 * rng.normal(size=(2, 5000)), rng.normal(size=(6, 5000))
    errors = rest * np.array([1e-4, 1e-4, 1e-2, 1e-5, 1e-5, 1e-4])[:, None]
    errors[[0, 4]] += [18.0 * tilt[0], tilt[0]]
    errors[[1, 3]] += [18.0 * tilt[1], -tilt[1]]
    covariance = np.cov(errors)
    (row,) = rows(write((replace(FIX, covariance=covariance), 42, 5)) / "fixes.csv")
    back = np.zeros((6, 6))
    back[np.triu_indices(6)] = [float(row[name]) for name in COVARIANCE]
    back += np.triu(back, 1).T
    np.linalg.cholesky(back)
    e = errors[:, 0]
    assert_close(e @ np.linalg.solve(back, e) / (e @ np.linalg.solve(covariance, e)), 1.0, atol=1e-3)


def test_a_guide_without_a_pose_fills_its_own_fields_only(write):
    fix = Fix("f1", 5, "tracking", "front", reason="protection", guide=GUIDE)
    folder = write((fix, 42, 5))
    (row,) = rows(folder / "fixes.csv")
    assert (row["valid"], row["guide"], row["reason"]) == ("0", "1", "protection")
    assert [float(row[name]) for name in GUIDANCE] == [0.25, -0.5, 12.125, 0.0078125, 0.75]
    assert {row[name] for name in (*COVARIANCE, *LEVELS, "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")} == {""}
    assert (folder / "trajectory.tum").read_text() == ""


def test_a_level_that_is_not_finite_is_unknown(write):
    fix = replace(FIX, protection=Protection(0.5, np.inf, np.nan), guide=replace(GUIDE, pl_range_m=np.inf))
    (row,) = rows(write((fix, 42, 5)) / "fixes.csv")
    assert [row[name] for name in (*LEVELS, "pl_range_m")] == ["0.5", "", "", ""]


@pytest.mark.parametrize("t_ns", [None, -5])
def test_a_frame_without_a_fix_has_its_reason_and_no_numbers(write, t_ns):
    folder = write((LOST, None, t_ns))
    (row,) = rows(folder / "fixes.csv")
    known = {"frame": "f2", "valid": "0", "guide": "0", "status": "none", "stage": "search", "reason": "bad_frame"}
    known |= {"t_ns": "" if t_ns is None else str(t_ns), "n_seen": "0", "n_used": "0"}
    assert row == dict.fromkeys(row, "") | known
    assert rows(folder / "lights.csv") == []
    assert (folder / "trajectory.tum").read_text() == ""


def test_every_detection_has_a_row_and_unknown_numbers_are_empty(write):
    folder = write((FIX, 42, FIX.t_ns), (LOST, None, None))
    assert (folder / "lights.csv").read_text().splitlines()[1:] == [
        "f1,10.5000,20.2500,2.0000,100.0000,1.0000,0.5000,F2",
        "f1,30.0000,40.0000,,,0.2500,,",
    ]
    (row,) = rows(folder / "layers.csv")
    assert [row[name] for name in ("frame", "layer", "n_used", "matched_by", "z_m")] == [
        *("f1", "front", "1", "pso", "10.000000000")
    ]


@pytest.mark.parametrize(
    ("t_ns", "seconds"),
    [
        (1795368000123456789, "1795368000.123456789"),
        (-1, "-0.000000001"),
        (-1_500_000_000, "-1.500000000"),
        (0, "0.000000000"),
    ],
)
def test_the_trajectory_keeps_every_nanosecond(write, t_ns, seconds):
    fix = Fix("f", t_ns, "acquired", "front", T_dock_cam=T_DOCK_CAM)
    (line,) = (write((fix, 1, t_ns)) / "trajectory.tum").read_text().splitlines()
    assert line.split()[0] == seconds
    assert_close([float(v) for v in line.split()[1:]], [1, -2, 10, HALF, 0, 0, HALF], atol=1e-9)


@pytest.mark.parametrize("name", ["", "a,b", 'say "x"', "two\nlines", "\ufffd", "grün"])
def test_any_name_comes_back(write, name):
    fix = Fix(name, 5, "none", "search", reason="no_lights")
    assert rows(write((fix, 1, 5)) / "fixes.csv")[0]["frame"] == name


def test_a_files_name_that_is_no_text_is_escaped(write):
    fix = Fix("f\udcff", 5, "none", "search", reason="no_lights")
    assert rows(write((fix, 1, 5)) / "fixes.csv")[0]["frame"] == "f\\udcff"


def test_an_earlier_run_is_replaced_and_nothing_else(write, tmp_path):
    folder = write((FIX, 42, 5))
    (tmp_path / "mine.csv").write_text("mine")
    (folder / "notes.txt").write_text("mine")
    (folder / "run.json").write_text("{}")
    (folder / "lights.csv").unlink()
    (folder / "lights.csv").symlink_to(tmp_path / "mine.csv")
    write((LOST, None, None))
    assert [row["frame"] for row in rows(folder / "fixes.csv")] == ["f2"]
    assert not (folder / "run.json").exists()
    assert (folder / "trajectory.tum").read_text() == (folder / "layers.csv").read_text().split("\n", 1)[1] == ""
    assert (tmp_path / "mine.csv").read_text() == (folder / "notes.txt").read_text() == "mine"


def test_rows_are_in_the_file_at_once(tmp_path):
    with RunFolder(tmp_path, ("F1", "F2")) as folder:
        for count in range(1, 4):
            folder.add(FIX, 42, t_ns=5)
            for name, a_frame in (("fixes.csv", 1), ("lights.csv", 2), ("layers.csv", 1)):
                assert (tmp_path / name).read_text().count("\n") == 1 + a_frame * count
            assert (tmp_path / "trajectory.tum").read_text().count("\n") == count


@pytest.mark.parametrize("size", range(700, 1000, 37))
def test_a_full_disk_leaves_whole_rows(tmp_path, size):
    with RunFolder(tmp_path, ("F1", "F2")) as folder, room_for(size):
        folder.add(FIX, 42, t_ns=5)
        with pytest.raises(OSError, match=r"fixes\.csv"):
            deque(folder.add(FIX, 42, t_ns=5) for _ in range(9))
    content = (tmp_path / "fixes.csv").read_text()
    assert content.endswith("\n")
    assert 0 < len(rows(tmp_path / "fixes.csv")) < 10
    assert len({line.count(",") for line in content.splitlines()}) == 1


def test_the_description_is_replaced_in_one_piece(tmp_path):
    with RunFolder(tmp_path, ()) as folder:
        folder.describe({"counts": 1})
        with room_for(4), pytest.raises(OSError, match="too large"):
            folder.describe({"counts": 2, "more": "x" * 100})
        assert json.loads((tmp_path / "run.json").read_text()) == {"counts": 1}
        folder.describe({"counts": 3})
    assert json.loads((tmp_path / "run.json").read_text()) == {"counts": 3}
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        ["fixes.csv", "lights.csv", "layers.csv", "alternatives.csv", "trajectory.tum", "run.json"]
    )


def test_the_hash_is_sha256(tmp_path):
    (tmp_path / "file").write_bytes(b"lumidock")
    assert sha256(tmp_path / "file") == hashlib.sha256(b"lumidock").hexdigest()


def test_a_large_file_is_told_by_its_size_and_samples(tmp_path, rng):
    size, path = (16 << 20) + 1, tmp_path / "dive.mcap"
    path.write_bytes(rng.bytes(size))
    (tmp_path / "small").write_bytes(b"lumidock")
    found = identities({"dive.mcap": path, "small": tmp_path / "small"})
    assert found["inputs_sha256"] == {"small": sha256(tmp_path / "small")}
    assert found["inputs_sampled"]["dive.mcap"]["bytes"] == size
    digests = {found["inputs_sampled"]["dive.mcap"]["sha256_of_samples"]}
    for at in (0, 65535, size - 65536, size - 1):  # the first block and the last
        content = bytearray(path.read_bytes())
        content[at] ^= 1
        path.write_bytes(content)
        digests.add(identities({"dive.mcap": path})["inputs_sampled"]["dive.mcap"]["sha256_of_samples"])
    assert len(digests) == 5


def test_identifying_a_huge_file_takes_no_time(tmp_path):
    path = tmp_path / "huge.mcap"
    with path.open("wb") as file:
        file.truncate(50 << 30)  # 50 GiB of nothing, which take no room
    start = time.monotonic()
    assert identities({"huge.mcap": path})["inputs_sampled"]["huge.mcap"]["bytes"] == 50 << 30
    assert time.monotonic() - start < 5.0
