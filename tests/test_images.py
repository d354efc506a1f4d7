import os
import struct
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from lumidock.errors import FrameError
from lumidock.streams.headers import header_of
from lumidock.streams.images import read_image

SIGNATURE = b"\x89PNG\r\n\x1a\n"
COLOR = cv2.GaussianBlur(np.random.default_rng(1).integers(0, 256, (24, 32, 3), np.uint8), (0, 0), 3)
GRAY = np.ascontiguousarray(COLOR[:, :, 0])
ALPHA = np.dstack([COLOR, GRAY])


def encoded(suffix, image, *options):
    return cv2.imencode(suffix, image, list(options))[1].tobytes()


def chunk(kind, content):
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png(width, height, *chunks, depth=8, color_type=0):
    header = struct.pack(">IIBBBBB", width, height, depth, color_type, 0, 0, 0)
    return SIGNATURE + chunk(b"IHDR", header) + b"".join(chunks) + chunk(b"IEND", b"")


def pixels(*rows):
    return chunk(b"IDAT", zlib.compress(b"".join(b"\0" + bytes(row) for row in rows)))


def bomb(side):
    """A complete, valid PNG of `side` x `side` black pixels in a few kilobytes."""
    packer = zlib.compressobj(1)
    rows = [packer.compress(bytes(1 + side // 8)) for _ in range(side)]
    return png(side, side, chunk(b"IDAT", b"".join([*rows, packer.flush()])), depth=1)


PNG, JPEG = encoded(".png", COLOR), encoded(".jpg", COLOR, cv2.IMWRITE_JPEG_QUALITY, 95)
DEEP_COLOR, DEEP_GRAY = COLOR.astype(np.uint16) * 256 + 7, GRAY.astype(np.uint16) * 256 + 7
PALETTE = chunk(b"PLTE", bytes([255, 0, 0, 0, 0, 255]))


@pytest.fixture
def read(tmp_path):
    def read_bytes(content, name="frame.png"):
        (tmp_path / name).write_bytes(content)
        return read_image(tmp_path / name)

    return read_bytes


@pytest.mark.parametrize(
    ("content", "wanted"),
    [
        (PNG, COLOR),
        (encoded(".png", GRAY), GRAY),
        (encoded(".png", np.dstack([GRAY] * 3)), GRAY),
        (encoded(".png", ALPHA), COLOR),
        (encoded(".png", DEEP_COLOR), DEEP_COLOR),
        (encoded(".png", DEEP_GRAY), DEEP_GRAY),
        (encoded(".png", ALPHA.astype(np.uint16) * 256 + 7), DEEP_COLOR),
        (png(2, 2, pixels([9, 0, 8, 255], [7, 1, 6, 2]), color_type=4), np.array([[9, 8], [7, 6]], np.uint8)),
        (png(2, 1, PALETTE, pixels([0, 1]), color_type=3), np.array([[[0, 0, 255], [255, 0, 0]]], np.uint8)),
        (png(8, 1, pixels([0b10100000]), depth=1), np.array([[255, 0, 255, 0, 0, 0, 0, 0]], np.uint8)),
        (PNG + b"what a camera left behind the end" * 9, COLOR),
    ],
    ids=[
        "bgr",
        "gray",
        "gray as bgr",
        "alpha",
        "16 bit",
        "16 bit gray",
        "16 bit alpha",
        "gray alpha",
        "palette",
        "bits",
        "tail",
    ],
)
def test_every_png_becomes_mono_or_bgr_of_its_own_depth(read, content, wanted):
    image = read(content)
    assert image.dtype == wanted.dtype
    assert_array_equal(image, wanted)


@pytest.mark.parametrize(
    ("content", "wanted"),
    [
        (JPEG, COLOR),
        (encoded(".jpg", GRAY, cv2.IMWRITE_JPEG_QUALITY, 95), GRAY),
        (encoded(".jpg", np.dstack([GRAY] * 3), cv2.IMWRITE_JPEG_QUALITY, 95), GRAY),
        (encoded(".jpg", COLOR, cv2.IMWRITE_JPEG_QUALITY, 95, cv2.IMWRITE_JPEG_PROGRESSIVE, 1), COLOR),
        (JPEG + b"what a camera left behind the end", COLOR),
    ],
    ids=["bgr", "gray", "gray as bgr", "progressive", "tail"],
)
def test_every_jpeg_becomes_mono8_or_bgr8(read, content, wanted):
    image = read(content, "frame.jpg")
    assert image.shape == wanted.shape
    assert np.abs(image.astype(int) - wanted).mean() < 3


def tagged(orientation):
    """The JPEG with an Exif orientation."""
    tag = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0" + bytes([orientation]) + b"\0\0\0\0\0\0"
    return JPEG[:2] + b"\xff\xe1" + struct.pack(">H", len(tag) + 2) + tag + JPEG[2:]


@pytest.mark.parametrize("orientation", range(10))
def test_a_picture_is_turned_as_its_orientation_says(read, tmp_path, orientation):
    image = read(tagged(orientation), "frame.jpg")
    wanted = cv2.imread(str(tmp_path / "frame.jpg"))  # OpenCV turns it on its own
    assert_array_equal(image, wanted)
    assert header_of(tagged(orientation)).size == image.shape[1::-1]
    assert_array_equal(read_image(tmp_path / "frame.jpg", as_stored=True), read(JPEG, "plain.jpg"))


@pytest.mark.parametrize("suffix", [".tiff", ".bmp", ".webp"])
@pytest.mark.parametrize("image", [COLOR, GRAY, DEEP_GRAY, DEEP_COLOR], ids=["bgr", "gray", "deep gray", "deep"])
def test_other_formats_are_read(read, suffix, image):
    if image.dtype == np.uint16 and suffix != ".tiff":
        pytest.skip("8 bits only")
    options = [cv2.IMWRITE_WEBP_QUALITY, 101] if suffix == ".webp" else []
    content = encoded(suffix, image, *options)
    assert_array_equal(read(content, f"a{suffix}"), image)
    assert header_of(content).size == image.shape[1::-1]
    for length in range(0, len(content) - 1, 7):
        with pytest.raises(FrameError):
            read(content[:length], f"a{suffix}")


def test_a_picture_of_another_size_is_refused_by_its_header(tmp_path):
    import resource

    (tmp_path / "a.png").write_bytes(bomb(9000))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(FrameError, match="9000x9000 pixels, the camera has 32x24"):
        read_image(tmp_path / "a.png", size=(32, 24))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 1 << 14  # KiB
    (tmp_path / "b.jpg").write_bytes(tagged(6))
    assert read_image(tmp_path / "b.jpg", size=(24, 32)).shape == (32, 24, 3)


def test_a_links_target_is_read(read, tmp_path):
    read(PNG, "target.png")
    (tmp_path / "link.png").symlink_to("target.png")
    assert_array_equal(read_image(tmp_path / "link.png"), COLOR)


REFUSALS = {
    "empty": (b"", "empty file"),
    "text": (b"not a picture\n", "neither PNG nor JPEG, TIFF, BMP or WebP"),
    "gif": (b"GIF89a", "GIF; read are PNG, JPEG, TIFF, BMP and WebP"),
    "heic": (b"\0\0\0\x18ftypheic", "HEIC; read are PNG, JPEG, TIFF, BMP and WebP"),
    "video": (b"\0\0\0\x01\x67", "a frame of video (H.264 or H.265); read are PNG, JPEG, TIFF, BMP and WebP"),
    "float tiff": (encoded(".tiff", GRAY.astype(np.float32)), "TIFF of numbers that are not unsigned integers"),
    "signature alone": (SIGNATURE, "truncated PNG"),
    "png without pixels": (png(4, 4), "cannot be decoded"),
    "png with too few pixels": (png(40, 40, pixels([1, 2, 3])), "cannot be decoded"),
    "png of no width": (png(0, 4, pixels([1])), "0x4 pixels"),
    "png claiming too much": (png(30000, 30000, pixels([1])), "30000x30000 pixels"),
    "png that is a bomb": (bomb(30000), "30000x30000 pixels"),
    "jpeg markers alone": (b"\xff\xd8\xff\xd9", "0x0 pixels"),
    "jpeg of filling": (b"\xff\xd8" + b"\xff" * 1000 + b"\xff\xd9", "0x0 pixels"),
    "jpeg claiming too much": (
        b"\xff\xd8\xff\xc0\0\x0b\x08\x75\x30\x75\x30\x01\x01\x11\0" + b"\xff\xda\xff\xd9" + bytes(9),
        "30000x30000 pixels",
    ),
}


@pytest.mark.parametrize(("content", "why"), REFUSALS.values(), ids=REFUSALS)
def test_what_is_no_picture_is_a_bad_frame(read, tmp_path, content, why):
    with pytest.raises(FrameError) as caught:
        read(content)
    assert str(caught.value) == f"{tmp_path / 'frame.png'}: {why}"
    assert caught.value.reason == "bad_frame"


@pytest.mark.parametrize(
    ("make", "why"),
    [(lambda _: None, "No such file"), (os.mkdir, "not a file"), (os.mkfifo, "not a file")],
    ids=["missing", "folder", "pipe"],
)
def test_what_is_no_file_is_a_bad_frame(tmp_path, make, why):
    make(tmp_path / "frame.png")
    with pytest.raises(FrameError, match=why):
        read_image(tmp_path / "frame.png")


@pytest.mark.parametrize("content", [PNG, JPEG], ids=["png", "jpeg"])
@pytest.mark.parametrize("padding", [0, 1], ids=["cut", "zeros"])
def test_no_part_of_a_file_is_a_picture(read, content, padding):
    for length in range(len(content)):
        with pytest.raises(FrameError):
            read(content[:length] + padding * bytes(len(content) - length))


def test_no_flipped_bit_of_a_png_goes_unseen(read):
    for at in range(len(PNG)):
        with pytest.raises(FrameError):
            read(PNG[:at] + bytes([PNG[at] ^ 1 << at % 8]) + PNG[at + 1 :])


STARTS = [
    b"",
    SIGNATURE,
    PNG[:33],
    b"\xff\xd8",
    JPEG[:200],
    JPEG[:-200],
    b"II*\0\x08\0\0\0",
    b"BM",
    b"RIFF\x20\0\0\0WEBPVP8X",
]
STARTS += [encoded(suffix, COLOR)[:size] for suffix in (".tiff", ".bmp", ".webp") for size in (40, 160, -3)]


@given(st.sampled_from(STARTS), st.binary(max_size=80))
def test_any_content_gives_a_picture_or_a_bad_frame(tmp_path_factory, start, rest):
    path = tmp_path_factory.getbasetemp() / "any.png"
    path.write_bytes(start + rest + b"\xff\xd9")
    refusal = None
    try:
        image = read_image(path)
    except FrameError as error:
        refusal = error
    assert image.dtype == np.uint8 if refusal is None else len(str(refusal).splitlines()) == 1
