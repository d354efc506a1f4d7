import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from lumidock.datatypes import MOSAICS
from lumidock.errors import FrameError
from lumidock.streams.pixels import supported, unpack

W, H = 12, 6


def packed(pixels, layout, bits):
    """Rows of pixels as bytes, bit by bit as the definitions draw them."""
    rows = []
    for row in pixels.tolist():
        out = bytearray()
        if layout == "p":
            number = sum(value << bits * i for i, value in enumerate(row))
            out += number.to_bytes(-(-len(row) * bits // 8), "little")
        elif layout == "packed":
            for a, b in zip(row[::2], row[1::2], strict=True):
                low = bits - 8
                out += bytes([a >> low, a & (1 << low) - 1 | (b & (1 << low) - 1) << 4, b >> low])
        else:
            group, low = (4, 2) if bits == 10 else (2, 4)
            for i in range(0, len(row), group):
                part = row[i : i + group]
                rest = sum((value & (1 << low) - 1) << low * j for j, value in enumerate(part))
                out += bytes(value >> low for value in part) + bytes([rest])
        rows.append(bytes(out))
    return np.frombuffer(b"".join(rows), np.uint8), len(rows[0])


NAMES = {
    ("p", 10): ("Mono10p", "mono10p"),
    ("p", 12): ("Mono12p", "mono_12_p"),
    ("packed", 10): ("Mono10Packed",),
    ("packed", 12): ("Mono12Packed", "mono12_packed"),
    ("mipi", 10): ("Y10P", "SRGGB10_CSI2P"),
    ("mipi", 12): ("Y12P", "SGRBG12P"),
}


@given(seed=st.integers(0, 2**32 - 1), pad=st.integers(0, 5))
@pytest.mark.parametrize(("layout", "bits"), NAMES)
def test_packed_pixels_come_out_at_full_scale(layout, bits, seed, pad):
    pixels = np.random.default_rng(seed).integers(0, 1 << bits, (H, W), np.uint16)
    data, step = packed(pixels, layout, bits)
    data = np.pad(data.reshape(H, step), ((0, 0), (0, pad)), constant_values=77).reshape(-1)
    for name in NAMES[layout, bits]:
        image, encoding = unpack(data, name, (W, H), step + pad)
        assert_array_equal(image, pixels << 16 - bits)
        assert encoding == {"SRGGB10_CSI2P": "bayer_rggb16", "SGRBG12P": "bayer_grbg16"}.get(name, "")


@pytest.mark.parametrize("mosaic", MOSAICS)
@pytest.mark.parametrize(("layout", "suffix"), [("p", "p"), ("packed", "Packed")])
def test_mosaics_of_twelve_bits_stay_mosaics(mosaic, layout, suffix):
    pixels = np.arange(W * H, dtype=np.uint16).reshape(H, W) * 31
    data, step = packed(pixels, layout, 12)
    short = {"rggb": "RG", "bggr": "BG", "grbg": "GR", "gbrg": "GB"}[mosaic.removeprefix("bayer_")]
    for name in (f"Bayer{short}12{suffix}", f"{mosaic}12{suffix.lower()}"):
        image, encoding = unpack(data, name, (W, H), step)
        assert_array_equal(image, pixels << 4)
        assert encoding == f"{mosaic}16"


@pytest.mark.parametrize("name", ["mono10", "mono12", "Mono14", "BayerRG12"])
def test_bits_named_by_the_encoding_are_taken_at_its_word(name):
    bits = int(name[-2:])
    pixels = np.array([[0, 1], [(1 << bits) - 1, 5]], np.uint16)
    image, _ = unpack(pixels.view(np.uint8).reshape(-1), name, (2, 2), 4)
    assert_array_equal(image, pixels << 16 - bits)
    pixels[0, 0] = 1 << bits
    with pytest.raises(FrameError, match=f"more than {bits} bits have"):
        unpack(pixels.view(np.uint8).reshape(-1), name, (2, 2), 4)


def yuv(bgr, name):
    """Bytes and step of a picture, made from the planes that OpenCV gives."""
    i420 = cv2.cvtColor(bgr, cv2.COLOR_BGR2YUV_I420).reshape(-1)
    y, u, v = i420[: W * H].reshape(H, W), *i420[W * H :].reshape(2, H // 2, W // 2)
    if name in ("nv12", "nv21"):
        pair = (u, v) if name == "nv12" else (v, u)
        return np.concatenate([y.reshape(-1), np.stack(pair, -1).reshape(-1)]), W
    if name in ("i420", "yv12"):
        return np.concatenate([y.reshape(-1), *(p.reshape(-1) for p in ((u, v) if name == "i420" else (v, u)))]), W
    u, v = u.repeat(2, 0), v.repeat(2, 0)
    parts = (y[:, ::2], u, y[:, 1::2], v) if name in ("yuyv", "yuv422_yuy2") else (u, y[:, ::2], v, y[:, 1::2])
    return np.stack(parts, -1).reshape(-1), 2 * W


@pytest.mark.parametrize("name", ["nv12", "nv21", "i420", "yv12", "yuyv", "yuv422_yuy2", "uyvy", "yuv422"])
def test_colours_of_a_camera_come_out(name):
    for color in ([200, 40, 90], [30, 30, 220], [128, 128, 128]):
        bgr = np.full((H, W, 3), color, np.uint8)
        image, encoding = unpack(*_arguments(bgr, name))
        image = image if image.ndim == 3 else np.dstack([image] * 3)
        assert np.abs(image.astype(int) - color).max() <= 6
        assert encoding == ""
    assert unpack(*_arguments(np.full((H, W, 3), 128, np.uint8), name))[0].ndim == 2


def _arguments(bgr, name):
    data, step = yuv(bgr, name)
    return data, name, (W, H), step


@given(
    name=st.sampled_from(
        ["mono8", "mono16", "Mono10p", "Mono12Packed", "Y10P", "nv12", "yuyv", "bgr16", "32FC1", "rggb"]
    ),
    size=st.tuples(st.integers(-2, 40), st.integers(-2, 40)),
    step=st.integers(-5, 200),
    length=st.integers(0, 4000),
)
def test_any_numbers_give_a_picture_or_a_bad_frame(name, size, step, length):
    problem = ""
    try:
        image, _ = unpack(np.zeros(length, np.uint8), name, size, step)
    except FrameError as error:
        problem = str(error)
    assert len(problem.splitlines()) == 1 if problem else image.shape[:2] == size[::-1]


def test_what_is_read_is_known():
    assert all(supported(name) for name in ("mono8", "Mono12Packed", "BayerGB12p", "NV12", "YUV422_8_UYVY", "rgb8"))
    assert not any(supported(name) for name in ("32FC1", "Mono12Foo", "", "bayer"))
