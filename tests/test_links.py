"""Fixes over zenoh and DDS, as another session of the same libraries gets them; foreign clients are in test_peers."""

import platform
import re
import time

import numpy as np
import pytest
from commandline import AHEAD, wait_for
from conftest import assert_close
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from test_run import CAMERA
from zenoh.ext import Int64, z_deserialize

from lumidock.datatypes import Fix, Frame, Velocity
from lumidock.streams import rostypes
from lumidock.streams.ros2 import Publication
from lumidock.streams.rostypes import dds_name
from lumidock.streams.vehicle import Vehicle
from lumidock.streams.zenohlink import ZenohLink

T = np.diag([1.0, -1, -1, 1])
T[:3, 3] = [0.25, -0.5, 6.0]
VELOCITY = Velocity(np.array([0.0, 0.0, 0.4]), np.zeros(3), np.eye(6) * 0.01)
FIX = Fix("a", 1_700_000_000_123_456_789, "tracking", "rear", 3, 3, T, covariance=np.eye(6) * 0.01, velocity=VELOCITY)
MOUNTED = Vehicle(AHEAD, mounting_transform=True)
FRAME = Frame("a", FIX.t_ns, np.zeros((256, 320), np.uint8))


def test_ros2_messages_go_over_zenoh(router):
    received, tokens = {}, []
    subscriber = router.session.declare_subscriber(
        "5/**", lambda sample: received.setdefault(str(sample.key_expr), sample)
    )
    watcher = router.session.liveliness().declare_subscriber(
        "@ros2_lv/5/**", lambda sample: tokens.append(str(sample.key_expr)), history=True
    )
    link = ZenohLink(router.endpoint, 5, Publication(CAMERA, MOUNTED, ("A",)))
    wait_for(lambda: len(tokens) >= 8)

    def all_received():
        link.add(FRAME, FIX, 1500)
        time.sleep(0.05)
        return len(received) == len(rostypes.TYPES)

    wait_for(all_received)
    link.close()
    subscriber.undeclare()
    watcher.undeclare()
    kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
    store = get_typestore(Stores.ROS2_JAZZY)
    sample = received[f"5/lumidock/pose/{dds_name(kind)}/{store.hash_rihs01(kind)}"]
    message = store.deserialize_cdr(sample.payload.to_bytes(), kind)
    p = message.pose.pose.position
    assert_close([p.x, p.y, p.z], T[:3, 3])
    assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == FIX.t_ns
    sequence, stamp, gid = z_deserialize(tuple[Int64, Int64, bytes], sample.attachment)
    assert int(sequence) > 0
    assert abs(int(stamp) - time.time_ns()) < 60e9
    assert len(gid) == 16
    assert any(re.search(r"/MP/%/%/lumidock/%lumidock%pose/geometry_msgs::msg::dds_", token) for token in tokens)


def test_without_a_router_nothing_waits():
    link = ZenohLink("tcp/127.0.0.1:1", 0, Publication(CAMERA, None, ("A",)))
    begin = time.monotonic()
    for _ in range(50):
        link.add(FRAME, FIX, 1500)
    assert time.monotonic() - begin < 2.0
    link.close()


def test_an_endpoint_that_is_none_is_an_error():
    with pytest.raises(OSError, match="nonsense"):
        ZenohLink("nonsense", 0, Publication(CAMERA, None, ("A",)))


@pytest.mark.skipif(platform.machine() != "x86_64", reason="cyclonedds has no wheels for this machine")
def test_ros2_messages_go_over_dds():
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic

    from lumidock.streams.ddslink import DdsLink, dds_type

    link = DdsLink(78, False, Publication(CAMERA, MOUNTED, ("A",)))
    participant = DomainParticipant(78)
    readers = {
        topic: DataReader(participant, Topic(participant, f"rt{topic}", dds_type(rostypes.TYPES[topic])))
        for topic in ("/lumidock/pose", "/tf", "/tf_static")
    }
    found = {}

    def all_found():
        link.add(FRAME, FIX, 1500)
        for topic, reader in readers.items():
            for sample in reader.take(10):
                found[topic] = sample
        return len(found) == 3

    wait_for(all_found)
    link.close()
    pose = found["/lumidock/pose"]
    assert (pose.header.frame_id, pose.pose.pose.position.z, pose.pose.covariance[0]) == ("dock", 6.0, 0.01)
    assert found["/tf"].transforms[0].child_frame_id == "dock"
    assert found["/tf_static"].transforms[0].child_frame_id == "camera_optical"


def test_the_status_message_is_its_own_documentation():
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(rostypes.STATUS_MSG, "lumidock_msgs/msg/Status"))
    assert store.hash_rihs01("lumidock_msgs/msg/Status") == rostypes.type_hash("lumidock_msgs/msg/Status")
    lines = rostypes.STATUS_MSG.splitlines()[1:]
    assert all("#" in line for line in lines)


def test_a_known_hash_is_found_again():
    # std_msgs/String of ROS 2, as `ros2 topic info --verbose` prints it
    assert rostypes.type_hash("std_msgs/msg/String") == (
        "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
    )
