"""Publishes the pictures of a sequence folder as ROS 2 does, by a library of zenoh or DDS alone, until it is killed.

Usage: publish.py zenoh ENDPOINT|dds DOMAIN TOPIC FOLDER [RATE_HZ]. The message types are written down here anew.
"""

import csv
import itertools
import json
import struct
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import yaml

link, where, topic, folder, rate_hz = sys.argv[1], sys.argv[2], sys.argv[3], Path(sys.argv[4]), float(sys.argv[5])
rows = list(csv.DictReader((folder / "timestamps.csv").open(newline="")))
pictures = [(int(r["t_ns"]), cv2.imread(str(folder / "frames" / r["file"]), cv2.IMREAD_UNCHANGED)) for r in rows]
camera = yaml.safe_load((folder / "camera.yaml").read_text())
info_topic = topic.rpartition("/")[0] + "/camera_info"


def by_zenoh():
    import zenoh

    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([where]))
    session = zenoh.open(config)
    image = session.declare_publisher(f"0{topic}/sensor_msgs::msg::dds_::Image_/RIHS01_0")
    info = session.declare_publisher(f"0{info_topic}/sensor_msgs::msg::dds_::CameraInfo_/RIHS01_0")

    def text(data, value):
        data += b"\0" * (-(len(data) - 4) % 4)
        raw = value.encode() + b"\0"
        return data + struct.pack("<I", len(raw)) + raw

    def padded(data, size):
        return data + b"\0" * (-(len(data) - 4) % size)

    def head(t_ns):
        return text(b"\0\1\0\0" + struct.pack("<iI", *divmod(t_ns, 10**9)), "front_optical")

    def send(t_ns, picture, _session=session):
        height, width = picture.shape[:2]
        data = padded(head(t_ns), 4) + struct.pack("<II", height, width)
        data = text(data, "mono8" if picture.ndim == 2 else "bgr8")
        data = padded(data + b"\0", 4) + struct.pack("<I", picture.strides[0])
        image.put(data + struct.pack("<I", picture.nbytes) + picture.tobytes())
        data = padded(head(t_ns), 4) + struct.pack("<II", camera["image_height"], camera["image_width"])
        data = padded(text(data, camera["distortion_model"]), 4)
        d = camera["distortion_coefficients"]["data"]
        data = padded(data + struct.pack("<I", len(d)), 8) + struct.pack(f"<{len(d)}d", *d)
        k = camera["camera_matrix"]["data"]
        for matrix in (k, [1, 0, 0, 0, 1, 0, 0, 0, 1], [*k[:3], 0, *k[3:6], 0, *k[6:], 0]):
            data = padded(data, 8) + struct.pack(f"<{len(matrix)}d", *matrix)
        info.put(data + struct.pack("<II", 0, 0) + struct.pack("<IIII?", 0, 0, 0, 0, False))

    return send


def by_dds():
    from cyclonedds.core import Policy, Qos
    from cyclonedds.domain import Domain, DomainParticipant
    from cyclonedds.idl import IdlStruct
    from cyclonedds.idl.types import array, float64, int32, sequence, uint8, uint32
    from cyclonedds.pub import DataWriter
    from cyclonedds.topic import Topic

    def made(name, **fields):
        package, _, word = name.rpartition("/")
        space = {"__annotations__": fields, "__module__": __name__}
        return dataclass(type(f"{word}_", (IdlStruct,), space, typename=f"{package}.msg.dds_.{word}_"))

    stamp = made("builtin_interfaces/Time", sec=int32, nanosec=uint32)
    header = made("std_msgs/Header", stamp=stamp, frame_id=str)
    roi = made(
        "sensor_msgs/RegionOfInterest", x_offset=uint32, y_offset=uint32, height=uint32, width=uint32, do_rectify=bool
    )
    image = made(
        "sensor_msgs/Image",
        header=header,
        height=uint32,
        width=uint32,
        encoding=str,
        is_bigendian=uint8,
        step=uint32,
        data=sequence[uint8],
    )
    info = made(
        "sensor_msgs/CameraInfo",
        header=header,
        height=uint32,
        width=uint32,
        distortion_model=str,
        d=sequence[float64],
        k=array[float64, 9],
        r=array[float64, 9],
        p=array[float64, 12],
        binning_x=uint32,
        binning_y=uint32,
        roi=roi,
    )
    local = (
        "<CycloneDDS><Domain><General><Interfaces><NetworkInterface address='127.0.0.1'/></Interfaces><AllowMulticast>"
        "false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex><Peers><Peer "
        "address='127.0.0.1'/></Peers></Discovery></Domain></CycloneDDS>"
    )
    domain = Domain(int(where), local)
    participant = DomainParticipant(int(where))
    qos = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(1))
    images = DataWriter(participant, Topic(participant, f"rt{topic}", image), qos)
    infos = DataWriter(participant, Topic(participant, f"rt{info_topic}", info), qos)

    def send(t_ns, picture, _domain=domain):
        height, width = picture.shape[:2]
        head = header(stamp(*divmod(t_ns, 10**9)), "front_optical")
        encoding = "mono8" if picture.ndim == 2 else "bgr8"
        images.write(image(head, height, width, encoding, 0, picture.strides[0], list(picture.tobytes())))
        k = [float(v) for v in camera["camera_matrix"]["data"]]
        p = [*k[:3], 0.0, *k[3:6], 0.0, *k[6:], 0.0]
        d = [float(v) for v in camera["distortion_coefficients"]["data"]]
        unit = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
        size = camera["image_height"], camera["image_width"]
        infos.write(info(head, *size, camera["distortion_model"], d, k, unit, p, 0, 0, roi(0, 0, 0, 0, False)))

    return send


send = by_zenoh() if link == "zenoh" else by_dds()
print("ready", flush=True)
span_ns = pictures[-1][0] - pictures[0][0] + 3 * 10**9  # between two passes, longer than any track lives
for turn in itertools.count():
    for t_ns, picture in pictures:
        send(t_ns + turn * span_ns, picture)
        time.sleep(1.0 / rate_hz)
