import os

import cv2
import numpy as np
import pytest
from conftest import assert_close, refused
from numpy.testing import assert_array_equal
from scipy.spatial.transform import Rotation

from lumidock.datatypes import Detections, Frame, Unusable
from lumidock.errors import InputError
from lumidock.streams.live import open_live
from lumidock.streams.sources import open_source

PICTURES = np.random.default_rng(2).integers(0, 256, (4, 6, 8, 3), np.uint8)
HEADER = b"frame,file,t_ns\n"
COLUMNS = "frame,u_px,v_px,radius_px,flux,p_light,p_rear\n"


def write_pictures(folder, names):
    folder.mkdir(parents=True)
    for name, picture in zip(names, PICTURES, strict=False):
        cv2.imwrite(str(folder / name), picture)


def write_video(path, levels=(20, 60, 100, 140, 180, 220), fps=20.0):
    """Plain frames of 32 x 24 px, gray but for a blue bar in the first half of them."""
    codec = "MJPG" if path.suffix == ".avi" else "mp4v"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), fps, (32, 24))
    for number, level in enumerate(levels):
        picture = np.full((24, 32, 3), level, np.uint8)
        picture[:, : 16 * (2 * number < len(levels)), 0] = 255
        writer.write(picture)
    writer.release()


@pytest.fixture
def sequence(tmp_path):
    """A sequence folder of four pictures; returns (content of timestamps.csv) -> items."""
    write_pictures(tmp_path / "frames", ["a.png", "b.png", "c.png", "d.png"])

    def items(content):
        (tmp_path / "timestamps.csv").write_bytes(content)
        return list(open_source(tmp_path).items())

    return items


def told(item):
    """Name, stamp and reason of an item."""
    match item:
        case Frame(name=name, t_ns=t_ns):
            return name, t_ns, ""
        case Detections(frame=name, t_ns=t_ns):
            return name, t_ns, ""
        case Unusable(frame=name, t_ns=t_ns, reason=reason):
            return name, t_ns, reason
    raise AssertionError(item)


def test_a_sequence_comes_in_the_order_of_its_table(sequence, tmp_path):
    for name in ("camera.yaml", "station.yaml"):
        (tmp_path / name).touch()
    items = sequence(HEADER + b"one,c.png,5\nx,a.png,7\none,b.png,6\n")
    assert [told(item) for item in items] == [("one", 5, ""), ("x", 7, ""), ("one", 6, "")]
    assert_array_equal([item.image for item in items], PICTURES[[2, 0, 1]])
    source = open_source(tmp_path)
    assert (source.kind, source.count, source.inputs) == ("sequence", 3, (tmp_path / "timestamps.csv",))
    assert (source.camera, source.station) == (tmp_path / "camera.yaml", tmp_path / "station.yaml")
    assert [told(item) for item in source.items()] == [told(item) for item in source.items()]


TABLES = {
    "byte order mark": (b"\xef\xbb\xbf" + HEADER + b"1,a.png,5\n", [("1", 5, "")]),
    "windows line ends": (b"frame,file,t_ns\r\n1,a.png,5\r\n2,b.png,6\r\n", [("1", 5, ""), ("2", 6, "")]),
    "no last line end": (HEADER + b"1,a.png,5", [("1", 5, "")]),
    "blank lines": (HEADER + b"\n1,a.png,5\n\n\n2,b.png,6\n\n", [("1", 5, ""), ("2", 6, "")]),
    "other columns": (b"t_ns,note,file,frame\n5,,a.png,1\n", [("1", 5, "")]),
    "long row": (HEADER + b"1,a.png,5,what,is,this\n", [("1", 5, "")]),
    "short rows": (
        HEADER + b"1\n2,b.png\n3,c.png,7\n",
        [("1", None, "bad_stamp"), ("2", None, "bad_stamp"), ("3", 7, "")],
    ),
    "only commas": (HEADER + b",,\n1,a.png,5\n", [("", None, "bad_stamp"), ("1", 5, "")]),
    "quoted name": (HEADER + b'"a,\n""1""",a.png,5\n', [('a,\n"1"', 5, "")]),
    "zero bytes in a stamp": (HEADER + b"1,a.png,5\0\0\n2,b.png,6\n", [("1", None, "bad_stamp"), ("2", 6, "")]),
    "zero bytes in a name": (HEADER + b"1,a.\0png,5\n", [("1", 5, "bad_frame")]),
    "zero bytes behind the end": (HEADER + b"1,a.png,5\n" + bytes(4096), [("1", 5, "")]),
    "no UTF-8": (HEADER + b"\xff\xfe,a.png,5\n", [("\ufffd\ufffd", 5, "")]),
}


@pytest.mark.parametrize(("content", "wanted"), TABLES.values(), ids=TABLES)
def test_a_table_gives_one_item_a_row(sequence, content, wanted):
    assert [told(item) for item in sequence(content)] == wanted


@pytest.mark.parametrize(
    ("stamp", "t_ns"),
    [
        ("0", 0),
        ("-5", -5),
        (" +7 ", 7),
        ("1795368000123456789", 1795368000123456789),
        (str(2**63 - 1), 2**63 - 1),
        (str(2**63), None),
        ("1" + "0" * 30, None),
        ("9" * 5000, None),
        ("", None),
        ("nan", None),
        ("1.5", None),
        ("1e9", None),
        ("1_000", None),
        ("0x10", None),
        ("٣", None),
        ("5 6", None),
    ],
)
def test_a_stamp_is_an_integer_of_64_bits(sequence, stamp, t_ns):
    (item,) = sequence(HEADER + f"1,a.png,{stamp}\n".encode())
    assert told(item) == ("1", t_ns, "bad_stamp" if t_ns is None else "")
    assert t_ns is not None or len(item.text.splitlines()) == 1


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (b"", "no column frame"),
        (b"frame,file\n1,a.png\n", "no column t_ns"),
        (b"frame;file;t_ns\n1;a.png;5\n", "no column frame"),
        (HEADER.decode().encode("utf-16"), "no column frame"),
        (HEADER, "no frames"),
        (HEADER + bytes(100), "no frames"),
        (HEADER + b"1,a.png," + b"5" * 200_000 + b"\n", "field limit"),
    ],
)
def test_a_table_that_is_none_is_refused(sequence, tmp_path, content, match):
    with refused(tmp_path / "timestamps.csv", match):
        sequence(content)


def test_a_folder_in_place_of_the_table_is_refused(tmp_path):
    (tmp_path / "timestamps.csv").mkdir()
    with refused(tmp_path, "Is a directory"):
        open_source(tmp_path)


@pytest.mark.parametrize("name", ["../outside.png", "sub/../a.png", "..", "", "."])
def test_names_that_lead_out_are_bad_frames(sequence, tmp_path, name):
    cv2.imwrite(str(tmp_path / "outside.png"), PICTURES[0])
    (tmp_path / "frames" / "sub").mkdir()
    first, second = sequence(HEADER + f"1,{name},5\n2,a.png,6\n".encode())
    assert [told(first), told(second)] == [("1", 5, "bad_frame"), ("2", 6, "")]


def test_an_absolute_name_is_a_bad_frame(sequence, tmp_path):
    (item,) = sequence(HEADER + f"1,{tmp_path / 'frames' / 'a.png'},5\n".encode())
    assert told(item) == ("1", 5, "bad_frame")
    assert "refused" in item.text


def test_links_are_followed(tmp_path):
    write_pictures(tmp_path / "disk", ["a.png"])
    write_pictures(tmp_path / "other", ["b.png"])
    (tmp_path / "disk" / "link.png").symlink_to(tmp_path / "other" / "b.png")
    (tmp_path / "sequence").mkdir()
    (tmp_path / "sequence" / "frames").symlink_to(tmp_path / "disk")
    (tmp_path / "sequence" / "timestamps.csv").write_bytes(HEADER + b"1,a.png,5\n2,link.png,6\n")
    (tmp_path / "link").symlink_to(tmp_path / "sequence")
    assert_array_equal([item.image for item in open_source(tmp_path / "link").items()], PICTURES[[0, 0]])


def test_an_image_folder_counts_as_people_do(tmp_path):
    write_pictures(tmp_path / "images", ["img10.png", "img9.png", "img1.PNG", "b.jpg"])
    (tmp_path / "images" / "notes.txt").touch()
    (tmp_path / "images" / "img11.jpeg").write_bytes(b"")
    items = list(open_source(tmp_path / "images", fps=20.0).items())
    wanted = [("b", 0, ""), ("img1", 50_000_000, ""), ("img9", 100_000_000, ""), ("img10", 150_000_000, "")]
    assert [told(item) for item in items] == [*wanted, ("img11", 200_000_000, "bad_frame")]
    assert_array_equal([item.image for item in items[1:4]], PICTURES[[2, 1, 0]])


def test_an_image_folder_needs_a_frame_rate(tmp_path):
    write_pictures(tmp_path / "images", ["a.png"])
    with refused(tmp_path / "images", "give --fps"):
        open_source(tmp_path / "images")


@pytest.mark.parametrize("fps", [0.0, -1.0, float("nan"), float("inf"), 1e-300, 1e300])
def test_a_frame_rate_has_limits(tmp_path, fps):
    with pytest.raises(InputError, match="frame rate"):
        open_source(tmp_path, fps)


@pytest.mark.parametrize("name", ["a.mp4", "a.avi", "a.MKV"])
def test_a_video_has_its_own_stamps(tmp_path, name):
    write_video(tmp_path / name)
    source = open_source(tmp_path / name)
    items = list(source.items())
    assert [told(item) for item in items] == [(f"{i:06d}", i * 50_000_000, "") for i in range(6)]
    assert [item.image.ndim for item in items] == [3, 3, 3, 2, 2, 2]  # gray stays mono
    seen = [int(item.image[12, 28].max()) for item in items]
    assert np.abs(np.subtract(seen, range(20, 221, 40))).max() < 20
    assert (source.kind, source.count, source.inputs) == ("video", 6, (tmp_path / name,))


def test_a_frame_rate_overrides_a_videos_stamps(tmp_path):
    write_video(tmp_path / "a.avi")
    assert [told(item)[1] for item in open_source(tmp_path / "a.avi", fps=3.0).items()][:3] == [0, 333333333, 666666667]


@pytest.mark.parametrize(
    ("name", "cut"),
    [
        ("a.mp4", lambda _: b""),
        ("a.mp4", lambda content: content[: len(content) // 2]),
        ("a.avi", lambda content: content[: content.index(b"movi") + 4]),
    ],
    ids=["empty", "half", "no frames"],
)
def test_a_broken_video_is_refused(tmp_path, name, cut):
    write_video(tmp_path / name)
    (tmp_path / name).write_bytes(cut((tmp_path / name).read_bytes()))
    with refused(tmp_path / name, "not a video"):
        open_source(tmp_path / name)


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda _: None, "no such file"),
        (os.mkdir, "neither timestamps.csv nor any"),
        (lambda path: path.write_text("x"), "neither a folder nor a video"),
    ],
    ids=["missing", "empty folder", "text"],
)
def test_what_is_no_source_is_refused(tmp_path, make, match):
    make(tmp_path / "source")
    with refused(tmp_path / "source", match):
        open_source(tmp_path / "source")


@pytest.fixture
def detections(tmp_path):
    """A folder of bare detections for frames 1 and 2; returns (rows of detections.csv) -> items."""
    (tmp_path / "timestamps.csv").write_bytes(HEADER + b"1,,5\n2,,6\n")

    def items(rows, header=COLUMNS):
        (tmp_path / "detections.csv").write_text(header + rows)
        return list(open_source(tmp_path).items())

    return items


def test_detections_are_read_with_what_is_known_of_them(detections):
    first, second = detections("1,2.5,-3,4,50,0.5,1\n9,1,1,,,,\n1,7,8,,,,\n")
    assert [told(first), told(second)] == [("1", 5, ""), ("2", 6, "")]
    assert_array_equal(first.uv, [[2.5, -3], [7, 8]])
    assert_array_equal([first.radius_px, first.flux], [[4, np.nan], [50, np.nan]])
    assert_array_equal([first.p_light, first.p_rear], [[0.5, 1], [1, np.nan]])
    assert len(second) == 0


@pytest.mark.parametrize(
    "row", ["1,abc,3", "1,nan,3", "1,inf,3", "1,3", "1,3,4,x", "1,3,4,,y", "1,3,4,,,2", "1,3,4,,,,-1", "1,3,4,,,inf"]
)
def test_a_broken_number_spoils_its_frame_only(detections, row):
    first, second = detections(f"1,1,1,,,,\n2,7,8,,,,\n{row}\n")
    assert [told(first), told(second)] == [("1", 5, "bad_frame"), ("2", 6, "")]
    assert len(first.text.splitlines()) == 1


def test_a_table_of_detections_needs_its_columns(detections, tmp_path):
    with refused(tmp_path / "detections.csv", "no column v_px"):
        detections("", header="frame,u_px\n")


ATTITUDE = "t_ns,qx,qy,qz,qw,sigma_rad\n"


@pytest.fixture
def sigmas(tmp_path):
    """Folder of frames at the given ms; returns (rows of attitude.csv, ms) -> sigma of each frame's attitude."""

    def read(rows, ms, header=ATTITUDE):
        (tmp_path / "attitude.csv").write_text(header + "".join(f"{row}\n" for row in rows))
        stamps = (f"{number},,{t * 1_000_000}\n" for number, t in enumerate(ms))
        (tmp_path / "timestamps.csv").write_text(HEADER.decode() + "".join(stamps))
        (tmp_path / "detections.csv").write_text(COLUMNS + "0,1,2,,,,\n")
        items = list(open_source(tmp_path).items())
        return [item.attitude and item.attitude.sigma_rad for item in items]

    return read


def at(ms, sigma=0.1):
    """A row of attitude.csv at a time in ms."""
    return f"{ms * 1_000_000},0.6,0,0,-0.8,{sigma}"


def test_pictures_and_detections_have_the_vehicles_attitude(sequence, sigmas, tmp_path):
    assert sigmas([at(0, 0.02)], [0]) == [0.02]
    assert open_source(tmp_path).inputs == tuple(
        tmp_path / name for name in ("timestamps.csv", "attitude.csv", "detections.csv")
    )
    (tmp_path / "detections.csv").unlink()
    first, second = sequence(HEADER + b"1,a.png,0\n2,b.png,200000000\n")
    assert_close(first.attitude.R_dock_cam, Rotation.from_quat([0.6, 0, 0, -0.8]).as_matrix())
    assert (first.attitude.sigma_rad, second.attitude) == (0.02, None)
    assert open_source(tmp_path).inputs == (tmp_path / "timestamps.csv", tmp_path / "attitude.csv")
    (tmp_path / "attitude.csv").unlink()
    assert [item.attitude for item in sequence(HEADER + b"1,a.png,0\n")] == [None]


def test_the_nearest_row_within_a_tenth_of_a_second_holds(sigmas):
    rows = [at(300, 3), at(0, 1), at(120, 2)]  # in any order
    assert sigmas(rows, [-101, -100, 59, 60, 61, 219, 220, 221, 400, 401]) == [None, 1, 1, 1, 2, 3, 3, 3, 3, None]


def test_the_nearest_of_many_rows_holds(sigmas, rng):
    times, frames = rng.permutation(20_000)[:300].tolist(), sorted(rng.integers(-500, 20_500, 200).tolist())
    wanted = []
    for t in frames:
        off = min((abs(t - row), row) for row in times)
        wanted.append(off[1] + 1 if off[0] <= 100 else None)
    assert sigmas([at(t, t + 1) for t in times], frames) == wanted


def test_stamps_at_the_ends_of_the_scale_are_compared_exactly(tmp_path, detections):
    largest = 2**63 - 1
    (tmp_path / "attitude.csv").write_text(ATTITUDE + f"{-largest},0,0,0,1,1\n{largest},0,0,0,1,2\n")
    (tmp_path / "timestamps.csv").write_bytes(HEADER + f"1,,{largest - 5}\n2,,{5 - largest}\n3,,0\n".encode())
    assert [item.attitude and item.attitude.sigma_rad for item in detections("")] == [2, 1, None]


BROKEN = {
    "word": "one,0,0,1,0.1",
    "empty": ",,,,",
    "short row": "0,0",
    "not a number": "nan,0,0,1,0.1",
    "infinite": "inf,0,0,1,0.1",
    "huge": "1e200,0,0,1,0.1",
    "no rotation": "0,0,0,0,0.1",
    "no error": "0,0,0,1,0",
    "negative error": "0,0,0,1,-0.1",
    "error not a number": "0,0,0,1,nan",
    "endless error": "0,0,0,1,inf",
    "error too small to square": "0,0,0,1,1e-200",
}


@pytest.mark.parametrize("numbers", BROKEN.values(), ids=BROKEN)
def test_a_broken_row_leaves_its_frame_without_an_attitude(sigmas, numbers):
    assert sigmas([at(0), f"50000000,{numbers}", at(100)], [0, 50, 100]) == [0.1, None, 0.1]


@pytest.mark.parametrize("stamp", ["", "nan", "1.5", str(2**63), "0x10"])
def test_a_row_without_a_stamp_is_left_out(sigmas, stamp):
    assert sigmas([at(0), f"{stamp},0,0,0,1,9"], [0, 50]) == [0.1, 0.1]


def test_a_quaternion_of_any_length_is_a_rotation(sigmas, tmp_path):
    assert sigmas(["0,3,0,0,-4,0.1"], [0]) == [0.1]
    (item,) = open_source(tmp_path).items()
    assert_close(item.attitude.R_dock_cam, Rotation.from_quat([0.6, 0, 0, -0.8]).as_matrix())


@pytest.mark.parametrize(
    ("rows", "header", "match"),
    [
        ([at(0)], "t_ns,qx,qy,qz,qw,sigma\n", "no column sigma_rad"),
        ([], "", "no column t_ns"),
        ([], ATTITUDE, "no usable row"),
        (["0,0,0,0,0,1", "now,0,0,0,1,1"], ATTITUDE, "no usable row"),
    ],
)
def test_a_table_without_an_attitude_is_refused(sigmas, tmp_path, rows, header, match):
    with refused(tmp_path / "attitude.csv", match):
        sigmas(rows, [0], header)


@pytest.mark.parametrize("address", ["rtsp://", "rtsp:///front", "rtsp://user:secret@", "rtsp://[", "rtp://:5600"])
def test_a_stream_without_a_host_is_refused_and_its_password_kept(address):
    with pytest.raises(InputError, match="no host in the address") as caught:
        open_live(address)
    assert "secret" not in str(caught.value)
