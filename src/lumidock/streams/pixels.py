"""Raw pixels, as cameras and ROS lay them out, into mono8 or bgr8."""

from __future__ import annotations

import cv2
import numpy as np

from lumidock.datatypes import Image
from lumidock.errors import FrameError
from lumidock.streams.images import MAX_PIXELS, mono_if_gray

_BAYER = {
    "rggb": cv2.COLOR_BayerRGGB2BGR,
    "bggr": cv2.COLOR_BayerBGGR2BGR,
    "gbrg": cv2.COLOR_BayerGBRG2BGR,
    "grbg": cv2.COLOR_BayerGRBG2BGR,
}
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
    **{f"bayer_{pattern}{8 * size}": (1, size, code) for pattern, code in _BAYER.items() for size in (1, 2)},
}


def unpack(
    data: np.ndarray, encoding: str, size: tuple[int, int], step: int, *, order: str = "<", bits: int = 16
) -> Image:
    """Picture of the bytes `data` (N,), `size` (width, height), rows `step` bytes apart.

    16-bit pixels, whose bytes are in `order`, keep the upper 8 of their `bits`. Raises: FrameError, one line.
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
        pixels = np.minimum(wide.astype(np.uint16) >> (bits - 8), 255).astype(np.uint8)
    image = pixels.reshape((height, width) if channels == 1 else (height, width, channels))
    if conversion is not None:
        try:
            image = np.asarray(cv2.cvtColor(image, conversion), np.uint8)
        except cv2.error:  # an odd size has no half of its colours
            raise FrameError("bad_frame", f"{encoding} of {width}x{height} pixels") from None
    return mono_if_gray(image)
