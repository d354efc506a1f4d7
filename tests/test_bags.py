import bz2
import io
import sqlite3
import struct
import zlib
from types import SimpleNamespace

import bags
import cv2
import lz4.frame
import numpy as np
import pytest
import zstandard
from conftest import refused
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from numpy.testing import assert_array_equal

from lumidock.camera import Camera
from lumidock.datatypes import MOSAICS, Frame, Unusable
from lumidock.errors import LumidockError
from lumidock.streams.inspection import inspect
from lumidock.streams.source import Reading, delayed
from lumidock.streams.sources import open_source

CAMERA = Camera(8, 6, np.array([[10.0, 0, 3], [0, 11.0, 2], [0, 0, 1]]), "plumb_bob", np.array([0.1, 0, 0, 0.01, 0]))
MONO = np.random.default_rng(5).integers(0, 256, (6, 6, 8), np.uint8)
COLOR = np.random.default_rng(6).integers(0, 256, (6, 8, 3), np.uint8)
DEEP, DEEP_COLOR = (
    np.random.default_rng(7).integers(0, 65536, shape, np.uint16) for shape in (MONO.shape, COLOR.shape)
)
TOPIC, SECOND = "/front/image_raw", 10**9


def series(pictures=MONO, topic=TOPIC):
    return [(topic, (i + 2) * SECOND, bags.raw(i * SECOND + 7, p, "mono8")) for i, p in enumerate(pictures)]


def make(path, kind, messages, **options):
    return bags.write(path / kind, kind, messages, **options)


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """Six pictures and a calibration, as the bytes of each kind of bag; small chunks in MCAP."""
    folder = tmp_path_factory.mktemp("good")
    messages = [("/front/camera_info", 6, bags.info(6, CAMERA)), *series()]
    found = {kind: make(folder, kind, messages) for kind in ("db3", "bag")}
    found = {kind: (path / f"{kind}.db3" if kind == "db3" else path).read_bytes() for kind, path in found.items()}
    return found | {"mcap": chunked(messages)}


def chunked(messages, compression=CompressionType.ZSTD):
    """An MCAP file with a chunk for each message, by the library mcap."""
    store, file, channels = bags.STORES[2], io.BytesIO(), {}
    writer = McapWriter(file, chunk_size=1, compression=compression)
    writer.start("ros2")
    for topic, t_ns, maker in messages:
        message = maker(store)
        if topic not in channels:
            schema = writer.register_schema(message.__msgtype__, "ros2msg", b"")
            channels[topic] = writer.register_channel(topic, "cdr", schema)
        data = store.serialize_cdr(message, message.__msgtype__)
        writer.add_message(channels[topic], t_ns, bytes(data), t_ns)
    writer.finish()
    return file.getvalue()


@pytest.mark.parametrize(
    ("kind", "compression"),
    [("mcap", None), ("mcap", "zstd"), ("db3", None), ("db3", "zstd"), ("bag", None), ("bag", "lz4"), ("bag", "bz2")],
)
def test_pictures_stamps_and_calibration_come_out_of_a_bag(tmp_path, kind, compression):
    if (kind, compression) == ("mcap", "zstd"):
        (tmp_path / "mcap.mcap").write_bytes(chunked([("/front/camera_info", 6, bags.info(6, CAMERA)), *series()]))
        path = tmp_path / "mcap.mcap"
    else:
        messages = [("/front/camera_info", 6, bags.info(6, CAMERA)), *series()]
        path = make(tmp_path, kind, messages, compression=compression)
    source = open_source(path)
    items = list(source.items())
    assert [(item.name, item.t_ns) for item in items] == [(f"{i:06d}", i * SECOND + 7) for i in range(6)]
    assert_array_equal([item.image for item in items], MONO)
    assert (source.kind, source.count) == ("bag", 6)
    assert_array_equal(source.calibration.K, CAMERA.K)
    assert_array_equal(source.calibration.distortion, CAMERA.distortion)


ENCODINGS = {
    "mono8": (MONO[0], MONO[0]),
    "mono16": (DEEP[0], DEEP[0]),
    "bgr8": (COLOR, COLOR),
    "rgb8": (COLOR[..., ::-1], COLOR),
    "bgra8": (np.dstack([COLOR, MONO[0]]), COLOR),
    "rgba8": (np.dstack([COLOR[..., ::-1], MONO[0]]), COLOR),
    "bgr16": (DEEP_COLOR, DEEP_COLOR),
    "rgb16": (DEEP_COLOR[..., ::-1], DEEP_COLOR),
    "8UC1": (MONO[0], MONO[0]),
    "16UC1": (DEEP[0], DEEP[0]),
    **{f"{mosaic}8": (MONO[0], MONO[0]) for mosaic in MOSAICS},
    **{f"{mosaic}16": (DEEP[0], DEEP[0]) for mosaic in MOSAICS},
}


@pytest.mark.parametrize("kind", bags.KINDS)
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_an_encoding_is_read(tmp_path, kind, encoding):
    pixels, wanted = ENCODINGS[encoding]
    swapped = pixels.byteswap() if pixels.dtype == np.uint16 else pixels
    messages = [
        (TOPIC, 1, bags.raw(1, pixels, encoding)),
        (TOPIC, 2, bags.raw(2, pixels, encoding, padding=6)),
        (TOPIC, 3, bags.raw(3, swapped, encoding, big=True)),
    ]
    for item in open_source(make(tmp_path, kind, messages)).items():
        assert item.image.dtype == wanted.dtype
        assert_array_equal(item.image, wanted)
        assert item.encoding == (encoding if encoding.startswith("bayer") else "")


@pytest.mark.parametrize("encoding", ["mono16", "bayer_grbg16"])
def test_twelve_bits_in_sixteen_get_their_full_scale(tmp_path, encoding):
    pixels = np.array([[0, 1, 2048, 4095], [4096, 65535, 100, 7]], np.uint16)  # more than twelve bits are white
    wanted = [[0, 16, 32768, 65520], [65520, 65520, 1600, 112]]
    (item,) = open_source(make(tmp_path, "mcap", [(TOPIC, 1, bags.raw(1, pixels, encoding))]), Reading(bits=12)).items()
    assert_array_equal(item.image, wanted)
    cv2.imwrite(str(tmp_path / "0.png"), pixels)
    (item,) = open_source(tmp_path, Reading(1.0, bits=12)).items() if encoding == "mono16" else (item,)
    assert_array_equal(item.image, wanted)


@pytest.mark.parametrize(
    ("form", "encoding"),
    [
        ("bayer_grbg8; png compressed ", "bayer_grbg8"),
        ("bayer_grbg8; png compressed mono8", ""),
        ("bayer_grbg; png compressed", ""),
        ("png", ""),
    ],
)
def test_a_mosaic_compressed_as_it_is_stays_one(tmp_path, form, encoding):
    png = cv2.imencode(".png", MONO[0])[1].tobytes()
    (item,) = open_source(make(tmp_path, "mcap", [(TOPIC, 1, bags.compressed(1, png, form))])).items()
    assert_array_equal(item.image, MONO[0])
    assert item.encoding == encoding


def test_compressed_pictures_are_read_and_bad_ones_told(tmp_path):
    png = cv2.imencode(".png", COLOR)[1].tobytes()
    messages = [
        (f"{TOPIC}/compressed", i, bags.compressed(i, d)) for i, d in enumerate([png, png[:40], b"", b"GIF"], 1)
    ]
    items = list(open_source(make(tmp_path, "mcap", messages)).items())
    assert_array_equal(items[0].image, COLOR)
    assert [(type(item), item.t_ns) for item in items[1:]] == [(Unusable, 2), (Unusable, 3), (Unusable, 4)]


def test_a_stamp_of_zero_is_the_time_of_recording(tmp_path):
    (item,) = open_source(make(tmp_path, "mcap", [(TOPIC, 12345, bags.raw(0, MONO[0], "mono8"))])).items()
    assert item.t_ns == 12345


def test_one_of_several_topics_has_to_be_chosen(tmp_path):
    png = cv2.imencode(".png", MONO[0])[1].tobytes()
    copy = [(f"{TOPIC}/compressed", 1, bags.compressed(1, png))]
    path = make(tmp_path, "mcap", [*series(), *copy, *series(MONO[:2], "/rear/image_raw")])
    with refused(path, "choose with --topic; there are /front/image_raw, /rear/image_raw"):
        open_source(path)
    assert len(list(open_source(path, Reading(topic="/rear/image_raw")).items())) == 2
    assert len(list(open_source(path, Reading(topic=f"{TOPIC}/compressed")).items())) == 1
    with refused(path, "no pictures there"):
        open_source(path, Reading(topic="/none"))


def test_the_calibration_is_the_one_beside_the_pictures(tmp_path):
    other = Camera(8, 6, np.diag([99.0, 99, 1]))
    messages = [
        ("/rear/camera_info", 5, bags.info(5, other)),
        ("/front/camera_info", 6, bags.info(6, CAMERA)),
        *series(),
    ]
    assert_array_equal(open_source(make(tmp_path, "mcap", messages)).calibration.K, CAMERA.K)


def test_one_clock_holds_for_a_topic(tmp_path):
    now = 1_700_000_000 * SECOND
    messages = [(TOPIC, now + i, bags.raw(t, MONO[0], "mono8")) for i, t in enumerate([now + 5, 0, now + 7])]
    items = list(open_source(make(tmp_path, "mcap", messages)).items())
    assert [(type(item), item.t_ns) for item in items] == [(Frame, now + 5), (Unusable, None), (Frame, now + 7)]
    assert items[1].reason == "bad_stamp"
    simulated = [(TOPIC, now + i, bags.raw(i * SECOND, MONO[0], "mono8")) for i in range(3)]
    assert [item.t_ns for item in open_source(make(tmp_path / "sim", "mcap", simulated)).items()] == [
        0,
        SECOND,
        2 * SECOND,
    ]


def test_the_time_of_a_simulation_is_named(tmp_path):
    now = 1_700_000_000 * SECOND
    messages = [(TOPIC, now + i, bags.raw(5 * SECOND + i, MONO[0], "mono8")) for i in range(3)]
    source = open_source(make(tmp_path, "mcap", messages))
    assert [item.t_ns for item in source.items()] == [5 * SECOND + i for i in range(3)]
    assert "simulation" in source.notes[0]
    messages = [(TOPIC, now + i, bags.raw(now - 3600 * SECOND, MONO[0], "mono8")) for i in range(3)]
    assert "-3600 s off" in open_source(make(tmp_path / "off", "mcap", messages)).notes[0]


def test_a_delay_is_taken_off_every_stamp(tmp_path):
    source = open_source(make(tmp_path, "mcap", series()))
    assert [i.t_ns for i in delayed(source, 40.0).items()] == [i.t_ns - 40_000_000 for i in source.items()]


def test_a_bag_that_is_still_written_opens(tmp_path, good):
    path = tmp_path / "dive.bag.active"
    path.write_bytes(good["bag"])
    assert len(list(open_source(path).items())) == 6


def test_a_bag_packed_as_a_file_says_how_to_open_it(tmp_path):
    (tmp_path / "dive_0.db3.zstd").write_bytes(zstandard.compress(b"x"))
    (tmp_path / "metadata.yaml").touch()
    for path in (tmp_path, tmp_path / "dive_0.db3.zstd"):
        with refused(path, "zstd -d dive_0.db3.zstd"):
            open_source(path)


def test_several_bags_in_a_folder_are_not_one(tmp_path):
    for name in ("monday", "tuesday"):
        (tmp_path / f"{name}.mcap").write_bytes(chunked(series()))
    with refused(tmp_path, "several bags.*monday.mcap, tuesday.mcap"):
        open_source(tmp_path)


@pytest.mark.parametrize("kind", bags.KINDS)
def test_a_camera_that_is_not_calibrated_gives_none(tmp_path, kind):
    blank = Camera(8, 6, np.zeros((3, 3)))
    path = make(tmp_path, kind, [("/front/camera_info", 6, bags.info(6, blank)), *series()])
    assert open_source(path).calibration is None


def test_coefficients_filled_up_with_zeros_are_the_same_lens(tmp_path):
    long = Camera(8, 6, CAMERA.K, "rational_polynomial", np.array([0.1, 0, 0, 0.01, 0, 0.2, 0, 0]))
    filled = SimpleNamespace(
        K=long.K, width=8, height=6, model=long.model, distortion=np.append(long.distortion, [0] * 6)
    )
    calibration = open_source(
        make(tmp_path, "mcap", [("/front/camera_info", 6, bags.info(6, filled)), *series()])
    ).calibration
    assert_array_equal(calibration.distortion, long.distortion)


def test_an_unknown_lens_model_is_refused(tmp_path):
    path = make(tmp_path, "mcap", [("/front/camera_info", 6, bags.info(6, CAMERA, "warp")), *series()])
    source = open_source(path)
    assert source.calibration is None
    assert "'warp' is not supported" in source.no_calibration


def test_parts_of_a_split_bag_follow_each_other(tmp_path):
    for number in (10, 9):
        part = MONO[:3] if number == 9 else MONO[3:]
        (tmp_path / f"dive_{number}.mcap").write_bytes(chunked(series(part)))
    (tmp_path / "metadata.yaml").write_text("relative_file_paths: [../../etc/passwd]")
    items = list(open_source(tmp_path).items())
    assert_array_equal([item.image for item in items], MONO)


def read(path):
    """All items of a bag, or the one line it is refused with."""
    try:
        return list(open_source(path).items())
    except LumidockError as error:
        lines = str(error).splitlines()
    assert len(lines) == 1
    return []


@pytest.mark.parametrize("kind", ["mcap", "bag"])
def test_a_bag_cut_short_gives_all_that_is_whole(tmp_path, good, kind):
    path, counts = tmp_path / f"cut.{kind}", []
    for size in range(len(good[kind]) // 5, len(good[kind]), 41):
        path.write_bytes(good[kind][:size])
        frames = [item for item in read(path) if isinstance(item, Frame)]
        for item, wanted in zip(frames, MONO, strict=False):
            assert_array_equal(item.image, wanted)
        counts.append(len(frames))
    assert counts == sorted(counts)
    assert counts[-1] == 6
    assert kind == "bag" or set(counts) == {0, 1, 2, 3, 4, 5, 6}  # the ROS 1 bag is one chunk


def test_after_a_damaged_chunk_the_rest_is_read(tmp_path, good):
    data, path, spoilt = good["mcap"], tmp_path / "flip.mcap", 0
    for at in range(60, len(data) // 2, 7):
        path.write_bytes(data[:at] + bytes([data[at] ^ 0x55]) + data[at + 1 :])
        items = list(open_source(path, Reading(topic=TOPIC)).items())
        frames = [item for item in items if isinstance(item, Frame)]
        assert len(frames) >= 5
        lost = len(frames) < 6
        spoilt += lost
        assert not lost or any(isinstance(item, Unusable) for item in items)
    assert spoilt > 20


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.ZSTD, CompressionType.LZ4])
def test_a_damaged_chunk_costs_its_own_frames_also_without_a_summary(tmp_path, compression):
    data = chunked([("/front/camera_info", 6, bags.info(6, CAMERA)), *series()], compression)
    starts, at = [], 8
    while data[at] != 0x0F:  # the end of the data
        starts += [at] if data[at] == 0x06 else []
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
    path, cut = tmp_path / "cut.mcap", data[:at]
    for start in starts[3:6:2]:  # the first ones define the channels
        missing = set()
        for place in range(start, start + 9 + 40):  # opcode, length, times, size, checksum, compression
            path.write_bytes(cut[:place] + bytes([cut[place] ^ 0x55]) + cut[place + 1 :])
            missing |= set(range(6)) - {item.t_ns // SECOND for item in read(path) if isinstance(item, Frame)}
        assert len(missing) == 1


@pytest.mark.parametrize("claimed", [2**63, 2**64 - 1])
def test_a_chunk_that_claims_more_than_can_be_counted_costs_its_own_frames(tmp_path, good, claimed):
    data = good["mcap"]
    starts = [
        at for at in range(len(data)) if data[at : at + 1] == b"\x06" and data[at + 37 : at + 45] == b"\x04\0\0\0zstd"
    ]
    size_at = starts[2] + 45  # of the compressed records, behind the name of the compression
    path = tmp_path / "claims.mcap"
    path.write_bytes(data[:size_at] + claimed.to_bytes(8, "little") + data[size_at + 8 :])
    items = read(path)
    assert len([item for item in items if isinstance(item, Frame)]) == 5
    assert any(isinstance(item, Unusable) for item in items)


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(draw=st.data())
@pytest.mark.parametrize("kind", bags.KINDS)
def test_no_spoilt_bag_raises_more_than_one_line(tmp_path, good, kind, draw):
    data = bytearray(good[kind])
    for _ in range(draw.draw(st.integers(1, 8))):
        at = draw.draw(st.integers(0, len(data) - 1))
        data[at] = draw.draw(st.integers(0, 255))
    path = tmp_path / f"any.{kind}"
    path.write_bytes(data[: draw.draw(st.integers(0, len(data)))] if draw.draw(st.booleans()) else data)
    assert len(read(path)) < 100


def mcap_bomb(compression, size):
    """An MCAP file whose only chunk claims to be, and unpacks to, `size` bytes."""
    zeros = b"\0" * size
    packed = zstandard.compress(zeros) if compression == "zstd" else lz4.frame.compress(zeros)
    name = compression.encode()
    body = (
        struct.pack("<QQQII", 0, 0, size, zlib.crc32(zeros), len(name)) + name + struct.pack("<Q", len(packed)) + packed
    )
    head = struct.pack("<BQ", 1, 12) + struct.pack("<I", 4) + b"ros2" + struct.pack("<I", 0)
    return b"\x89MCAP0\r\n" + head + struct.pack("<BQ", 6, len(body)) + body


def bag_bomb(compression, size):
    packed = bz2.compress(b"\0" * size) if compression == "bz2" else lz4.frame.compress(b"\0" * size)

    def record(data, **fields):
        parts = [f"{name}=".encode() + value for name, value in fields.items()]
        head = b"".join(struct.pack("<I", len(part)) + part for part in parts)
        return struct.pack("<I", len(head)) + head + struct.pack("<I", len(data)) + data

    zero = struct.pack("<I", 0)
    header = record(b" " * 4000, op=b"\x03", index_pos=zero * 2, conn_count=zero, chunk_count=zero)
    chunk = record(packed, op=b"\x05", compression=compression.encode(), size=struct.pack("<I", size))
    return b"#ROSBAG V2.0\n" + header + chunk


@pytest.mark.parametrize(
    ("kind", "compression", "size"),
    [("mcap", "zstd", 1 << 30), ("mcap", "lz4", 1 << 30), ("bag", "bz2", 1 << 29), ("bag", "lz4", 1 << 29)],
)
def test_a_bomb_is_not_unpacked(tmp_path, kind, compression, size):
    import resource

    path = tmp_path / f"bomb.{kind}"
    path.write_bytes((mcap_bomb if kind == "mcap" else bag_bomb)(compression, size))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with refused(path, "no topic with pictures"):
        open_source(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 1 << 18  # KiB


def test_a_picture_that_claims_too_much_is_one_bad_frame(tmp_path):
    def huge(store):
        message = bags.raw(1, MONO[0], "mono8")(store)
        message.height, message.width, message.step = 2**31, 2**31, 2**31
        return message

    items = list(open_source(make(tmp_path, "mcap", [(TOPIC, 1, huge), *series()])).items())
    assert [type(item) for item in items] == [Unusable, *[Frame] * 6]
    assert "do not fit" in items[0].text


def test_a_database_that_is_no_bag_and_one_with_a_view(tmp_path):
    for number, sql in enumerate(["CREATE TABLE a (b)", "CREATE TABLE topics (id); CREATE VIEW messages AS SELECT 1"]):
        path = tmp_path / f"{number}.db3"
        with sqlite3.connect(path) as database:
            database.executescript(sql)
        with refused(path, "no bag of ROS 2"):
            open_source(path)


@pytest.mark.parametrize("kind", bags.KINDS)
def test_what_is_no_bag_is_refused(tmp_path, kind):
    path = tmp_path / f"a.{kind}"
    for content in (b"", b"hello", bytes(1000)):
        path.write_bytes(content)
        with refused(path, "not a|no bag"):
            open_source(path)


def test_inspection_counts_gaps_drops_and_sizes(tmp_path):
    t_ns = [0, 100, 200, 300, 500, 600, 600, 900]
    messages = [(TOPIC, i + 1, bags.raw(10**6 * t + 1, MONO[0], "mono8")) for i, t in enumerate(t_ns)]
    source = open_source(make(tmp_path, "mcap", messages))
    result = inspect(source, Camera(9, 6, CAMERA.K))
    assert result["frames"] == 8
    assert result["sizes"] == [{"width": 8, "height": 6, "encoding": "mono8", "frames": 8}]
    assert result["calibration"]["frames_of_another_size"] == 8
    time = result["time"]
    assert (time["gaps"], time["drops"], time["out_of_order"]) == (2, 3, 1)
    assert time["rate_hz"] == pytest.approx(10.0)
    assert time["longest_gap_s"] == pytest.approx(0.3)
    assert inspect(source, CAMERA)["calibration"]["frames_of_another_size"] == 0
