"""Runs every row of docs/formats-supported.md, and holds the file against what came out.

`python tests/test_formats.py` writes it anew.
"""

import shutil
import tempfile
from pathlib import Path
from types import SimpleNamespace

import av
import bags
import calibrations
import cv2
import numpy as np
import pytest
import zstandard
from test_packets import FFMPEG, VIDEO, encoded, foxglove_file, package_bag

from lumidock.camera import Camera
from lumidock.datatypes import MOSAICS, Frame
from lumidock.errors import LumidockError
from lumidock.setup.calibration_files import read_calibration
from lumidock.streams.address import address_of
from lumidock.streams.live import open_live
from lumidock.streams.ros import Message
from lumidock.streams.source import Reading
from lumidock.streams.sources import open_source
from lumidock.streams.topics import frames_of

PAGE = Path(__file__).parent.parent / "docs" / "formats-supported.md"
W, H, START = 12, 8, 1_700_000_000 * 10**9
GRAY = np.arange(W * H, dtype=np.uint8).reshape(H, W) + 30
COLOR = np.dstack([GRAY, GRAY[::-1], 255 - GRAY])
DEEP = GRAY.astype(np.uint16) * 250
LENS = Camera(W, H, np.array([[15.0, 0, 5.5], [0, 15.0, 3.5], [0, 0, 1]]), "plumb_bob", np.array([0.4, 0, 0, 0, 0]))
TOPIC = "/cam/image_raw"


def told(source):
    """What came of a source: how many frames of which encoding, or of the first that is none, why."""
    items = list(source.items())
    frames = [item for item in items if isinstance(item, Frame)]
    if not frames:
        return f"refused: {items[0].text.partition(': ')[2]}"
    bits = 8 * frames[0].image.dtype.itemsize
    kind = frames[0].encoding or ("mono" if frames[0].image.ndim == 2 else "bgr") + str(bits)
    return f"read: {kind}" + "".join(f"; said: {note}" for note in source.notes)


def picture(suffix, image):
    def run(folder):
        cv2.imwrite(str(folder / f"a{suffix}"), image)
        return told(open_source(folder, Reading(10.0)))

    return run


def content(name, data, reading=None):
    def run(folder):
        (folder / name).write_bytes(data)
        return told(open_source(folder, reading or Reading(10.0)))

    return run


def video(name, codec="libx264", rotation=0, reading=None):
    def run(folder):
        write_video(folder / name, codec, rotation)
        return told(open_source(folder / name, reading))

    return run


def write_video(path, codec, rotation):
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        if rotation:
            stream.set_display_rotation(rotation)
        for level in (20, 90, 200):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.full((48, 64, 3), level, np.uint8), "bgr24")))
        container.mux(stream.encode(None))


def bag(kind, make, *, info=None, topic=TOPIC, reading=None, **options):
    """A bag of three messages, with or without a CameraInfo."""

    def run(folder):
        infos = [] if info is None else [("/cam/camera_info", START, bags.info(START, LENS, **info))]
        messages = infos + [(topic, START + i, make(START + i)) for i in range(3)]
        source = open_source(bags.write(folder / "a", kind, messages, **options), reading)
        if info is None:
            return told(source)
        if source.calibration is None:
            return f"refused: {source.no_calibration.partition(': ')[2]}"
        fx, (width, height) = source.calibration.focal_px[0], (source.calibration.width, source.calibration.height)
        return f"read: fx {fx:g} px, {width}x{height}" + "".join(f"; said: {note}" for note in source.notes)

    return run


def raw(pixels, encoding):
    return lambda t: bags.raw(t, pixels, encoding)


def message(encoding):
    """A bag with pixels of that encoding; what they are does not matter here."""
    bits = {"10p": 10, "12p": 12, "Packed": 12}
    row = next((W * count // 8 for end, count in bits.items() if encoding.endswith(end)), None)
    row = row or W * (
        4 if "a8" in encoding else 3 if "gr8" in encoding or ("gb8" in encoding and "bayer" not in encoding) else 1
    )
    row = {"rgb8": 3 * W, "bgr8": 3 * W}.get(encoding, row)
    row *= (
        2 if encoding.endswith("16") or encoding in ("yuyv", "uyvy", "yuv422", "yuv422_yuy2", "mono10", "mono12") else 1
    )
    row *= 4 if encoding == "32FC1" else 1
    rows = H * 3 // 2 if encoding in ("nv12", "nv21", "i420") else H

    def make(t):
        def build(store):
            built = bags.raw(t, np.zeros((rows, row), np.uint8), encoding)(store)
            built.width, built.height = W, H
            return built

        return build

    return bag("mcap", make)


def packets(codec, form):
    data = [packet for _, packet in encoded(codec)]
    return bag("mcap", lambda t: bags.compressed(t, data[t - START], form))


def still(suffix, image):
    return bag("mcap", lambda t: bags.compressed(t, cv2.imencode(suffix, image)[1].tobytes(), suffix[1:]))


def euroc(folder):
    (folder / "data").mkdir()
    cv2.imwrite(str(folder / "data" / "1403636579763555584.png"), GRAY)
    (folder / "data.csv").write_text("#timestamp [ns],filename\n1403636579763555584,1403636579763555584.png\n")
    return told(open_source(folder))


def sequence(folder):
    (folder / "frames").mkdir()
    cv2.imwrite(str(folder / "frames" / "a.png"), GRAY)
    (folder / "timestamps.csv").write_text("frame,file,t_ns\n0,a.png,5\n")
    return told(open_source(folder))


def doubled(folder):
    cv2.imwrite(str(folder / "1.png"), GRAY)
    cv2.imwrite(str(folder / "1.jpg"), GRAY)
    (folder / "._1.png").write_bytes(b"x")
    return told(open_source(folder, Reading(10.0)))


def stamped(folder):
    cv2.imwrite(str(folder / "1403636579763555584.png"), GRAY)
    return told(open_source(folder))


def active(folder):
    path = bags.write(folder / "a", "bag", [(TOPIC, START, bags.raw(START, GRAY, "mono8"))])
    return told(open_source(path.rename(folder / "a.bag.active")))


def turned(folder):
    tag = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x03\0\0\0\0\0\0"
    data = cv2.imencode(".jpg", GRAY)[1].tobytes()
    (folder / "a.jpg").write_bytes(data[:2] + b"\xff\xe1" + (len(tag) + 2).to_bytes(2, "big") + tag + data[2:])
    return told(open_source(folder, Reading(10.0)))


def packaged(kind, form):
    return lambda folder: told(open_source(package_bag(folder / "a", kind, form, encoded("libx264"))))


def of_foxglove(topic):
    return lambda folder: told(open_source(foxglove_file(folder / "a.mcap", encoded("libx264")), Reading(topic=topic)))


def split(folder):
    for number in range(2):
        part = bags.write(folder / f"part{number}", "mcap", [(TOPIC, START + number, bags.raw(START, GRAY, "mono8"))])
        (file,) = part.glob("*.mcap")
        file.rename(folder / f"dive_{number}.mcap")
        shutil.rmtree(part)
    (folder / "metadata.yaml").write_text("")
    return told(open_source(folder))


def live(address):
    return lambda _: f"read: {open_live(address, reading=Reading(follow_calibration=False)).kind}, live"


def topic(made):
    """A picture of a topic as it comes over a network."""

    def run(_):
        built = made(START)(bags.STORES[2])
        data = bytes(bags.STORES[2].serialize_cdr(built, built.__msgtype__))

        def listen(_topics, take):
            take(Message(TOPIC, built.__msgtype__, "cdr", START, data))
            return SimpleNamespace(problem="", close=lambda: None)

        item = next(frames_of(listen, {TOPIC: built.__msgtype__}, Reading(), None))
        return told(SimpleNamespace(items=lambda: iter([item]), notes=()))

    return run


def hidden(_):
    return f"read: shown as {address_of('rtsp://admin:p@ss/w#rd@10.0.0.7:554/live?token=x').shown}"


FULL = {"width": 24, "height": 16}
BINNED = {**FULL, "binning_x": 2, "binning_y": 2, "k": np.array([30.0, 0, 11.5, 0, 30, 7.5, 0, 0, 1])}
WINDOW = {**FULL, "roi": (6, 4, W, H), "k": np.array([15.0, 0, 11.5, 0, 15, 7.5, 0, 0, 1])}
TRUSTED, TWELVE = Reading(trusted=True), Reading(bits=12)
P = np.array([[20.0, 0, 5.5, 0], [0, 20.0, 3.5, 0], [0, 0, 1, 0]]).reshape(-1)
HALF = np.array([[15.0, 0, 2.5], [0, 15.0, 1.5], [0, 0, 1]]).reshape(-1)
IMAGE = raw(GRAY, "mono8")
JPEG = cv2.imencode(".jpg", COLOR)[1].tobytes()
ENCODINGS = ["mono8", "mono16", "bgr8", "rgb8", "bgra8", "rgba8", *(f"{m}{b}" for m in MOSAICS[:1] for b in (8, 16))]
ENCODINGS += ["yuyv", "uyvy", "yuv422", "yuv422_yuy2", "nv12", "nv21", "i420", "mono10", "mono12", "Mono10p", "Mono12p"]
ENCODINGS += ["Mono12Packed", "BayerRG12p", "BayerRG12Packed", "32FC1"]
SOURCES = [
    ("Sequence folder", "timestamps.csv and frames/", sequence),
    ("Folder of pictures", "PNG, with --fps", picture(".png", GRAY)),
    ("Folder of pictures", "PNG of 16 bits", picture(".png", DEEP)),
    ("Folder of pictures", "JPEG", picture(".jpg", COLOR)),
    ("Folder of pictures", "JPEG turned by its EXIF data", turned),
    ("Folder of pictures", "TIFF", picture(".tiff", DEEP)),
    ("Folder of pictures", "BMP", picture(".bmp", COLOR)),
    ("Folder of pictures", "WebP", picture(".webp", COLOR)),
    ("Folder of pictures", "names that are stamps", stamped),
    ("Folder of pictures", "two forms of the same picture, hidden files", doubled),
    ("Folder of pictures", "HEIC under another name", content("a.jpg", b"\0\0\0\x18ftypheic")),
    ("EuRoC", "cam0 with data/ and data.csv", euroc),
    ("Video", "MP4, H.264", video("a.mp4")),
    ("Video", "Matroska, H.265", video("a.mkv", "libx265")),
    ("Video", "MP4 with a rotation in its header", video("a.mp4", rotation=90)),
    ("Video", "MP4 with --fps", video("a.mp4", reading=Reading(3.0))),
    ("Bag", "MCAP", bag("mcap", IMAGE)),
    ("Bag", "ROS 2, SQLite", bag("db3", IMAGE)),
    ("Bag", "ROS 2, SQLite, messages in zstd", bag("db3", IMAGE, compression="zstd")),
    ("Bag", "ROS 1", bag("bag", IMAGE)),
    ("Bag", "ROS 1, .bag.active", active),
    ("Bag", ".db3.zstd", content("a.db3.zstd", zstandard.compress(b"x"))),
    ("Bag", "CompressedImage: PNG", still(".png", GRAY)),
    ("Bag", "CompressedImage: JPEG", still(".jpg", COLOR)),
    ("Bag", "CompressedImage: H.264", packets("libx264", "h264")),
    ("Bag", "CompressedImage: H.265", packets("libx265", "hevc")),
    ("Bag", "foxglove_msgs/CompressedVideo", packaged(VIDEO, "h264")),
    ("Bag", "ffmpeg_image_transport_msgs/FFMPEGPacket", packaged(FFMPEG, "h264;yuv420p;bgr8;bgr8")),
    ("Bag", "MCAP of Foxglove (protobuf): CompressedVideo", of_foxglove("/cam/video")),
    ("Bag", "MCAP of Foxglove (protobuf): RawImage", of_foxglove("/raw/image")),
    ("Bag", "MCAP of Foxglove (protobuf): CompressedImage", of_foxglove("/png/image")),
    ("Bag", "MCAP in several files", split),
    ("Bag", "12 bits at the top of 16, with --bits 12", bag("mcap", raw(DEEP // 16 * 16, "mono16"), reading=TWELVE)),
    ("Bag", "12 bits at the bottom of 16, with --bits 12", bag("mcap", raw(DEEP // 16, "mono16"), reading=TWELVE)),
    ("Bag", "stamps of zero", bag("mcap", lambda _: bags.raw(0, GRAY, "mono8"))),
    ("Bag", "stamps of a simulation", bag("mcap", lambda t: bags.raw(t - START + 5, GRAY, "mono8"))),
    *(("Image encoding", name, message(name)) for name in ENCODINGS),
    ("CameraInfo", "beside the pictures", bag("mcap", IMAGE, info={})),
    ("CameraInfo", "rectified topic", bag("mcap", IMAGE, info={"p": P}, topic="/cam/image_rect")),
    ("CameraInfo", "binning", bag("mcap", IMAGE, info=BINNED)),
    ("CameraInfo", "region of interest", bag("mcap", IMAGE, info=WINDOW)),
    ("CameraInfo", "K of another picture size", bag("mcap", IMAGE, info={"k": HALF})),
    ("CameraInfo", "the same, with --trust-calibration", bag("mcap", IMAGE, info={"k": HALF}, reading=TRUSTED)),
    ("CameraInfo", "another camera's", bag("mcap", IMAGE, info={"frame_id": "rear"}, topic="/rear/image_raw")),
    ("CameraInfo", "pictures of another size", bag("mcap", raw(GRAY[:4], "mono8"), info={})),
    ("Camera", "rtsp://...", live("rtsp://cam/front")),
    ("Camera", "rtp://HOST:PORT", live("rtp://127.0.0.1:5600")),
    ("Camera", "/dev/videoN", live("/dev/video0")),
    ("Camera", "gige:NAME", live("gige:front")),
    ("Topic of ROS 2", "zenoh:/TOPIC", live("zenoh:/cam/image_raw")),
    ("Topic of ROS 2", "zenoh:tcp/HOST:PORT/TOPIC", live("zenoh:tcp/127.0.0.1:7447/cam/image_raw")),
    ("Topic of ROS 2", "dds:/TOPIC", live("dds:/cam/image_raw/compressed")),
    ("Topic of ROS 2", "Image", topic(IMAGE)),
    ("Topic of ROS 2", "CompressedImage: JPEG", topic(lambda t: bags.compressed(t, JPEG, "jpeg"))),
    ("Topic of ROS 2", "CompressedImage: H.264", topic(lambda t: bags.compressed(t, encoded("libx264")[0][1], "h264"))),
    ("Camera", "secrets in an address", hidden),
]  # fmt: skip


def outcome(run, folder):
    """What happens, in one line without the folder of this run."""
    try:
        text = run(folder)
    except LumidockError as error:
        text = f"refused: {error}"
    return " ".join(text.replace(f"{folder}/", "").replace(str(folder), "FOLDER").split())


def calibration(content):
    def run(folder):
        camera = read_calibration(calibrations.write(folder / "FILE", content))
        return f"read: {camera.model}, {len(camera.distortion)} coefficients, {camera.width}x{camera.height}"

    return run


CALIBRATIONS = [(tool, what, calibration(text)) for tool, what, text, _ in calibrations.FILES]
ROWS = SOURCES + CALIBRATIONS
HEAD = """# What is read, and what happens with it

This page is made by `tests/test_formats.py`, which runs every row. `read` says what comes out, `said` what a command
prints to standard error with it, `refused` the line with which it ends.

**Stamps.** Each topic has one clock: the stamps in its headers or, where the first of them are zero, the times of
recording; a header that has none among others that do makes a `bad_stamp`. Cameras on the network are stamped by the
time that they send with their pictures (RTP, and RTCP where that agrees with this machine's clock to a second), so that
pictures that arrive in bursts keep their distances. `--fps` is for pictures without stamps; where there are stamps they
hold, but for a video, whose times it replaces, and either is said. `--delay-ms` is taken off every stamp: what passes
between exposure and stamp. To measure it, let the camera see a screen that shows this machine's time in milliseconds,
and take the time that can be read in a picture from the picture's stamp; the median of ten pictures will do.

**Calibrations.** What no camera has is refused with its numbers, and taken with `--trust-calibration`: a principal
point outside the middle half of the picture or at the middle of a picture of another size, a field of view beyond any
lens, pixels twice as wide as high. `run` and `serve` warn of what `lumidock calib check` warns of. A recording ends
where its calibration changes, unless `--camera` is given.

**Topics.** A topic of ROS 2 is read live over zenoh or DDS. The newest picture is localized, older ones are dropped.
Its calibration is the CameraInfo beside it, which is waited for, or `--camera`. It is lost after five seconds without a
picture, and looked for again.
"""


def table(rows, outcomes):
    lines = ["| kind | what | what happens |", "|---|---|---|"]
    lines += [
        f"| {kind} | {what} | {text.replace('|', '/')} |" for (kind, what, _), text in zip(rows, outcomes, strict=True)
    ]
    return "\n".join(lines)


def page(outcomes):
    first, second = outcomes[: len(SOURCES)], outcomes[len(SOURCES) :]
    sources, files = table(SOURCES, first), table(CALIBRATIONS, second)
    return f"{HEAD}\n## Pictures and their calibration\n\n{sources}\n\n## Calibration files\n\n{files}\n"


LINES = PAGE.read_text(encoding="utf-8").splitlines() if PAGE.exists() else []


@pytest.mark.parametrize(("kind", "what", "run"), ROWS, ids=[f"{kind}: {what}" for kind, what, _ in ROWS])
def test_a_row_of_the_page_is_true(tmp_path, kind, what, run):
    text = outcome(run, tmp_path).replace("|", "/")
    assert text.startswith(("read: ", "refused: "))
    assert f"| {kind} | {what} | {text} |" in LINES


def test_the_page_has_these_rows_and_no_other():
    assert sum(line.startswith("| ") for line in LINES) == len(ROWS) + 2
    assert PAGE.read_text(encoding="utf-8").startswith(HEAD)


if __name__ == "__main__":
    found = []
    for _, _, run in ROWS:
        with tempfile.TemporaryDirectory() as folder:
            found.append(outcome(run, Path(folder)))
    PAGE.write_text(page(found), encoding="utf-8")
