"""Reading one picture from a file that may be half written, corrupt or hostile."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np

from lumidock.datatypes import Image
from lumidock.errors import FrameError

SUFFIXES = (".png", ".jpg", ".jpeg")
_MAX_BYTES = 1 << 28
_MAX_PIXELS = 100_000_000
_SIZE_MARKERS = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}


def read_image(path: Path) -> Image:
    """Read a PNG or JPEG as (H, W) mono8 or (H, W, 3) bgr8.

    The header is read before any pixel and the end marker must be there: the decoder returns whole pictures from half
    files. Raises: FrameError `bad_frame`, one line.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise _bad(path, "too large")
        data = path.read_bytes()
    except OSError as error:
        raise _bad(path, error.strerror or "cannot be read") from None
    width, height = _size_in_header(path, data)
    if not 0 < width * height <= _MAX_PIXELS:
        raise _bad(path, f"{width}x{height} pixels")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        image = None
    if image is None:
        raise _bad(path, "cannot be decoded")
    return np.asarray(image, np.uint8)


def _bad(path: Path, why: str) -> FrameError:
    return FrameError("bad_frame", f"{path}: {why}")


def _size_in_header(path: Path, data: bytes) -> tuple[int, int]:
    if data.startswith(b"\x89PNG\r\n\x1a\n") and len(data) > 24:
        if b"IEND" not in data[-64:]:
            raise _bad(path, "truncated PNG")
        width, height = struct.unpack(">II", data[16:24])
        return width, height
    if data.startswith(b"\xff\xd8"):
        if not data.rstrip(b"\0\r\n ").endswith(b"\xff\xd9"):
            raise _bad(path, "truncated JPEG")
        return _jpeg_size(path, data)
    raise _bad(path, "empty file" if not data else "neither PNG nor JPEG")


def _jpeg_size(path: Path, data: bytes) -> tuple[int, int]:
    """Width and height from the start-of-frame segment. Source: ITU-T T.81, B.2.2."""
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker in _SIZE_MARKERS:
            height, width = struct.unpack(">HH", data[at + 5 : at + 9])
            return width, height
        at += 1 if marker == 0xFF else 2 + struct.unpack(">H", data[at + 2 : at + 4])[0]
    raise _bad(path, "JPEG without a size")
