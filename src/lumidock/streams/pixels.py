"""Pixels as cameras and ROS lay them out in memory, into mono, BGR or a raw mosaic of 8 or 16 bits.

Sources: sensor_msgs/image_encodings.hpp (ROS), the EMVA's PFNC 2.4 (GenICam: Mono12p,
Mono12Packed, BayerRG12p, ...), the MIPI CSI-2 specification (RAW10, RAW12), FourCC definitions of YUYV, UYVY, NV12.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from lumidock.datatypes import Image
from lumidock.errors import FrameError
from lumidock.streams.images import MAX_PIXELS, full_scale, mono_if_gray, require_size
from lumidock.streams.source import Size

# channels, bytes each, conversion
_PLAIN: dict[str, tuple[int, int, int | None]] = {
    "8uc1": (1, 1, None),
    "16uc1": (1, 2, None),
    "bgr8": (3, 1, None),
    "bgr8packed": (3, 1, None),
    "8uc3": (3, 1, None),
    "rgb8": (3, 1, cv2.COLOR_RGB2BGR),
    "rgb8packed": (3, 1, cv2.COLOR_RGB2BGR),
    "bgr16": (3, 2, None),
    "16uc3": (3, 2, None),
    "rgb16": (3, 2, cv2.COLOR_RGB2BGR),
    "bgra8": (4, 1, cv2.COLOR_BGRA2BGR),
    "8uc4": (4, 1, cv2.COLOR_BGRA2BGR),
    "rgba8": (4, 1, cv2.COLOR_RGBA2BGR),
    "bgra16": (4, 2, cv2.COLOR_BGRA2BGR),
    "rgba16": (4, 2, cv2.COLOR_RGBA2BGR),
    "uyvy": (2, 1, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422": (2, 1, cv2.COLOR_YUV2BGR_UYVY),
    "yuyv": (2, 1, cv2.COLOR_YUV2BGR_YUY2),
    "yuy2": (2, 1, cv2.COLOR_YUV2BGR_YUY2),
    "yuv422yuy2": (2, 1, cv2.COLOR_YUV2BGR_YUY2),
    "yuv422_8": (2, 1, cv2.COLOR_YUV2BGR_YUY2),
    "yuv422_8_uyvy": (2, 1, cv2.COLOR_YUV2BGR_UYVY),
}
_PLANAR = {
    "nv12": cv2.COLOR_YUV2BGR_NV12,
    "nv21": cv2.COLOR_YUV2BGR_NV21,
    "i420": cv2.COLOR_YUV2BGR_I420,
    "yuv420p": cv2.COLOR_YUV2BGR_I420,
    "yv12": cv2.COLOR_YUV2BGR_YV12,
}
_SENSOR = re.compile(
    r"(mono|gray|y|bayer(?:rggb|bggr|grbg|gbrg|rg|bg|gr|gb)|s(?:rggb|bggr|grbg|gbrg))(8|10|12|14|16)"
    r"(p|packed|csi2p|mipi|le)?"
)
_ORDERS = {"rg": "rggb", "bg": "bggr", "gr": "grbg", "gb": "gbrg"}
# pixels of a group and its bytes; Packed of GigE Vision puts two pixels of 10 bits into three bytes as well
_GROUPS = {("p", 10): (4, 5), ("mipi", 10): (4, 5), ("packed", 10): (2, 3)} | {
    (layout, 12): (2, 3) for layout in ("p", "mipi", "packed")
}
READ = (
    "mono, bgr, rgb, bgra, rgba and bayer of 8 or 16 bits; mono and bayer of 10 or 12 bits, packed too; yuyv, uyvy, "
    "nv12, nv21, i420"
)


@dataclass(frozen=True, slots=True)
class _Sensor:
    """A mono picture or a mosaic as a sensor gives it: how many bits count, and how they are packed, if they are."""

    encoding: str
    bits: int
    layout: str

    @property
    def depth(self) -> int:
        return 1 if self.bits == 8 else 2


@lru_cache(maxsize=64)
def _sensor_of(name: str) -> _Sensor | None:
    found = _SENSOR.fullmatch(name.replace("_", ""))
    if found is None:
        return None
    kind, bits, layout = found[1], int(found[2]), found[3] or ""
    order = kind.removeprefix("bayer").removeprefix("s") if kind not in ("mono", "gray", "y") else ""
    layout = {"csi2p": "mipi", "le": ""}.get(layout, layout)
    if kind == "y" or kind.startswith("s"):  # as V4L2 calls them, where P stands for the packing of MIPI
        layout = {"p": "mipi"}.get(layout, layout)
    if layout and (layout, bits) not in _GROUPS:
        return None
    encoding = f"bayer_{_ORDERS.get(order, order)}{8 if bits == 8 else 16}" if order else ""
    return _Sensor(encoding, bits, layout)


def supported(encoding: str) -> bool:
    """Whether pixels of this encoding, by its name in ROS, GenICam or V4L2, can be read."""
    name = encoding.strip().lower()
    plain = name in _PLAIN or name.replace("_", "") in _PLAIN or name in _PLANAR
    return plain or _sensor_of(name) is not None


def unpack(
    data: np.ndarray,
    encoding: str,
    size: Size,
    step: int,
    *,
    order: str = "<",
    bits: int = 16,
    wanted: Size | None = None,
) -> tuple[Image, str]:
    """Picture of the bytes `data` (N,), `size` (width, height), rows `step` bytes apart, and what a frame calls it.

    Pixels of 16 bits, whose bytes are in `order` and of which the lower `bits` count, get their full scale; where the
    encoding's name says how many count, they are taken at its word. A mosaic stays one, under its name; mono and BGR
    need none. Raises: FrameError, one line, also for a size other than the one that is `wanted`.
    """
    width, height = size
    if min(size) <= 0 or width * height > MAX_PIXELS:
        raise FrameError("bad_frame", f"{width}x{height} pixels do not fit {len(data)} bytes")
    require_size(size, wanted, encoding[:40])
    name = encoding.strip().lower()
    sensor = _sensor_of(name)
    if sensor is not None and sensor.layout:
        return _packed(data, encoding, sensor, size, step), sensor.encoding
    if sensor is not None:
        image = _rows(data, size, step, sensor.depth, order).reshape(height, width)
        return _counted(image, encoding, sensor.bits, bits), sensor.encoding
    if name in _PLANAR:
        return _planar(data, encoding, size, step), ""
    plain = _PLAIN.get(name) or _PLAIN.get(name.replace("_", ""))
    if plain is None:
        raise FrameError("bad_frame", f"encoding {encoding[:40]!r} is not supported; read are {READ}")
    channels, depth, conversion = plain
    pixels = _rows(data, (width * channels, height), step, depth, order)
    image = pixels.reshape((height, width) if channels == 1 else (height, width, channels))
    return mono_if_gray(_converted(full_scale(image, bits), conversion, encoding, size)), ""


def _rows(data: np.ndarray, size: Size, step: int, depth: int, order: str = "<") -> Image:
    """Numbers (height, width) of `depth` bytes each; what pads the rows is left out. Raises: FrameError."""
    width, height = size
    if step < width * depth or step * height > len(data):
        raise FrameError("bad_frame", f"{width}x{height} numbers of {8 * depth} bits do not fit {len(data)} bytes")
    pixels = np.ascontiguousarray(data[: step * height].reshape(height, step)[:, : width * depth])
    if depth == 1:
        return pixels
    return pixels.view(np.dtype(np.uint16).newbyteorder(">" if order == ">" else "<")).astype(np.uint16)


def _counted(image: Image, encoding: str, named: int, bits: int) -> Image:
    """Full scale for pixels of which `named` bits count by the encoding's name or, where that says 16, `bits`."""
    if named == 16:
        return full_scale(image, bits)
    if named == 8:
        return image
    if image.max(initial=0) >> named:
        raise FrameError("bad_frame", f"{encoding[:40]}: pixels up to {int(image.max())}, more than {named} bits have")
    return np.left_shift(image, np.uint16(16 - named))


def _packed(data: np.ndarray, encoding: str, sensor: _Sensor, size: Size, step: int) -> Image:
    """A picture (H, W) of 10 or 12 bits a pixel without gaps, at the full scale of 16 bits. Raises: FrameError."""
    width, height = size
    pixels, length = _GROUPS[sensor.layout, sensor.bits]
    groups = -(-width // pixels)
    least = -(-width * length // pixels)  # the last group of a row may be cut short
    if step < least or step * height > len(data):
        raise FrameError("bad_frame", f"{width}x{height} pixels of {encoding[:40]} do not fit {len(data)} bytes")
    rows = data[: step * height].reshape(height, step)[:, : min(step, groups * length)]
    padded = np.zeros((height, groups * length), np.uint16)
    padded[:, : rows.shape[1]] = rows
    out = np.empty((height, groups, pixels), np.uint16)
    _UNPACKERS[sensor.layout, sensor.bits](padded.reshape(height, groups, length), out)
    return np.ascontiguousarray(np.left_shift(out.reshape(height, -1)[:, :width], np.uint16(16 - sensor.bits)))


def _p12(b: np.ndarray, out: np.ndarray) -> None:
    """Lowest bits first, without gaps (PFNC `p`)."""
    out[..., 0] = b[..., 0] | (b[..., 1] & 0xF) << 8
    out[..., 1] = b[..., 1] >> 4 | b[..., 2] << 4


def _packed12(b: np.ndarray, out: np.ndarray) -> None:
    """The upper 8 bits of two pixels around a byte with the lower 4 of each (GigE Vision `Packed`)."""
    out[..., 0] = b[..., 0] << 4 | b[..., 1] & 0xF
    out[..., 1] = b[..., 2] << 4 | b[..., 1] >> 4


def _mipi12(b: np.ndarray, out: np.ndarray) -> None:
    """The upper 8 bits of two pixels, then a byte with the lower 4 of each (MIPI RAW12)."""
    out[..., 0] = b[..., 0] << 4 | b[..., 2] & 0xF
    out[..., 1] = b[..., 1] << 4 | b[..., 2] >> 4


def _p10(b: np.ndarray, out: np.ndarray) -> None:
    for i in range(4):
        out[..., i] = (b[..., i] >> 2 * i | b[..., i + 1] << 8 - 2 * i) & 0x3FF


def _packed10(b: np.ndarray, out: np.ndarray) -> None:
    out[..., 0] = b[..., 0] << 2 | b[..., 1] & 3
    out[..., 1] = b[..., 2] << 2 | b[..., 1] >> 4 & 3


def _mipi10(b: np.ndarray, out: np.ndarray) -> None:
    for i in range(4):
        out[..., i] = b[..., i] << 2 | b[..., 4] >> 2 * i & 3


_UNPACKERS = {
    ("p", 10): _p10,
    ("p", 12): _p12,
    ("packed", 10): _packed10,
    ("packed", 12): _packed12,
    ("mipi", 10): _mipi10,
    ("mipi", 12): _mipi12,
}


def _planar(data: np.ndarray, encoding: str, size: Size, step: int) -> Image:
    """A picture in planes of which the colours have half the rows and columns. Raises: FrameError."""
    width, height = size
    step = width if step in (0, width * 3 // 2) else step  # some drivers count the colours into a row
    if width % 2 or height % 2 or step < width or step * (height * 3 // 2) > len(data):
        raise FrameError("bad_frame", f"{width}x{height} pixels of {encoding[:40]} do not fit {len(data)} bytes")
    if step != width and encoding.strip().lower() not in ("nv12", "nv21"):
        raise FrameError("bad_frame", f"{encoding[:40]} with padded rows is not supported")
    planes = np.ascontiguousarray(data[: step * (height * 3 // 2)].reshape(height * 3 // 2, step)[:, :width])
    return mono_if_gray(_converted(planes, _PLANAR[encoding.strip().lower()], encoding, size))


def _converted(image: Image, conversion: int | None, encoding: str, size: Size) -> Image:
    if conversion is None:
        return image
    try:
        return np.asarray(cv2.cvtColor(image, conversion))
    except cv2.error:  # an odd size has no half of its colours
        raise FrameError("bad_frame", f"{encoding[:40]} of {size[0]}x{size[1]} pixels") from None
