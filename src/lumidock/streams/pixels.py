"""Pixels as cameras and ROS lay them out in memory, into mono, BGR or a raw mosaic of 8 or 16 bits."""

from __future__ import annotations

import cv2
import numpy as np

from lumidock.datatypes import MOSAICS, Image
from lumidock.errors import FrameError
from lumidock.streams.images import MAX_PIXELS, full_scale, mono_if_gray

# channels, bytes each, conversion; the names are those of sensor_msgs/image_encodings.hpp
_ENCODINGS: dict[str, tuple[int, int, int | None]] = {
    "mono8": (1, 1, None),
    "8UC1": (1, 1, None),
    "mono16": (1, 2, None),
    "16UC1": (1, 2, None),
    "bgr8": (3, 1, None),
    "8UC3": (3, 1, None),
    "rgb8": (3, 1, cv2.COLOR_RGB2BGR),
    "bgr16": (3, 2, None),
    "rgb16": (3, 2, cv2.COLOR_RGB2BGR),
    "bgra8": (4, 1, cv2.COLOR_BGRA2BGR),
    "rgba8": (4, 1, cv2.COLOR_RGBA2BGR),
    "uyvy": (2, 1, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422": (2, 1, cv2.COLOR_YUV2BGR_UYVY),
    "yuyv": (2, 1, cv2.COLOR_YUV2BGR_YUY2),
    "yuv422_yuy2": (2, 1, cv2.COLOR_YUV2BGR_YUY2),
    **{f"{mosaic}{8 * size}": (1, size, None) for mosaic in MOSAICS for size in (1, 2)},
}


def unpack(
    data: np.ndarray, encoding: str, size: tuple[int, int], step: int, *, order: str = "<", bits: int = 16
) -> tuple[Image, str]:
    """Picture of the bytes `data` (N,), `size` (width, height), rows `step` bytes apart, and what a frame calls it.

    16-bit pixels, whose bytes are in `order` and of which the lower `bits` count, get their full scale. A mosaic
    stays one, under its name; mono and BGR need none. Raises: FrameError, one line.
    """
    if encoding not in _ENCODINGS:
        raise FrameError("bad_frame", f"encoding {encoding[:40]!r} is not supported")
    channels, depth, conversion = _ENCODINGS[encoding]
    width, height = size
    row = width * channels * depth
    if not 0 < width * height <= MAX_PIXELS or step < row or step * height > len(data):
        raise FrameError("bad_frame", f"{width}x{height} pixels do not fit {len(data)} bytes")
    pixels = np.ascontiguousarray(data[: step * height].reshape(height, step)[:, :row])
    if depth == 2:
        wide = pixels.view(np.dtype(np.uint16).newbyteorder(">" if order == ">" else "<"))
        pixels = full_scale(wide.astype(np.uint16), bits)
    image = pixels.reshape((height, width) if channels == 1 else (height, width, channels))
    if conversion is not None:
        try:
            image = np.asarray(cv2.cvtColor(image, conversion))
        except cv2.error:  # an odd size has no half of its colours
            raise FrameError("bad_frame", f"{encoding} of {width}x{height} pixels") from None
    return mono_if_gray(image), encoding if encoding.startswith("bayer") else ""
