"""Video in the messages of bags: encoded here by PyAV, put into bags by rosbags and Foxglove's SDK."""

from fractions import Fraction

import av
import bags
import numpy as np
import pytest
from foxglove.messages import CameraCalibration, CompressedImage, CompressedVideo, RawImage, Timestamp
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import Writer
from rosbags.typesys import get_types_from_msg

from lumidock.datatypes import Frame, Unusable
from lumidock.streams.packets import Packets
from lumidock.streams.ros import typestore
from lumidock.streams.source import Reading
from lumidock.streams.sources import open_source

LEVELS = (20, 60, 100, 140, 180, 220)
TOPIC, START = "/cam/image_raw/compressed", 1_700_000_000 * 10**9


def encoded(codec, b_frames=0):
    """A packet for each of six pictures of rising level, with its number in order of presentation."""
    context = av.CodecContext.create(codec, "w")
    context.width, context.height, context.pix_fmt = 64, 48, "yuv420p"
    context.time_base = Fraction(1, 10)
    quiet = {"x265-params": f"log-level=none:bframes={b_frames}:repeat-headers=1"} if codec == "libx265" else {}
    context.options = {"crf": "4", "bf": str(b_frames), "preset": "fast"} | quiet
    found = []
    for i, level in enumerate(LEVELS):
        frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), level, np.uint8), "bgr24")
        frame.pts = i
        found += context.encode(frame)
    return [(packet.pts, bytes(packet)) for packet in (*found, *context.encode(None))]


@pytest.fixture(scope="module")
def h264():
    return encoded("libx264")


def a_bag(path, packets, form="h264", kind="mcap"):
    return bags.write(path, kind, [(TOPIC, START + i, bags.compressed(START + i, d, form)) for i, d in packets])


def levels(items):
    return [int(np.median(item.image)) if isinstance(item, Frame) else None for item in items]


@pytest.mark.parametrize("kind", bags.KINDS)
@pytest.mark.parametrize(
    ("codec", "form"), [("libx264", "h264"), ("libx264", ""), ("libx265", "hevc"), ("libx265", "")]
)
def test_video_in_compressed_images_is_decoded(tmp_path, kind, codec, form):
    items = list(open_source(a_bag(tmp_path / "a", encoded(codec), form, kind)).items())
    assert [item.t_ns - START for item in items] == list(range(6))
    assert np.abs(np.subtract(levels(items), LEVELS)).max() <= 3


def test_frames_that_were_reordered_keep_their_stamps(tmp_path):
    packets = encoded("libx264", b_frames=2)
    assert [number for number, _ in packets] != list(range(6))
    items = list(open_source(a_bag(tmp_path / "a", packets)).items())
    assert [item.t_ns - START for item in items] == list(range(6))
    assert np.abs(np.subtract(levels(items), LEVELS)).max() <= 3


def test_what_cannot_be_decoded_costs_its_own_frames(tmp_path, h264):
    packets = [(10 + i, data) for i, data in h264[1:]] + [(20 + i, data) for i, data in h264]
    items = list(open_source(a_bag(tmp_path / "a", packets)).items())
    assert len(items) == 11
    assert levels(items)[:5] == [None] * 5
    assert np.abs(np.subtract(levels(items)[5:], LEVELS)).max() <= 3
    assert "key frame" in items[0].text


def test_another_size_is_a_bad_frame(tmp_path, h264):
    items = list(open_source(a_bag(tmp_path / "a", h264)).items((32, 24)))
    assert {type(item) for item in items} == {Unusable}
    assert "64x48 pixels, the camera has 32x24" in items[0].text


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(draw=st.data())
def test_no_spoilt_video_raises(h264, draw):
    data = [bytearray(packet) for _, packet in h264]
    for _ in range(draw.draw(st.integers(1, 6))):
        packet = data[draw.draw(st.integers(0, 5))]
        packet[draw.draw(st.integers(0, len(packet) - 1))] = draw.draw(st.integers(0, 255))
    decoder, done = Packets("h264", False, None), []
    for number, packet in enumerate(data):
        done += [number for number, _ in decoder.feed(number, bytes(packet))]
    done += [number for number, _ in decoder.flush()]
    assert sorted(done) == list(range(6))


VIDEO, FFMPEG = "foxglove_msgs/msg/CompressedVideo", "ffmpeg_image_transport_msgs/msg/FFMPEGPacket"
DEFINITIONS = {  # as the packages have them
    VIDEO: "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format",
    FFMPEG: (
        "std_msgs/Header header\nint32 width\nint32 height\nstring encoding\nuint64 pts\nuint8 flags\n"
        "bool is_bigendian\nuint8[] data"
    ),
}


def package_bag(path, kind, form, packets):
    """A bag with video in messages of another package."""
    store = bags.STORES[2]
    if kind not in store.types:
        store.register(get_types_from_msg(DEFINITIONS[kind], kind))

    def make(number, data):
        def message(store):
            header, data_ = bags.header(store, START + number), np.frombuffer(data, np.uint8)
            if kind == VIDEO:
                return store.types[kind](header.stamp, "cam", data_, form)
            return store.types[kind](header, 64, 48, form, number, 0, False, data_)

        return message

    return bags.write(path, "mcap", [("/cam/video", START + i, make(i, d)) for i, d in packets])


@pytest.mark.parametrize(("kind", "form"), [(VIDEO, "h264"), (FFMPEG, "libx264"), (FFMPEG, "h264;yuv420p;bgr8;bgr8")])
def test_messages_of_other_packages_are_read(tmp_path, h264, kind, form):
    items = list(open_source(package_bag(tmp_path / "a", kind, form, h264)).items())
    assert [item.t_ns - START for item in items] == list(range(6))
    assert np.abs(np.subtract(levels(items), LEVELS)).max() <= 3
    assert kind in typestore("cdr").types


PICTURE = np.arange(64 * 48, dtype=np.uint8).reshape(48, 64)


def foxglove_file(path, packets):
    """An MCAP file of Foxglove's own messages: a calibration, video, a picture as raw pixels and as PNG."""
    t = Timestamp(1_700_000_000, 5)
    K, P = [70.0, 0, 31, 0, 70, 23, 0, 0, 1], [70.0, 0, 31, 0, 0, 70, 23, 0, 0, 0, 1, 0]
    info = CameraCalibration(
        timestamp=t, frame_id="cam", width=64, height=48, distortion_model="plumb_bob", D=[0.1] * 5, K=K, R=K, P=P
    )
    raw = RawImage(timestamp=t, frame_id="cam", width=64, height=48, encoding="mono8", step=64, data=PICTURE.tobytes())
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        messages = [("/cam/camera_info", info), ("/raw/image", raw)]
        messages += [
            ("/cam/video", CompressedVideo(timestamp=t, frame_id="cam", data=d, format="h264")) for _, d in packets
        ]
        messages += [("/png/image", CompressedImage(timestamp=t, frame_id="png", data=png(PICTURE), format="png"))]
        channels = {}
        for number, (topic, message) in enumerate(messages):
            if topic not in channels:
                schema = writer.register_schema(f"foxglove.{type(message).__name__}", "protobuf", b"")
                channels[topic] = writer.register_channel(topic, "protobuf", schema)
            writer.add_message(channels[topic], START + number, message.encode(), START + number)
        writer.finish()
    return path


def test_protobuf_of_foxglove_is_read(tmp_path, h264):
    path = foxglove_file(tmp_path / "a.mcap", h264)
    source = open_source(path, Reading(topic="/cam/video"))
    assert np.abs(np.subtract(levels(source.items()), LEVELS)).max() <= 3
    assert source.calibration.focal_px[0] == 70.0
    for topic in ("/raw/image", "/png/image"):
        (item,) = open_source(path, Reading(topic=topic)).items()
        assert (item.t_ns, np.array_equal(item.image, PICTURE)) == (START + 5, True)


def png(image):
    import cv2

    return cv2.imencode(".png", image)[1].tobytes()
