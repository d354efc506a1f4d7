"""Frames of a video file, with the presentation times that it holds."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np
from av.error import FFmpegError

from lumidock.datatypes import Frame, Image, Unusable
from lumidock.errors import InputError
from lumidock.streams.images import MAX_PIXELS, mono_if_gray
from lumidock.streams.sources import Item, Source

_TINT = 4  # grey levels; decoded gray is off by up to 3
# no playlists: what a file names elsewhere is not opened
_FORMATS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpeg,mpegts,asf,nut,h264,hevc,mjpeg"
_OPTIONS = {"format_whitelist": _FORMATS, "protocol_whitelist": "file"}


def open_video(path: Path, fps: float | None, gray: bool) -> Source:
    """Open a video file; `fps` overrides its times, `gray` takes the luma plane alone where there is one.

    Raises: InputError when there is nothing to decode.
    """
    try:
        with av.open(str(path), options=_OPTIONS) as container:
            count = _count(container.streams.video[0], container.duration)
        decodable = any(isinstance(frame, av.VideoFrame) for frame in _decoded(path))
    except (FFmpegError, IndexError, ValueError):
        decodable = False
    if not decodable:
        raise InputError(f"{path}: not a video that can be decoded")
    return Source(path, "video", lambda: _items(path, fps, gray), count, inputs=(path,))


def _count(stream: av.VideoStream, duration: int | None) -> int | None:
    """Number of frames by the container, or about that by its duration (in av.time_base) and rate."""
    if stream.frames > 0:
        return stream.frames
    return round(duration * stream.average_rate / av.time_base) if duration and stream.average_rate else None


def _items(path: Path, fps: float | None, gray: bool) -> Iterator[Item]:
    for number, frame in enumerate(_decoded(path)):
        name = f"{number:06d}"
        if isinstance(frame, str):
            yield Unusable(name, None, "bad_frame", f"frame {name}: {frame}")
            continue
        t_ns = round(number * 1e9 / fps) if fps else stamp_of(frame)
        if t_ns is None:
            yield Unusable(name, None, "bad_stamp", f"frame {name}: no presentation time")
        elif frame.is_corrupt:
            yield Unusable(name, t_ns, "bad_frame", f"frame {name}: damaged")
        else:
            yield Frame(name, t_ns, picture_of(frame, gray))


def stamp_of(frame: av.VideoFrame) -> int | None:
    """Presentation time ns, exact in the container's time base."""
    if frame.pts is None or frame.time_base is None:
        return None
    return round(frame.pts * frame.time_base * 10**9)


def _decoded(path: Path) -> Iterator[av.VideoFrame | str]:
    """Frames in order of presentation; in place of a packet that cannot be decoded, why."""
    with av.open(str(path), options=_OPTIONS) as container:
        stream = container.streams.video[0]
        if stream.codec_context is None:  # an index cut short says nothing of the codec
            return
        stream.codec_context.options = {"max_pixels": str(MAX_PIXELS)}
        stream.thread_type = "AUTO"
        packets = container.demux(stream)
        while True:
            try:
                packet = next(packets)
                yield from packet.decode()
            except StopIteration:
                return
            except FFmpegError as error:
                yield f"cannot be decoded: {error.strerror or error}"


def picture_of(frame: av.VideoFrame, gray: bool) -> Image:
    """Picture (H, W) mono8 or (H, W, 3) bgr8 of a decoded frame; where colour is not needed, its luma plane."""
    has_luma = frame.format.name.startswith(("yuv", "nv"))
    if (gray and has_luma) or _has_no_color(frame):
        return np.ascontiguousarray(frame.to_ndarray(format="gray"))
    return mono_if_gray(np.asarray(frame.to_ndarray(format="bgr24"), np.uint8), tint=_TINT)


def _has_no_color(frame: av.VideoFrame) -> bool:
    if frame.format.name.startswith("gray"):
        return True
    if not frame.format.name.startswith(("yuv4", "yuvj4")) or frame.format.components[0].bits != 8:
        return False
    return all(_is_flat(plane) for plane in list(frame.planes)[1:3])


def _is_flat(plane: av.video.plane.VideoPlane) -> bool:
    """Whether a chroma plane says gray everywhere, to 2 levels."""
    levels = np.frombuffer(bytes(plane), np.uint8).reshape(-1, plane.line_size)[:, : plane.width]
    return bool(levels.min() >= 126 and levels.max() <= 130)
