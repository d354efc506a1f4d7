"""Pictures of ROS topics as a live source: published by another process over zenoh and DDS, into `serve`."""

import csv
import json
import platform
import subprocess
import sys
import threading
import urllib.request
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from bags import STORES, compressed, raw
from commandline import fixes, serve, wait_for
from test_run import simulate

from lumidock.datatypes import Frame, Unusable
from lumidock.errors import InputError
from lumidock.streams import topics
from lumidock.streams.bag_info import names_by_pictures
from lumidock.streams.live import open_live
from lumidock.streams.ros import IMAGE, Message
from lumidock.streams.source import Reading
from lumidock.streams.topics import frames_of

PUBLISHER = Path(__file__).parent / "peers" / "publish.py"
TOPIC = "/front/image_raw"
needs_dds = pytest.mark.skipif(platform.machine() != "x86_64", reason="cyclonedds has no wheels for this machine")


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    return simulate(tmp_path_factory.mktemp("sequence"))


@contextmanager
def published(link, where, folder, rate_hz=4.0):
    """Another process that publishes the pictures of a folder, over and over."""
    command = [sys.executable, PUBLISHER, link, str(where), TOPIC, folder, str(rate_hz)]
    process = subprocess.Popen(list(map(str, command)), stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout.readline() == "ready\n"
        yield process
    finally:
        process.kill()
        process.communicate()


def health(served):
    return json.loads(urllib.request.urlopen(served.url + "health.json").read())


def check_served(sequence, out, *words):
    """A server of a topic, with the camera that is published beside it, gives the fixes of the sequence."""
    served = serve(words[0], "--station", sequence / "station.yaml", "--out", out, *words[1:])
    try:
        wait_for(lambda: health(served)["fixes"]["valid"] >= 5)
    finally:
        served.terminate()
        _, err = served.communicate(timeout=20)
    assert served.returncode == 0, err
    with (sequence / "truth.csv").open(newline="") as file:
        truth = {int(row["t_ns"]): row for row in csv.DictReader(file)}
    span_ns = max(truth) - min(truth) + 3 * 10**9  # of a pass
    valid = [row for row in fixes(out) if row["valid"] == "1"]
    for row in valid:
        true = truth[(int(row["t_ns"]) - min(truth)) % span_ns + min(truth)]
        error = [float(row[name]) - float(true[name]) for name in ("x_m", "y_m", "z_m")]
        assert np.hypot(error[0], error[1]) <= float(row["pl_lateral_m"])
        assert abs(error[2]) <= float(row["pl_axial_m"])


def test_pictures_published_over_zenoh_are_localized(sequence, tmp_path, router):
    with published("zenoh", router.endpoint, sequence):
        check_served(sequence, tmp_path / "live", f"zenoh:{router.endpoint}{TOPIC}")


@needs_dds
def test_pictures_published_over_dds_are_localized_beside_a_sink_in_the_same_domain(sequence, tmp_path):
    with published("dds", 79, sequence):
        check_served(sequence, tmp_path / "live", f"dds:{TOPIC}", "--domain", "79", "--dds")


class Feed:
    """Stands for a network: messages that a test puts in."""

    problem = ""

    def __init__(self):
        self.take = None

    def __call__(self, _topics, take):
        self.take = take
        return self

    def close(self):
        self.take = None


STORE = STORES[2]


def message(made, log_ns=77):
    """A message of a maker of `bags`."""
    content = made(STORE)
    kind = content.__msgtype__
    return Message(TOPIC, kind, "cdr", log_ns, bytes(STORE.serialize_cdr(content, kind)))


def picture(t_ns, value=0):
    return message(raw(t_ns, np.full((4, 6), value, np.uint8), "mono8"), log_ns=t_ns + 77)


def read(*batches, size=None):
    """What a reader yields when each batch of messages comes while it is busy with the item before."""
    feed, items = Feed(), []
    frames = frames_of(feed, {TOPIC: IMAGE}, Reading(), size)

    def first():
        wait_for(lambda: feed.take)
        for one in batches[0]:
            feed.take(one)

    feeder = threading.Thread(target=first)
    feeder.start()
    items.append(next(frames))
    feeder.join()
    for batch in batches[1:]:
        for one in batch:
            feed.take(one)
        items.append(next(frames))
    frames.close()
    assert feed.take is None
    return items


def test_a_slow_reader_gets_the_newest_picture_and_no_older_one():
    items = read([picture(1000)], [picture(1000 * k, k) for k in range(2, 50)])
    assert [(item.name, item.t_ns, item.image[0, 0]) for item in items] == [("000000", 1000, 0), ("000001", 49_000, 49)]


def test_one_clock_holds_for_a_topic():
    assert [item.t_ns for item in read([picture(0)], [picture(5000)])] == [77, 5077]
    first, second = read([picture(5000)], [picture(0)])
    assert (first.t_ns, second.t_ns, second.reason) == (5000, None, "bad_stamp")


def test_what_is_no_picture_is_a_bad_frame_and_the_next_one_is_read(rng):
    png = cv2.imencode(".png", np.full((4, 6), 9, np.uint8))[1].tobytes()
    whole = picture(3)
    batches = [
        [Message(TOPIC, IMAGE, "cdr", 7, whole.data[:30])],
        [Message(TOPIC, IMAGE, "cdr", 7, rng.bytes(200))],
        [Message(TOPIC, "std_msgs/msg/String", "cdr", 7, b"")],
        [message(compressed(4, b"\0\0\0\1\x67abc", "h264"))],
        [message(compressed(5, png))],
    ]
    *bad, good = read(*batches)
    assert [item.reason for item in bad] == ["bad_frame"] * 4
    assert "video is not read live" in bad[-1].text
    assert isinstance(good, Frame)
    (other,) = read([picture(1)], size=(60, 40))
    assert isinstance(other, Unusable)
    assert "60x40" in other.text


@pytest.mark.parametrize(
    "address", ["zenoh:", "zenoh:front", "zenoh:tcp/127.0.0.1/a b", "dds:", "dds:tcp/127.0.0.1:7447/front", "dds:/a//b"]
)
def test_an_address_that_is_none_is_one_line(address):
    with pytest.raises(InputError, match="wanted zenoh:"):
        open_live(address)


def test_a_topic_without_a_calibration_says_where_it_was_looked_for_and_that_no_router_answers(monkeypatch):
    monkeypatch.setattr(topics, "_CALIBRATION_S", 0.7)
    source = open_live("zenoh:tcp/127.0.0.1:1/front/image_raw/compressed")
    assert source.live
    assert "/front/camera_info, /front/image_raw/camera_info, /front/image_raw_info" in source.no_calibration
    assert "no zenoh router or peer answers at tcp/127.0.0.1:1" in source.no_calibration


def test_a_topic_that_falls_silent_is_lost_and_says_why(monkeypatch):
    monkeypatch.setattr(topics, "_LOST_S", 0.3)
    source = open_live("zenoh:tcp/127.0.0.1:1/front/image_raw", reading=Reading(follow_calibration=False))
    with pytest.raises(InputError, match=r"no picture for 0\.3 s: no zenoh router"):
        next(source.items())


def test_the_calibration_of_another_camera_in_the_same_namespace_is_not_taken():
    assert names_by_pictures("/stereo/left") == ("/stereo/left/camera_info", "/stereo/left_info")
    assert names_by_pictures("/left/image_rect")[0] == "/left/camera_info_rect"
