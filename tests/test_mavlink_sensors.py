"""An autopilot's sensors: real MAVLink messages over UDP, and what they say in the axes of the camera."""

import socket
import time

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pymavlink.dialects.v20 import ardupilotmega as dialect
from scipy.spatial.transform import Rotation

from lumidock.geometry import rotation_from_quat_xyzw
from lumidock.streams.mavlink_sensors import MavlinkSensors


@pytest.fixture
def link():
    feed = MavlinkSensors("127.0.0.1", 0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.connect(("127.0.0.1", feed.port))
        encoder = dialect.MAVLink(None, srcSystem=1, srcComponent=1)

        def exchange(*messages):
            for message in messages:
                sender.send(message.pack(encoder) if not isinstance(message, bytes) else message)
            time.sleep(0.05)
            return list(feed.until(None))

        yield encoder, exchange
    feed.close()


@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (0.3, -0.2, 1.0), (-1.2, 0.7, -3.0)])
def test_attitude_gives_rates_and_the_direction_upward(link, angles):
    encoder, exchange = link
    found = exchange(encoder.attitude_encode(1000, *angles, 0.01, -0.02, 0.03))
    assert [one.kind for one in found] == ["gyro", "tilt"]
    assert_allclose(found[0].value, (0.01, -0.02, 0.03), atol=1e-7)
    R_ned_body = Rotation.from_euler("ZYX", angles[::-1]).as_matrix()
    assert_allclose(found[1].value, R_ned_body.T @ [0.0, 0.0, -1.0], atol=1e-6)


def test_a_delta_of_position_is_a_velocity_at_its_middle(link):
    encoder, exchange = link
    first = encoder.vision_position_delta_encode(10_000_000, 200_000, [0, 0, 0], [0.07, 0.0, -0.01], 90.0)
    lost = encoder.vision_position_delta_encode(10_200_000, 200_000, [0, 0, 0], [0.5, 0.0, 0.0], 0.0)
    still = encoder.vision_position_delta_encode(10_300_000, 0, [0, 0, 0], [0.5, 0.0, 0.0], 90.0)
    later = encoder.vision_position_delta_encode(10_400_000, 200_000, [0, 0, 0], [0.08, 0.0, 0.0], 90.0)
    found = exchange(first, lost, still, later)
    assert [one.kind for one in found] == ["velocity", "velocity"]
    assert_allclose(found[0].value, (0.35, 0.0, -0.05), atol=1e-6)
    assert_allclose(found[1].t_ns - found[0].t_ns, 400_000_000, rtol=0.02)
    R_cam_vehicle = rotation_from_quat_xyzw(np.array([-0.5, -0.5, -0.5, 0.5]))
    assert_allclose(R_cam_vehicle @ found[0].value, (0.0, -0.05, 0.35), atol=1e-6)  # forward is z of the camera


def test_rates_of_the_imu_serve_where_there_is_no_attitude_and_damage_is_skipped(link):
    encoder, exchange = link
    imu = encoder.scaled_imu_encode(1000, 0, 0, 0, 10, -20, 30, 0, 0, 0)
    found = exchange(b"\xfd\x00 no message", imu)
    assert_allclose([one.value for one in found], [(0.01, -0.02, 0.03)])
    exchange(encoder.attitude_encode(1100, 0, 0, 0, 0, 0, 0))
    assert exchange(imu) == []
    assert exchange(encoder.attitude_encode(1200, float("nan"), 0, 0, 0, 0, 0)) == []
