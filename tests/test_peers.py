"""Clients that others wrote take what lumidock gives, and give what it takes. `make peers` fetches those it can."""

import csv
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from commandline import LUMIDOCK, VEHICLE, fixes, free_port, serve, wait_for
from conftest import assert_close
from rosbags.typesys import Stores, get_typestore
from test_run import simulate

from lumidock.camera import Camera, load_camera, save_camera
from lumidock.datatypes import Fix, Frame, Guide, Velocity
from lumidock.evaluation.metrics import evaluate
from lumidock.geometry import bearing_and_range
from lumidock.setup.calibration_files import write_calibration
from lumidock.streams.live import open_live
from lumidock.streams.mavlink import Identity, Mavlink, signing_key
from lumidock.streams.rostypes import TYPES
from lumidock.streams.source import Reading
from lumidock.streams.sources import open_source
from lumidock.streams.vehicle import load_vehicle

pytestmark = pytest.mark.peers

SCRIPTS = Path(__file__).parent / "peers"
FETCHED = Path(__file__).parents[1] / ".peers"
SYSTEM_PYTHON = "/usr/bin/python3"


def need(program):
    path = program if Path(program).exists() else shutil.which(program)
    if path is None:
        pytest.skip(f"{program} is not on this machine")
    return path


def node(script, *words):
    """Run a script with the packages that `make peers` fetched; returns its lines of JSON."""
    if not (FETCHED / "node_modules").exists():
        pytest.skip("make peers has not fetched the npm packages")
    environment = os.environ | {"NODE_PATH": str(FETCHED / "node_modules")}
    command = [need("node"), str(SCRIPTS / script), *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, env=environment)
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def system_python(module, *words):
    """Run the system's Python, which has Debian's packages of ROS."""
    probe = subprocess.run([need(SYSTEM_PYTHON), "-c", f"import {module}"], capture_output=True)
    if probe.returncode:
        pytest.skip(f"the system's Python has no {module}")
    done = subprocess.run([SYSTEM_PYTHON, *map(str, words)], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return done.stdout


def lumidock(*words):
    done = subprocess.run([LUMIDOCK, *map(str, words)], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A rendered sequence, its run, and the run as MCAP, Rerun and mp4."""
    folder = tmp_path_factory.mktemp("made")
    simulate(folder / "seq")
    (folder / "vehicle.yaml").write_text(VEHICLE)
    lumidock("run", folder / "seq", "--out", folder / "run")
    for name in ("fixes.mcap", "fixes.rrd", "fixes.mp4"):
        lumidock(
            "export", folder / "run", folder / name, "--source", folder / "seq", "--vehicle", folder / "vehicle.yaml"
        )
    return folder


POSE = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")


def pose_of(content):
    p, q = content["pose"]["pose"]["position"], content["pose"]["pose"]["orientation"]
    return [p["x"], p["y"], p["z"], q["x"], q["y"], q["z"], q["w"]]


def test_foxgloves_decoders_read_our_mcap(made):
    found = {}
    for line in node("mcap.cjs", made / "fixes.mcap"):
        found.setdefault(line["topic"], []).append(line)
    valid = [row for row in fixes(made / "run") if row["valid"] == "1"]
    assert len(found["/lumidock/status"]) == 7
    assert [line["t_ns"] for line in found["/lumidock/pose"]] == [row["t_ns"] for row in valid]
    for line, row in zip(found["/lumidock/pose"], valid, strict=True):
        assert_close(pose_of(line["content"]), [float(row[name]) for name in POSE], atol=2e-9)
        covariance = np.reshape(line["content"]["pose"]["covariance"], (6, 6))
        assert_close(covariance[0, 4], float(row["c04"]), atol=1e-12)
    assert found["/lumidock/image/compressed"][0]["content"]["data"][:2] == [0xFF, 0xD8]
    names = {text["text"] for line in found["/lumidock/annotations"] for text in line["content"]["texts"]}
    assert names == set("ABCDE")
    assert found["/tf"][0]["content"]["transforms"][0]["child_frame_id"] == "dock"
    check_of_filters(found)


def check_of_filters(found):
    """What robot_localization and nav2 take, by the definitions in the file and Foxglove's decoder."""
    odometry, body = found["/lumidock/odometry"][-1]["content"], found["/lumidock/body_pose"][-1]["content"]
    assert (odometry["header"]["frame_id"], odometry["child_frame_id"]) == ("dock", "base_link")
    assert odometry["pose"] == body["pose"]
    for covariance in (odometry["twist"]["covariance"], body["pose"]["covariance"]):
        assert (np.diag(np.reshape(covariance, (6, 6))) > 0).all()
    dock = found["/detected_dock_pose"][-1]["content"]
    assert dock["header"]["frame_id"] == "camera_optical"
    assert 2.0 < dock["pose"]["position"]["z"] < 4.5  # ahead of the camera
    (status,) = found["/diagnostics"][-1]["content"]["status"]
    assert (status["level"], status["name"]) == (0, "lumidock: fix")


def test_rerun_reads_our_mcap_and_verifies_our_rrd(made, tmp_path):
    rerun = str(Path(sys.executable).with_name("rerun"))
    for command in (
        [rerun, "rrd", "verify", str(made / "fixes.rrd")],
        [rerun, "mcap", "check", str(made / "fixes.mcap")],
        [rerun, "mcap", "convert", str(made / "fixes.mcap"), "-o", str(tmp_path / "converted.rrd")],
        [rerun, "rrd", "verify", str(tmp_path / "converted.rrd")],
    ):
        done = subprocess.run(command, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("compression", ["none", "bz2", "lz4"])
def test_bags_of_debians_rosbag_are_read(tmp_path, compression):
    path = tmp_path / "debian.bag"
    system_python("rosbag", SCRIPTS / "rosbag1.py", "write", path, compression)
    source = open_source(path, Reading(topic="/cam/image_raw"))
    items = list(source.items())
    assert [item.t_ns for item in items] == [(1_700_000_000 + i) * 10**9 + 250 for i in range(5)]
    for number, item in enumerate(items):
        assert item.image.reshape(-1).tolist() == [(number * 40 + i) % 256 for i in range(24)]
    assert_close(source.calibration.K, [[5, 0, 2.5], [0, 5.5, 1.5], [0, 0, 1]])
    assert_close(source.calibration.distortion, [0.1, 0, 0, 0, 0.01])


def test_evo_takes_our_trajectory_and_finds_the_same_error(made, tmp_path):
    evo = FETCHED / "evo" / "bin" / "evo_ape"
    if not evo.exists():
        pytest.skip("make peers has not fetched evo")
    truth = tmp_path / "truth.tum"
    with (made / "seq" / "truth.csv").open(newline="") as file:
        lines = [f"{int(r['t_ns']) * 1e-9:.9f} " + " ".join(r[name] for name in POSE) for r in csv.DictReader(file)]
    truth.write_text("\n".join(lines) + "\n")
    command = [str(evo), "tum", str(truth), str(made / "run" / "trajectory.tum")]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=120, env=os.environ | {"HOME": str(tmp_path)}
    )
    assert done.returncode == 0, done.stderr
    rmse = float(next(line.split()[1] for line in done.stdout.splitlines() if "rmse" in line))
    valid = {row["frame"]: row for row in fixes(made / "run") if row["valid"] == "1"}
    with (made / "seq" / "truth.csv").open(newline="") as file:
        true = {row["frame"]: row for row in csv.DictReader(file)}
    errors = [[float(row[n]) - float(true[frame][n]) for n in POSE[:3]] for frame, row in valid.items()]
    assert rmse == pytest.approx(np.sqrt((np.array(errors) ** 2).sum(axis=1).mean()), abs=2e-6)
    assert evaluate(made / "run", made / "seq")["valid"] == len(valid)


T = np.diag([1.0, -1, -1, 1])
T[:3, 3] = [0.3, 0.2, 6.0]
COVARIANCE = np.diag([0.01, 0.04, 0.09, 1e-4, 1e-4, 4e-4])
VELOCITY = Velocity(np.array([0.0, 0.1, 0.5]), np.array([0.0, 0.2, 0.0]), np.eye(6) * 0.01)
GUIDE = Guide(*bearing_and_range(T), 0.01, 0.1)


def sent(folder, fix, identity=None, passphrase=""):
    """What node-mavlink makes of the messages about a fix, by their names."""
    (folder / "vehicle.yaml").write_text(VEHICLE)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as port:
        port.bind(("127.0.0.1", 0))
        port.settimeout(0.3)
        link = Mavlink("127.0.0.1", port.getsockname()[1], load_vehicle(folder / "vehicle.yaml"), identity)
        link.tick()
        link.add(Frame("a", fix.t_ns, np.zeros((4, 4), np.uint8)), fix, 9)
        link.close()
        received = []
        with suppress(TimeoutError):
            while True:
                received.append(port.recv(4096))
    (folder / "bytes").write_bytes(b"".join(received))
    found = node("mavlink.cjs", folder / "bytes", *filter(None, [passphrase]))
    assert len(found) == len(received)
    return {f"{line['name']} {line['content'].get('name', '')}".strip(): line for line in found}


def test_node_mavlink_parses_pose_and_guide(tmp_path):
    fix = Fix("a", 123_456_789_000, "tracking", "rear", T_dock_cam=T, covariance=COVARIANCE, guide=GUIDE)
    found = sent(tmp_path, fix)
    heartbeat, content = found["HEARTBEAT"], found["VISION_POSITION_ESTIMATE"]["content"]
    assert (heartbeat["system"], heartbeat["component"], heartbeat["content"]["type"]) == (1, 197, 18)
    assert content["usec"] == "123456789"
    assert_close([content["x"], content["y"], content["z"]], [-6.8, 0.3, -0.1], atol=1e-6)
    assert_close([content["roll"], content["pitch"], content["yaw"]], [0, 0, 0], atol=1e-6)
    assert content["covariance"][0] > 0.09  # along the approach, and what the lever adds
    target = found["LANDING_TARGET"]["content"]
    assert_close([target["x"], target["y"], target["z"]], [6.8, -0.3, 0.1], atol=1e-6)
    assert (target["frame"], target["positionValid"], target["timeUsec"]) == (12, 1, "123456789")
    assert_close(target["distance"], np.linalg.norm([6.8, 0.3, 0.1]), atol=1e-6)
    assert_close(found["NAMED_VALUE_FLOAT dock_range"]["content"]["value"], GUIDE.range_m, atol=1e-6)
    assert found["STATUSTEXT"]["content"]["text"] == "lumidock: pose, rear"


def test_node_mavlink_parses_odometry(tmp_path):
    fix = Fix("a", 5_000, "tracking", "rear", T_dock_cam=T, covariance=COVARIANCE, velocity=VELOCITY)
    content = sent(tmp_path, fix)["ODOMETRY"]["content"]
    assert (content["frameId"], content["childFrameId"], content["estimatorType"]) == (20, 12, 2)
    assert_close([content["x"], content["y"], content["z"]], [-6.8, 0.3, -0.1], atol=1e-6)
    assert_close(content["q"], [1, 0, 0, 0], atol=1e-6)
    assert_close([content["vx"], content["vy"], content["vz"]], [0.5, -0.16, 0.1], atol=1e-6)
    assert_close([content["rollspeed"], content["pitchspeed"], content["yawspeed"]], [0, 0, 0.2], atol=1e-6)


def test_node_mavlink_accepts_the_signature_by_the_passphrase_alone(tmp_path):
    (tmp_path / "key").write_text("correct horse battery\n")
    fix = Fix("a", 5_000, "tracking", "rear", T_dock_cam=T)
    identity = Identity(7, 191, key=signing_key(tmp_path / "key"))
    found = sent(tmp_path, fix, identity, "correct horse battery").values()
    assert {(line["system"], line["component"], line["signed"]) for line in found} == {(7, 191, True)}
    found = sent(tmp_path, fix, identity, "another passphrase").values()
    assert not any(line["signed"] for line in found)


@pytest.fixture(scope="module")
def fast_dds(tmp_path_factory):
    if not Path("/usr/include/fastdds").exists():
        pytest.skip("Fast DDS (libfastrtps-dev) is not on this machine")
    program = tmp_path_factory.mktemp("dds") / "dds"
    command = [need("g++"), "-std=c++17", str(SCRIPTS / "dds.cpp"), "-o", str(program), "-lfastrtps", "-lfastcdr"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return program


def test_fast_dds_receives_poses_and_status(made, fast_dds):
    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = "geometry_msgs::msg::dds_::PoseWithCovarianceStamped_"
    command = [str(fast_dds), "77", "rt/lumidock/pose", kind, "3"]
    reader = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert reader.stdout.readline() == "ready\n"
    served = serve(made / "seq", "--loop", "--dds", "--domain", "77")
    timer = threading.Timer(40.0, reader.kill)
    timer.start()
    try:
        lines = reader.stdout.read().split()
    finally:
        timer.cancel()
        served.terminate()
        served.communicate()
        reader.wait()
    assert len(lines) == 3
    known = [[float(row[name]) for name in POSE] for row in fixes(made / "run") if row["valid"] == "1"]
    for line in lines:
        message = store.deserialize_cdr(bytes.fromhex(line), "geometry_msgs/msg/PoseWithCovarianceStamped")
        p, q = message.pose.pose.position, message.pose.pose.orientation
        assert message.header.frame_id == "dock"
        found = np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w])
        assert np.abs(np.array(known) - found).max(axis=1).min() < 0.05


def test_ros_parses_our_camera_info(tmp_path):
    K = np.array([[800.0, 0, 639.5], [0, 801.0, 511.5], [0, 0, 1]])
    camera = Camera(1280, 1024, K, "plumb_bob", np.array([-0.2, 0.05, 0.001, -0.002, 0.01]))
    save_camera(camera, tmp_path / "camera.yaml", name="front")
    text = (
        "from camera_calibration_parsers import readCalibration as r; import json, sys; n, c = r(sys.argv[1]);"
        "print(json.dumps([n, c.width, c.height, c.distortion_model, list(c.K), list(c.D), list(c.P)]))"
    )
    out = system_python("camera_calibration_parsers", "-c", text, tmp_path / "camera.yaml")
    name, width, height, model, matrix, distortion, _ = json.loads(out)
    assert (name, width, height, model) == ("front", 1280, 1024, "plumb_bob")
    assert_close(np.reshape(matrix, (3, 3)), K)
    assert_close(distortion, camera.distortion)


def test_opencv_reads_our_calibration(tmp_path):
    camera = load_camera(Path(__file__).parents[1] / "src" / "lumidock" / "cameras" / "imx264-60deg.yaml")
    write_calibration(camera, tmp_path / "cv.yaml", "opencv")
    storage = cv2.FileStorage(str(tmp_path / "cv.yaml"), cv2.FILE_STORAGE_READ)
    assert_close(storage.getNode("camera_matrix").mat(), camera.K)


def test_ffprobe_plays_our_video(made):
    command = [need("ffprobe"), "-v", "error", "-count_frames", "-show_streams", "-of", "json", str(made / "fixes.mp4")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    (stream,) = json.loads(done.stdout)["streams"]
    assert (stream["codec_name"], stream["width"], stream["height"], stream["nb_read_frames"]) == (
        "h264",
        320,
        256,
        "7",
    )


def test_foxglove_connects_to_a_server(made):
    port = free_port()
    more = ("--vehicle", made / "vehicle.yaml", "--foxglove", "--foxglove-port", port)
    served = serve(made / "seq", "--loop", *more)
    try:
        wait_for(lambda: socket.socket().connect_ex(("127.0.0.1", port)) == 0)
        found = {line["topic"]: line["content"] for line in node("foxglove.cjs", port, len(TYPES) - 1)}
    finally:
        served.terminate()
        served.communicate()
    assert found["/lumidock/pose"]["header"]["frame_id"] == "dock"
    assert found["/lumidock/image/compressed"]["format"] == "jpeg"
    assert set(found) == set(TYPES) - {"/tf_static"}  # which the vehicle file does not ask for


@pytest.fixture
def rtsp():
    """Start a GStreamer RTSP server on a port, again and again; all are ended after the test."""
    probe = "import gi; gi.require_version('GstRtspServer', '1.0')"
    if subprocess.run([need(SYSTEM_PYTHON), "-c", probe], capture_output=True).returncode:
        pytest.skip("the system's Python has no GStreamer RTSP server")
    running = []

    def serve(port):
        process = subprocess.Popen([SYSTEM_PYTHON, str(SCRIPTS / "rtsp.py"), str(port)], stdout=subprocess.PIPE)
        running.append(process)
        assert process.stdout.readline() == b"ready\n"
        return process

    yield serve
    for process in running:
        process.kill()
        process.wait()
        process.stdout.close()


def take(source, count):
    items = []
    for item in source.items():
        items.append(item)
        if len(items) == count:
            break
    return items


def test_frames_come_from_an_rtsp_server(rtsp):
    port = free_port()
    rtsp(port)
    source = open_live(f"rtsp://user:secret@127.0.0.1:{port}/front")
    assert source.live
    assert "secret" not in str(source.path)
    items = take(source, 20)
    assert all(item.image.shape[:2] == (240, 320) for item in items)
    steps = np.diff([item.t_ns for item in items][5:])
    assert 0.03e9 < np.median(steps) < 0.12e9
    assert abs(items[-1].t_ns - time.time_ns()) < 2e9


def test_serve_comes_back_to_a_camera_that_was_lost(rtsp, made, tmp_path):
    port = free_port()
    camera = Camera(320, 240, np.array([[273.0, 0, 159.5], [0, 273.0, 119.5], [0, 0, 1]]))
    save_camera(camera, tmp_path / "camera.yaml")
    first = rtsp(port)
    options = ("--station", made / "seq" / "station.yaml", "--camera", tmp_path / "camera.yaml")
    served = serve(f"rtsp://127.0.0.1:{port}/front", *options)

    def health():
        import urllib.request

        return json.loads(urllib.request.urlopen(served.url + "health.json").read())

    try:
        wait_for(lambda: health()["camera"]["frames"] > 10)
        assert health()["ok"]
        first.kill()
        wait_for(lambda: health()["camera"]["problem"], 30)
        seen = health()["camera"]["frames"]
        rtsp(port)
        wait_for(lambda: health()["camera"]["frames"] > seen + 10, 30)
        assert health()["camera"]["reconnects"] >= 1
    finally:
        served.send_signal(signal.SIGTERM)
        served.communicate(timeout=20)
    assert served.returncode == 0


def test_frames_come_by_rtp():
    gst, port = need("gst-launch-1.0"), free_port()
    pipeline = (
        "videotestsrc is-live=true ! video/x-raw,width=320,height=240,framerate=15/1 ! "
        "x264enc tune=zerolatency key-int-max=15 ! rtph264pay config-interval=1 pt=96 ! "
        f"udpsink host=127.0.0.1 port={port}"
    )
    sender = subprocess.Popen([gst, "-q", *pipeline.split()], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        items = take(open_live(f"rtp://127.0.0.1:{port}"), 10)
        assert all(item.image.shape[:2] == (240, 320) for item in items)
    finally:
        sender.kill()
        sender.communicate()


def test_frames_come_from_aravis_fake_camera(tmp_path):
    camera = need("arv-fake-gv-camera-0.8")
    if not Path("/usr/lib/python3/dist-packages/gi").exists():
        pytest.skip("python3-gi is not on this machine")
    if sys.version_info[:2] != (3, 11):
        pytest.skip("python3-gi of Debian 12 is made for Python 3.11")
    (tmp_path / "gi").symlink_to("/usr/lib/python3/dist-packages/gi")
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    fake = subprocess.Popen([camera, "-i", "127.0.0.1", "-s", "LUMI"], **quiet)
    program = (
        "import itertools, json; from lumidock.streams.live import open_live\n"
        "items = itertools.islice((i for i in open_live('gige:').items() if hasattr(i, 'image')), 8)\n"
        "print(json.dumps([[i.t_ns, *i.image.shape] for i in items]))"
    )
    try:
        time.sleep(1.0)
        command = [sys.executable, "-c", program]
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=60, env=os.environ | {"PYTHONPATH": str(tmp_path)}
        )
        assert done.returncode == 0, done.stderr
        found = json.loads(done.stdout)
        assert {(height, width) for _, height, width in found} == {(512, 512)}
        assert abs(found[-1][0] - time.time_ns()) < 20e9
        assert all(a[0] < b[0] for a, b in pairwise(found))
    finally:
        fake.kill()
        fake.communicate()
