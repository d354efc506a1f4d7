"""The ROS 2 packages in ros/: the node's logic without ROS, and files that fit what lumidock publishes."""

import ast
import json
import subprocess
import sys
from dataclasses import fields
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml
from bags import STORES, info, raw
from commandline import VEHICLE
from conftest import assert_close
from test_run import CAMERA, simulate

from lumidock.errors import InputError
from lumidock.geometry import pose_from_quat
from lumidock.streams.rostypes import STATUS_MSG, TYPES, typestore
from lumidock.streams.sources import open_source

ROS = Path(__file__).parents[1] / "ros"
PACKAGE = ROS / "lumidock_ros"
sys.path.insert(0, str(PACKAGE))
from lumidock_ros.bridge import Bridge, Options  # noqa: E402

KIND = "sensor_msgs/msg/Image"
STORE = STORES[2]


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    folder = simulate(tmp_path_factory.mktemp("sequence"))
    (folder / "vehicle.yaml").write_text(VEHICLE)
    return folder


def bytes_of(make):
    content = make(STORE)
    return bytes(STORE.serialize_cdr(content, content.__msgtype__))


def pictures(folder):
    for item in open_source(folder).items():
        yield bytes_of(raw(item.t_ns, item.image, "mono8" if item.image.ndim == 2 else "bgr8"))


def options(folder, **more):
    return Options(station=str(folder / "station.yaml"), vehicle=str(folder / "vehicle.yaml"), **more)


def test_serialized_pictures_become_serialized_poses_once_the_camera_is_known(sequence):
    bridge = Bridge.of(options(sequence), "/front/image_raw")
    first = next(pictures(sequence))
    assert list(bridge.image(KIND, first, 0)) == []
    bridge.info(bytes_of(info(0, CAMERA)))
    found = {}
    for picture in pictures(sequence):
        for message in bridge.image(KIND, picture, 0):
            content = typestore().deserialize_cdr(message.data, TYPES[message.topic])
            found.setdefault(message.topic, []).append(content)
    assert set(found) <= set(bridge.topics())
    assert len(found["/lumidock/status"]) == 7
    assert len(found["/lumidock/pose"]) >= 3
    truth = open_source(sequence).path / "truth.csv"
    last = truth.read_text().splitlines()[-1].split(",")
    pose = found["/lumidock/pose"][-1].pose.pose
    p, q = pose.position, pose.orientation
    T = pose_from_quat([p.x, p.y, p.z], [q.x, q.y, q.z, q.w])
    assert_close(T[:3, 3], [float(word) for word in last[2:5]], atol=0.05)


def test_a_damaged_picture_is_a_bad_frame_of_the_status(sequence):
    bridge = Bridge.of(options(sequence, camera=str(sequence / "camera.yaml")), "/front/image_raw")
    (status, *_) = bridge.image(KIND, next(pictures(sequence))[:100], 5_000_000_000)
    content = typestore().deserialize_cdr(status.data, TYPES[status.topic])
    assert (content.reason, content.header.stamp.sec) == ("bad_frame", 5)


@pytest.mark.parametrize(
    ("change", "match"),
    [({"station": ""}, "parameter station"), ({"method": "magic"}, "magic"), ({"camera": "no.yaml"}, "no.yaml")],
)
def test_a_parameter_that_cannot_be_is_one_line(sequence, change, match):
    given = {"station": str(sequence / "station.yaml")} | change
    with pytest.raises(InputError, match=match):
        Bridge.of(Options(**given), "/image")


def test_a_calibration_that_no_camera_has_is_refused(sequence):
    bridge = Bridge.of(options(sequence), "/front/image_raw")
    with pytest.raises(InputError, match="principal point"):
        bridge.info(bytes_of(info(0, CAMERA, k=[273.0, 0, 20, 0, 273, 20, 0, 0, 1])))
    assert bridge.camera is None


def test_the_message_is_the_one_that_is_published():
    assert (ROS / "lumidock_msgs" / "msg" / "Status.msg").read_text() == STATUS_MSG


def test_parameters_are_those_that_the_node_declares():
    content = yaml.safe_load((PACKAGE / "config" / "lumidock.yaml").read_text())
    declared = {field.name for field in fields(Options)} | {"compressed"}
    assert set(content["lumidock"]["ros__parameters"]) <= declared
    launch = ast.parse((PACKAGE / "launch" / "lumidock.launch.py").read_text())
    (named,) = (n.value for n in launch.body if isinstance(n, ast.Assign) and n.targets[0].id == "FILES")
    assert set(ast.literal_eval(named)) <= declared


def test_filters_are_given_what_is_published():
    ekf = yaml.safe_load((PACKAGE / "config" / "robot_localization.yaml").read_text())["ekf_dock"]["ros__parameters"]
    assert TYPES[ekf["pose0"]] == "geometry_msgs/msg/PoseWithCovarianceStamped"
    assert TYPES[ekf["odom0"]] == "nav_msgs/msg/Odometry"
    assert len(ekf["pose0_config"]) == len(ekf["odom0_config"]) == 15  # x y z, angles, their rates, accelerations
    dock = yaml.safe_load((PACKAGE / "config" / "docking_server.yaml").read_text())["docking_server"]
    parameters = dock["ros__parameters"]
    assert parameters["cage"]["type"] in parameters["dock_plugins"]


def topics_in(content):
    """All that looks like a topic in a layout."""
    if isinstance(content, dict):
        yield from (word for key in content for word in topics_in(key))
        yield from (word for value in content.values() for word in topics_in(value))
    elif isinstance(content, list):
        yield from (word for value in content for word in topics_in(value))
    elif isinstance(content, str) and content.startswith("/"):
        yield content.partition(".")[0]


@pytest.mark.parametrize("layout", ["rviz/lumidock.rviz", "foxglove/lumidock.json"])
def test_layouts_show_topics_that_there_are(layout):
    text = (PACKAGE / layout).read_text()
    shown = set(topics_in(json.loads(text) if layout.endswith("json") else yaml.safe_load(text)))
    assert len(shown) >= 4
    assert shown <= set(TYPES)


def test_the_foxglove_layout_places_panels_that_there_are():
    content = json.loads((PACKAGE / "foxglove" / "lumidock.json").read_text())

    def leaves(part):
        return [part] if isinstance(part, str) else [*leaves(part["first"]), *leaves(part["second"])]

    assert sorted(leaves(content["layout"])) == sorted(content["configById"])


def test_rerun_takes_the_blueprint(tmp_path):
    target = tmp_path / "lumidock.rbl"
    script = PACKAGE / "rerun" / "blueprint.py"
    assert subprocess.run([sys.executable, script, target], capture_output=True).returncode == 0
    done = subprocess.run([Path(sys.executable).with_name("rerun"), "rrd", "print", target], capture_output=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("package", ["lumidock_msgs", "lumidock_ros"])
def test_packages_are_described(package):
    root = ElementTree.parse(ROS / package / "package.xml").getroot()
    assert root.findtext("name") == package
    for script in (ROS / package).rglob("*.py"):
        ast.parse(script.read_text())
