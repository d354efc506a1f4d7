"""What the head of a picture file says before any pixel is read: format, size, rotation, and whether the file is whole.

Sources: ISO 15948 (PNG), ITU-T T.81 (JPEG), TIFF 6.0, Exif 2.32 (orientation, tag 0x0112), the BITMAPINFOHEADER of
Windows (BMP), RFC 9649 (WebP).
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

_PNG = b"\x89PNG\r\n\x1a\n"
_SIZE_MARKERS, _SCAN, _APP1 = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}, 0xDA, 0xE1
_END = b"\xff\xd9"
_ORIENTATION = 0x0112
_MOST_ENTRIES = 4096  # of a directory in TIFF; cameras write some dozens
_TYPE_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8}
_TYPE_LETTERS = {1: "B", 3: "H", 4: "I"}
# what is met in place of a picture that can be read: its first bytes, where they stand, and what it is called
_OTHERS = (
    (0, b"GIF8", "GIF"),
    (0, b"\xff\x0a", "JPEG XL"),
    (4, b"JXL ", "JPEG XL"),
    (4, b"jP  ", "JPEG 2000"),
    (0, b"\xff\x4f\xff\x51", "JPEG 2000"),
    (4, b"ftypavif", "AVIF"),
    (4, b"ftyphei", "HEIC"),
    (4, b"ftypmif1", "HEIF"),
    (4, b"ftyp", "a video (MP4)"),
    (0, b"\x76\x2f\x31\x01", "OpenEXR"),
    (0, b"\x93NUMPY", "a NumPy array"),
    (0, b"SIMPLE  =", "FITS"),
    (0, b"PK\x03\x04", "a ZIP archive"),
    (0, b"%PDF", "a PDF"),
    (0, b"P5", "PGM"),
    (0, b"P6", "PPM"),
    (0, b"\0\0\0\x01", "a frame of video (H.264 or H.265)"),
    (0, b"\0\0\x01", "a frame of video (H.264 or H.265)"),
)


class HeaderError(Exception):
    """Why a file is no picture that can be read."""


@dataclass(frozen=True, slots=True)
class Header:
    """Size as stored, px, and the Exif orientation, 1 to 8, that says how the picture is to be turned or mirrored."""

    width: int
    height: int
    orientation: int = 1

    @property
    def size(self) -> tuple[int, int]:
        """Width and height after turning."""
        return (self.height, self.width) if self.orientation >= 5 else (self.width, self.height)


def header_of(data: bytes) -> Header:
    """The header of a PNG, JPEG, TIFF, BMP or WebP whose bytes are all there. Raises: HeaderError."""
    try:
        if data.startswith(_PNG):
            return _png(data)
        if data.startswith(b"\xff\xd8"):
            return _jpeg(data)
        if data[:4] in (b"II*\0", b"MM\0*"):
            return _tiff(data)
        if data.startswith(b"BM"):
            return _bmp(data)
        if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
            return _webp(data)
    except (struct.error, IndexError):
        raise HeaderError("truncated or corrupt header") from None
    raise HeaderError(_other(data))


def _other(data: bytes) -> str:
    if not data:
        return "empty file"
    for at, magic, name in _OTHERS:
        if data[at : at + len(magic)] == magic:
            return f"{name}; read are PNG, JPEG, TIFF, BMP and WebP"
    if data[:4] in (b"II+\0", b"MM\0+"):
        return "BigTIFF; read are PNG, JPEG, TIFF, BMP and WebP"
    return "neither PNG nor JPEG, TIFF, BMP or WebP"


def _png(data: bytes) -> Header:
    """The header chunk, after a check of every chunk up to the last."""
    at, view, orientation = len(_PNG), memoryview(data), 1
    while at + 12 <= len(data):
        length, kind = struct.unpack(">I4s", data[at : at + 8])
        end = at + 8 + length
        if data[end : end + 4] != struct.pack(">I", zlib.crc32(view[at + 4 : end])):
            raise HeaderError("truncated or corrupt PNG")
        if kind == b"eXIf":
            orientation = _exif_orientation(data[at + 8 : end])
        if kind == b"IEND" and data[12:16] == b"IHDR":
            width, height = struct.unpack(">II", data[16:24])
            return Header(width, height, orientation)
        at = end + 4
    raise HeaderError("truncated PNG")


def _jpeg(data: bytes) -> Header:
    """The start-of-frame segment; the scan must have an end."""
    at, size, orientation = 2, (0, 0), 1
    while at + 9 <= len(data) and data[at] == 0xFF and data[at + 1] != _SCAN:
        marker = data[at + 1]
        if marker in _SIZE_MARKERS:
            height, width = struct.unpack(">HH", data[at + 5 : at + 9])
            size = width, height
        elif marker == _APP1 and data[at + 4 : at + 10] == b"Exif\0\0":
            length = struct.unpack(">H", data[at + 2 : at + 4])[0]
            orientation = _exif_orientation(data[at + 10 : at + 2 + length])
        at += 1 if marker == 0xFF else 2 + struct.unpack(">H", data[at + 2 : at + 4])[0]
    if data.find(_END, at) < 0:  # inside a scan these two bytes mean nothing else
        raise HeaderError("truncated JPEG")
    return Header(*size, orientation)


def _exif_orientation(data: bytes) -> int:
    """The orientation in a block of Exif; 1, as stored, where it has none that makes sense."""
    try:
        found = _directory(data).tags.get(_ORIENTATION, (1,))
    except (HeaderError, struct.error):
        return 1
    return found[0] if found and 1 <= found[0] <= 8 else 1


@dataclass(frozen=True, slots=True)
class _Directory:
    tags: dict[int, tuple[int, ...]]
    following: int


def _directory(data: bytes, at: int | None = None) -> _Directory:
    """A directory of TIFF, the first one unless `at` says where: whole numbers by their tag. Raises: HeaderError."""
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(data[:4])
    if order is None:
        raise HeaderError("corrupt TIFF")
    at = struct.unpack_from(f"{order}I", data, 4)[0] if at is None else at
    (count,) = struct.unpack_from(f"{order}H", data, at)
    if count > _MOST_ENTRIES:
        raise HeaderError("corrupt TIFF")
    tags: dict[int, tuple[int, ...]] = {}
    for number in range(count):
        entry = at + 2 + 12 * number
        tag, kind, length = struct.unpack_from(f"{order}HHI", data, entry)
        letter = _TYPE_LETTERS.get(kind)
        if letter is None or not 0 < length <= len(data):
            tags.setdefault(tag, ())
            continue
        size = _TYPE_SIZES[kind] * length
        start = entry + 8 if size <= 4 else struct.unpack_from(f"{order}I", data, entry + 8)[0]
        tags[tag] = struct.unpack_from(f"{order}{length}{letter}", data, start)
    (following,) = struct.unpack_from(f"{order}I", data, at + 2 + 12 * count)
    return _Directory(tags, following)


def _tiff(data: bytes) -> Header:
    first = _directory(data)
    tags = first.tags
    if 50706 in tags:  # DNGVersion
        raise HeaderError("DNG, a raw photograph; develop it to PNG or TIFF")
    width, height = tags.get(256, (0,)), tags.get(257, (0,))
    if not width or not height:
        raise HeaderError("corrupt TIFF")
    bits, form = tags.get(258, (1,)), tags.get(339, (1,))
    if set(form) - {1}:
        raise HeaderError("TIFF of numbers that are not unsigned integers")
    if len(set(bits)) != 1 or bits[0] not in (8, 16):
        raise HeaderError(f"TIFF of {'/'.join(map(str, sorted(set(bits))))} bits; read are 8 and 16")
    if first.following and not _directory(data, first.following).tags.get(254, (0,))[:1] == (1,):
        raise HeaderError("TIFF of several pictures; write each into a file of its own")
    starts, lengths = tags.get(273) or tags.get(324, ()), tags.get(279) or tags.get(325, ())
    if not starts or len(starts) != len(lengths):
        raise HeaderError("corrupt TIFF")
    if any(start + length > len(data) for start, length in zip(starts, lengths, strict=True)):
        raise HeaderError("truncated TIFF")
    orientation = tags.get(_ORIENTATION, (1,))
    return Header(width[0], height[0], orientation[0] if orientation and 1 <= orientation[0] <= 8 else 1)


def _bmp(data: bytes) -> Header:
    offset, head = struct.unpack_from("<II", data, 10)
    if head == 12:
        width, height, _, bits = struct.unpack_from("<HHHH", data, 18)
        packing = 0
    else:
        width, height, _, bits, packing = struct.unpack_from("<iiHHI", data, 18)
        height = abs(height)
    if width <= 0 or packing not in (0, 3):
        raise HeaderError("corrupt BMP" if width <= 0 else "compressed BMP")
    if offset + (width * bits + 31) // 32 * 4 * height > len(data):
        raise HeaderError("truncated BMP")
    return Header(width, height)


def _webp(data: bytes) -> Header:
    if 8 + struct.unpack_from("<I", data, 4)[0] > len(data):
        raise HeaderError("truncated WebP")
    at, size, orientation = 12, None, 1
    while at + 8 <= len(data):
        kind, length = struct.unpack_from("<4sI", data, at)
        body = data[at + 8 : at + 8 + length]
        if kind == b"VP8X":
            if body[0] & 0x02:
                raise HeaderError("WebP of several pictures")
            size = 1 + int.from_bytes(body[4:7], "little"), 1 + int.from_bytes(body[7:10], "little")
        elif kind == b"VP8 " and size is None:
            wide, high = struct.unpack_from("<HH", body, 6)
            size = wide & 0x3FFF, high & 0x3FFF
        elif kind == b"VP8L" and size is None:
            (packed,) = struct.unpack_from("<I", body, 1)
            size = 1 + (packed & 0x3FFF), 1 + (packed >> 14 & 0x3FFF)
        elif kind == b"EXIF":
            orientation = _exif_orientation(body.removeprefix(b"Exif\0\0"))
        at += 8 + length + length % 2
    if size is None:
        raise HeaderError("corrupt WebP")
    return Header(*size, orientation)
