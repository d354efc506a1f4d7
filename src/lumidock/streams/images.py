"""Reading one picture from a file that may be half written, corrupt or hostile."""

from __future__ import annotations

import stat
from pathlib import Path

import cv2
import numpy as np

from lumidock.datatypes import Image
from lumidock.errors import FrameError, InputError
from lumidock.streams.headers import Header, HeaderError, header_of
from lumidock.streams.source import Size

# in the order in which one of several forms of the same picture is preferred: what lost nothing first
SUFFIXES = (".png", ".tif", ".tiff", ".bmp", ".webp", ".jpg", ".jpeg")
_MAX_BYTES = 1 << 28
MAX_PIXELS = 100_000_000
_AS_IT_IS = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION


def read_image(path: Path, encoding: str = "", *, size: Size | None = None, as_stored: bool = False) -> Image:
    """Read a picture file as (H, W) mono or, where it has colour, (H, W, 3) BGR, of 8 or 16 bits as the file has them.

    A file that `encoding` calls a mosaic has one channel. The header is read before any pixel, and the file must be
    complete: with zeros in place of its second half, as a power cut leaves it, the decoder takes it for whole. The
    picture is turned as its Exif orientation says, unless it is wanted `as_stored`, and must then be of `size`.
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
    return decode_image(data, path, encoding, size=size, as_stored=as_stored)


def decode_image(
    data: bytes, path: object, encoding: str = "", *, size: Size | None = None, as_stored: bool = False
) -> Image:
    """The picture (H, W[, 3]) in the bytes of a picture file, which an error calls `path`. Raises: as `read_image`."""
    header = picture_header(data, path)
    if as_stored or encoding.startswith("bayer"):  # turning would change which pixel has which colour
        header = Header(header.width, header.height)
    if not 0 < header.width * header.height <= MAX_PIXELS:
        raise _bad(path, f"{header.width}x{header.height} pixels")
    require_size(header.size, size, path)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), _AS_IT_IS)
    except cv2.error:
        image = None
    if image is None or image.dtype not in (np.uint8, np.uint16):
        raise _bad(path, "cannot be decoded")
    if encoding.startswith("bayer"):
        if image.ndim != 2 or 8 * image.dtype.itemsize != int(encoding.lstrip("abcdefghijklmnopqrstuvwxyz_")):
            raise _bad(path, f"not {encoding}")
        return np.asarray(image)
    return turned(mono_if_gray(np.asarray(image)), header.orientation)


def picture_header(data: bytes, path: object) -> Header:
    """Size and orientation of a picture file. Raises: as `read_image`."""
    try:
        return header_of(data)
    except HeaderError as error:
        raise _bad(path, str(error)) from None


def require_size(size: Size, wanted: Size | None, path: object) -> None:
    """Raises: FrameError `bad_frame` for a picture of another size than is wanted, before its pixels cost memory."""
    if wanted is not None and size != wanted:
        raise _bad(path, f"{size[0]}x{size[1]} pixels, the camera has {wanted[0]}x{wanted[1]}")


def turned(image: Image, orientation: int) -> Image:
    """A picture (H, W[, 3]) as its Exif orientation, 1 to 8, says to show it."""
    if orientation >= 5:
        image = np.swapaxes(image, 0, 1)
    if orientation in (2, 3, 6, 7):
        image = image[:, ::-1]
    if orientation in (3, 4, 7, 8):
        image = image[::-1]
    return np.ascontiguousarray(image)


def full_scale(image: Image, bits: int) -> Image:
    """A picture (H, W[, 3]) whose 16-bit pixels have `bits` that count, stretched to 16; beyond them is white.

    Raises: InputError where the bits that count plainly are the upper ones, so that every picture would come out white.
    """
    if image.dtype != np.uint16 or bits == 16:
        return image
    most = np.uint16((1 << bits) - 1)
    if image.max(initial=0) > most and not np.bitwise_or.reduce(image, axis=None) & ((1 << 16 - bits) - 1):
        raise InputError(
            f"--bits {bits}: the pixels go up to {int(image.max())} and leave the lower {16 - bits} bits empty, so the "
            f"{bits} bits are the upper ones of 16; leave --bits out"
        )
    return np.left_shift(np.minimum(image, most), np.uint16(16 - bits))


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
