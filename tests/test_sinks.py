import csv
import shutil
import sys
from dataclasses import replace

import av
import numpy as np
import pytest
from conftest import assert_close, refused
from numpy.testing import assert_array_equal
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation
from test_run import CAMERA, simulate

from lumidock import cli
from lumidock.datatypes import Detections, Fix, Frame, Guide, Match, Protection, Unusable
from lumidock.errors import InputError
from lumidock.geometry import se3_inverse
from lumidock.station import load_station
from lumidock.streams.export import export
from lumidock.streams.mp4 import Mp4
from lumidock.streams.replay import read_fixes
from lumidock.streams.run_folder import RunFolder
from lumidock.streams.sinks import Setting, open_file_sink
from lumidock.streams.sources import open_source
from lumidock.streams.vehicle import load_vehicle

POSE = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
TOLD = ("frame", "status", "stage", "n_seen", "n_used", "reason", "guide", "protection")
VEHICLE = """\
schema: 1
body_frame: auv
camera_frame: front_optical
T_body_cam: {translation: [0.8, 0.1, -0.2], quat_xyzw: [-0.5, 0.5, -0.5, 0.5]}
"""


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    return simulate(tmp_path_factory.mktemp("sequence"))


@pytest.fixture(scope="module")
def run(sequence, tmp_path_factory):
    out = tmp_path_factory.mktemp("run") / "run"
    monkey = pytest.MonkeyPatch()
    monkey.setattr(sys, "argv", ["lumidock", "run", str(sequence), "--out", str(out)])
    with pytest.raises(SystemExit), monkey.context():
        cli.main()
    monkey.undo()
    return out


@pytest.fixture
def vehicle(tmp_path):
    (tmp_path / "vehicle.yaml").write_text(VEHICLE)
    return load_vehicle(tmp_path / "vehicle.yaml")


def read_mcap(path):
    """Messages by topic, read by the library rosbags with the definitions that the file brings along."""
    found = {}
    with AnyReader([path]) as reader:
        for connection, t_ns, data in reader.messages():
            found.setdefault(connection.topic, []).append((t_ns, reader.deserialize(data, connection.msgtype)))
    return found


def rows(run):
    with (run / "fixes.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def matrix(message):
    q, t = message.rotation, message.translation
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    T[:3, 3] = [t.x, t.y, t.z]
    return T


def test_an_mcap_holds_what_the_run_says(run, sequence, vehicle, tmp_path):
    target = tmp_path / "fixes.mcap"
    assert export(run, target, open_source(sequence), vehicle) == 7
    found, table = read_mcap(target), rows(run)
    assert set(found) == {
        *("/lumidock/pose", "/lumidock/status", "/tf", "/tf_static", "/lumidock/camera_info"),
        *("/lumidock/image/compressed", "/lumidock/annotations", "/lumidock/velocity"),
    }
    valid = [row for row in table if row["valid"] == "1"]
    assert len(valid) >= 3
    assert len(found["/lumidock/pose"]) == len(found["/tf"]) == len(valid)
    for row, (t_ns, message), (_, transforms) in zip(valid, found["/lumidock/pose"], found["/tf"], strict=True):
        stamp = message.header.stamp
        assert t_ns == stamp.sec * 10**9 + stamp.nanosec == int(row["t_ns"])
        assert message.header.frame_id == "dock"
        p, q = message.pose.pose.position, message.pose.pose.orientation
        pose = [float(row[name]) for name in POSE]
        assert_close([p.x, p.y, p.z, q.x, q.y, q.z, q.w], pose, atol=2e-9)
        covariance = np.reshape(message.pose.covariance, (6, 6))
        assert_array_equal(covariance, covariance.T)
        assert_close(covariance[0, 5], float(row["c05"]), atol=1e-15)
        (transform,) = transforms.transforms
        assert (transform.header.frame_id, transform.child_frame_id) == ("dock", "front_optical")
        assert_close(matrix(transform.transform)[:3, 3], [p.x, p.y, p.z])
    for row, (t_ns, message) in zip(table, found["/lumidock/status"], strict=True):
        assert (t_ns, message.valid, message.guide) == (int(row["t_ns"]), row["valid"] == "1", row["guide"] == "1")
        assert (message.stage, message.reason, message.n_used) == (row["stage"], row["reason"], int(row["n_used"]))


def test_the_transforms_lead_from_the_dock_to_the_body(run, vehicle, tmp_path):
    export(run, tmp_path / "fixes.mcap", None, vehicle)
    found = read_mcap(tmp_path / "fixes.mcap")
    (mounting,) = found["/tf_static"][0][1].transforms
    assert (mounting.header.frame_id, mounting.child_frame_id) == ("front_optical", "auv")
    assert_close(matrix(mounting.transform), se3_inverse(vehicle.T_body_cam), atol=1e-9)
    ahead_body = vehicle.T_body_cam[:3, :3] @ [0, 0, 1]  # the camera looks along the vehicle's x
    assert_close(ahead_body, [1, 0, 0], atol=1e-9)


def test_camera_picture_and_rings_belong_together(run, sequence, tmp_path):
    export(run, tmp_path / "fixes.mcap", open_source(sequence))
    found = read_mcap(tmp_path / "fixes.mcap")
    info, picture = found["/lumidock/camera_info"][0][1], found["/lumidock/image/compressed"][0][1]
    assert_array_equal(np.reshape(info.k, (3, 3)), CAMERA.K)
    assert (info.width, info.height, info.distortion_model) == (320, 256, "plumb_bob")
    assert info.header.frame_id == picture.header.frame_id == "camera_optical"
    with (run / "lights.csv").open(newline="") as file:
        lights = [row for row in csv.DictReader(file) if row["frame"] == "000000"]
    rings = found["/lumidock/annotations"][0][1]
    assert_close([ring.position.x for ring in rings.circles], [float(row["u_px"]) + 0.5 for row in lights], atol=1e-4)
    assert [text.text for text in rings.texts] == [row["light"] for row in lights if row["light"]]


def test_the_topics_of_a_bag_can_be_run_again(run, sequence, tmp_path):
    export(run, tmp_path / "fixes.mcap", open_source(sequence))
    source = open_source(tmp_path / "fixes.mcap")
    assert_array_equal(source.calibration.K, CAMERA.K)
    assert [item.t_ns for item in source.items()] == [item.t_ns for item in open_source(sequence).items()]


def test_a_file_that_was_cut_short_gives_its_whole_chunks(run, sequence, tmp_path, monkeypatch):
    from lumidock.streams import mcapfile

    monkeypatch.setattr(mcapfile, "_FLUSH_S", 0.0)
    export(run, tmp_path / "fixes.mcap", open_source(sequence))
    data = (tmp_path / "fixes.mcap").read_bytes()
    for size in np.linspace(len(data) // 4, len(data) - 1, 9, dtype=int):
        (tmp_path / "cut.mcap").write_bytes(data[:size])
        items = list(open_source(tmp_path / "cut.mcap").items())
        assert len([item for item in items if isinstance(item, Frame)]) >= int(7 * size / len(data)) - 1


def test_a_video_shows_each_frame_at_its_time(run, sequence, tmp_path):
    export(run, tmp_path / "fixes.mp4", open_source(sequence))
    with av.open(str(tmp_path / "fixes.mp4")) as container:
        shown = [(round(float(frame.time), 3), frame.width, frame.height) for frame in container.decode(video=0)]
    wanted = [(round(item.t_ns * 1e-9, 3), 320, 256) for item in open_source(sequence).items()]
    assert shown == wanted


@pytest.mark.parametrize("step_ns", [66_000_000, 1_000_000_000])
def test_a_video_that_nobody_closed_lacks_half_a_second_at_most(tmp_path, rng, step_ns):
    video, path = Mp4(tmp_path / "killed.mp4"), tmp_path / "killed.mp4"
    for number in range(12):
        video.add(rng.integers(0, 256, (64, 96, 3), np.uint8), number * step_ns)
        if number > 0:
            shutil.copyfile(path, tmp_path / "now.mp4")
            lost = number + 1 - len(list(open_source(tmp_path / "now.mp4").items()))
            assert lost <= max(1, 500_000_000 // step_ns + 1)
    video.close()
    assert len(list(open_source(path).items())) == 12


def test_parquet_is_the_table_with_types(run, tmp_path):
    from pyarrow import parquet

    assert export(run, tmp_path / "fixes.parquet") == 7
    table = parquet.read_table(tmp_path / "fixes.parquet")
    for row, wanted in zip(table.to_pylist(), rows(run), strict=True):
        assert (row["frame"], row["t_ns"], row["valid"]) == (
            wanted["frame"],
            int(wanted["t_ns"]),
            wanted["valid"] == "1",
        )
        for name in ("x_m", "c34", "pl_axial_m", "range_m"):
            assert row[name] == (float(wanted[name]) if wanted[name] else None)
    assert b'"finished": true' in table.schema.metadata[b"lumidock"]


def made_fixes(rng):
    """Fixes of every kind, over one set of detections."""
    uv = rng.uniform(0, 200, (3, 2)).round(3)
    numbers = [np.round(rng.uniform(0, 1, 3), 4) for _ in range(4)]
    match = Match(Detections("a", 5, uv, *numbers), np.array([2, -1, 0]))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3).round(6)
    A = rng.normal(size=(6, 6))
    guide = Guide(0.125, -0.25, 7.5, 0.001, 0.25)
    more = {"covariance": A @ A.T, "protection": Protection(0.5, 0.25, 0.125), "guide": guide}
    full = Fix("a", 5, "tracking", "rear", 3, 2, T, "", match, **more)
    return [
        full,
        replace(full, frame="b", guide=None),
        Fix("c", 6, "acquired", "front", 3, 2, reason="protection", match=match, guide=guide),
        Fix("d", 7, "none", "search", reason="no_lights"),
    ]


def test_a_run_folder_reads_back_as_the_fixes_it_was_written_from(rng, sequence, tmp_path):
    station = load_station(sequence / "station.yaml")
    fixes = made_fixes(rng)
    with RunFolder(tmp_path / "run", station.ids) as folder:
        for fix in fixes:
            folder.add(fix, 1234, t_ns=fix.t_ns)
    for (fix, t_ns, latency), wanted in zip(read_fixes(tmp_path / "run", station.ids), fixes, strict=True):
        assert (t_ns, latency) == (wanted.t_ns, 1234)
        assert [getattr(fix, name) for name in TOLD] == [getattr(wanted, name) for name in TOLD]
        assert (fix.T_dock_cam is None) == (wanted.T_dock_cam is None)
        if fix.T_dock_cam is not None:
            assert_close(fix.T_dock_cam, wanted.T_dock_cam, atol=1e-8)
            assert_close(fix.covariance, wanted.covariance, atol=1e-9)
        if wanted.match is not None:
            assert_array_equal(fix.match.light, wanted.match.light)
            assert_array_equal(fix.match.detections.uv, wanted.match.detections.uv)


def test_a_frame_without_a_stamp_is_left_out(sequence, tmp_path):
    scene = Setting(load_station(sequence / "station.yaml"), CAMERA)
    for suffix in ("mcap", "rrd"):
        sink = open_file_sink(tmp_path / f"a.{suffix}", scene)
        sink.add(Unusable("x", None, "bad_stamp", ""), Fix("x", 0, "none", "search", reason="bad_stamp"), None)
        sink.close()


REFUSED = {
    "another source": (("fixes.mcap", "--source", "other"), "not what"),
    "no pictures": (("fixes.mp4",), "give --source"),
    "unknown ending": (("fixes.doc",), "not one of .mcap"),
    "no folder": (("nowhere/fixes.mcap",), "nowhere/fixes.mcap: is a folder, or stands in none"),
    "a folder": (("a.mcap", "--force"), "a.mcap: is a folder"),
}


@pytest.mark.parametrize(("words", "match"), REFUSED.values(), ids=REFUSED)
def test_an_export_that_cannot_be_is_refused(lumidock, run, tmp_path, words, match, monkeypatch):
    monkeypatch.chdir(tmp_path)
    simulate(tmp_path / "other", "path.end_z_m=3.0")
    (tmp_path / "a.mcap").mkdir()
    code, out, err = lumidock("export", run, *words)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert match in err
    assert not list(tmp_path.glob("fixes.*"))


def test_an_existing_file_is_kept_unless_forced(lumidock, run, tmp_path):
    (tmp_path / "a.parquet").write_text("mine")
    assert lumidock("export", run, tmp_path / "a.parquet")[0] == 2
    assert (tmp_path / "a.parquet").read_text() == "mine"
    assert lumidock("export", run, tmp_path / "a.parquet", "--force")[0] == 0


def test_a_file_is_replaced_by_a_whole_one_only(lumidock, run, tmp_path):
    simulate(tmp_path / "other", "path.end_z_m=3.0")
    (tmp_path / "a.mcap").write_text("mine")
    assert lumidock("export", run, tmp_path / "a.mcap", "--source", tmp_path / "other", "--force")[0] == 2
    assert (tmp_path / "a.mcap").read_text() == "mine"
    assert {path.name for path in tmp_path.iterdir()} == {"a.mcap", "other"}


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (("0.5]", "0.6]"), "unit length"),
        (("auv", "dock"), "have to differ"),
        (("auv", "../auv"), "body_frame"),
        (("0.8", ".nan"), "translation"),
        (("schema: 1", "schema: 1\nmass: 3"), "mass: unknown key"),
        (("T_body_cam", "T_cam_body"), "T_body_cam|T_cam_body"),
    ],
)
def test_a_vehicle_file_is_checked(tmp_path, change, match):
    (tmp_path / "vehicle.yaml").write_text(VEHICLE.replace(*change))
    with refused(tmp_path / "vehicle.yaml", match):
        load_vehicle(tmp_path / "vehicle.yaml")


DAMAGE = {
    "words": lambda text: text.replace("acquired", "lost").replace("tracking", "lost"),
    "cut": lambda text: text[:99],
}


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
def test_a_damaged_run_is_refused(run, tmp_path, damage):
    broken = tmp_path / "broken"
    broken.mkdir()
    for file in run.iterdir():
        (broken / file.name).write_bytes(file.read_bytes())
    (broken / "fixes.csv").write_text(damage((run / "fixes.csv").read_text()))
    with pytest.raises(InputError, match=r"fixes.csv"):
        export(broken, tmp_path / "a.mcap")
