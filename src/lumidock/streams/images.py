"""Reading one picture from a file that may be half written, corrupt or hostile."""

from __future__ import annotations

import stat
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np

from lumidock.datatypes import Image
from lumidock.errors import FrameError

SUFFIXES = (".png", ".jpg", ".jpeg")
_MAX_BYTES = 1 << 28
MAX_PIXELS = 100_000_000
_PNG = b"\x89PNG\r\n\x1a\n"
_SIZE_MARKERS, _SCAN = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}, 0xDA
_END = b"\xff\xd9"
_AS_IT_IS = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION


def read_image(path: Path, encoding: str = "") -> Image:
    """Read a PNG or JPEG as (H, W) mono or, where it has colour, (H, W, 3) BGR, of 8 or 16 bits as the file has them.

    A file that `encoding` calls a mosaic has one channel. The header is read before any pixel, and the file must be
    complete: with zeros in place of its second half, as a power cut leaves it, the decoder takes it for whole.
    Raises: FrameError `bad_frame`, one line.
    """
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise _bad(path, "not a file")  # a pipe would keep the run waiting
        if status.st_size > _MAX_BYTES:
            raise _bad(path, "too large")
        data = path.read_bytes()
    except OSError as error:
        raise _bad(path, error.strerror or "cannot be read") from None
    return decode_image(data, path, encoding)


def decode_image(data: bytes, path: object, encoding: str = "") -> Image:
    """The picture (H, W[, 3]) in the bytes of a PNG or JPEG, which an error calls `path`. Raises: as `read_image`."""
    width, height = _size_in_header(path, data)
    if not 0 < width * height <= MAX_PIXELS:
        raise _bad(path, f"{width}x{height} pixels")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), _AS_IT_IS)
    except cv2.error:
        image = None
    if image is None:
        raise _bad(path, "cannot be decoded")
    if encoding.startswith("bayer"):
        if image.ndim != 2 or 8 * image.dtype.itemsize != int(encoding.lstrip("abcdefghijklmnopqrstuvwxyz_")):
            raise _bad(path, f"not {encoding}")
        return np.asarray(image)
    return mono_if_gray(np.asarray(image))


def full_scale(image: Image, bits: int) -> Image:
    """A picture (H, W[, 3]) whose 16-bit pixels have `bits` that count, stretched to 16; beyond them is white."""
    if image.dtype != np.uint16 or bits == 16:
        return image
    return np.left_shift(np.minimum(image, np.uint16((1 << bits) - 1)), np.uint16(16 - bits))


def mono_if_gray(image: Image, *, tint: int = 0) -> Image:
    """A picture (H, W, 3) as (H, W) when its channels differ by at most `tint`: a mono camera's, saved as colour."""
    if image.ndim == 3 and _is_gray(image[::16, ::16], tint) and _is_gray(image, tint):
        return np.ascontiguousarray(image[:, :, 1])
    return image


def _is_gray(image: Image, tint: int) -> bool:
    blue, green, red = cv2.split(image)
    return max(int(cv2.absdiff(blue, green).max()), int(cv2.absdiff(green, red).max())) <= tint


def _bad(path: object, why: str) -> FrameError:
    return FrameError("bad_frame", f"{path}: {why}")


def _size_in_header(path: object, data: bytes) -> tuple[int, int]:
    if data.startswith(_PNG):
        return _png_size(path, data)
    if data.startswith(b"\xff\xd8"):
        return _jpeg_size(path, data)
    raise _bad(path, "empty file" if not data else "neither PNG nor JPEG")


def _png_size(path: object, data: bytes) -> tuple[int, int]:
    """Width and height from the header chunk, after a check of every chunk up to the last. Source: ISO 15948, 5.3."""
    at, view = len(_PNG), memoryview(data)
    while at + 12 <= len(data):
        length, kind = struct.unpack(">I4s", data[at : at + 8])
        end = at + 8 + length
        if data[end : end + 4] != struct.pack(">I", zlib.crc32(view[at + 4 : end])):
            raise _bad(path, "truncated or corrupt PNG")
        if kind == b"IEND" and data[12:16] == b"IHDR":
            width, height = struct.unpack(">II", data[16:24])
            return width, height
        at = end + 4
    raise _bad(path, "truncated PNG")


def _jpeg_size(path: object, data: bytes) -> tuple[int, int]:
    """Width and height from the start-of-frame segment; the scan must have an end. Source: ITU-T T.81, B.1, B.2."""
    at, size = 2, (0, 0)
    while at + 9 <= len(data) and data[at] == 0xFF and data[at + 1] != _SCAN:
        marker = data[at + 1]
        if marker in _SIZE_MARKERS:
            height, width = struct.unpack(">HH", data[at + 5 : at + 9])
            size = width, height
        at += 1 if marker == 0xFF else 2 + struct.unpack(">H", data[at + 2 : at + 4])[0]
    if data.find(_END, at) < 0:  # inside a scan these two bytes mean nothing else
        raise _bad(path, "truncated JPEG")
    return size
