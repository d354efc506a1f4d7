"""Frames of a video file, with the presentation times that it holds."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.error import FFmpegError

from lumidock.datatypes import Frame, Image, Unusable
from lumidock.errors import FrameError, InputError
from lumidock.streams.images import MAX_PIXELS, mono_if_gray, require_size, turned
from lumidock.streams.source import Item, Reading, Size, Source

_TINT = 4  # grey levels; decoded gray is off by up to 3
# no playlists: what a file names elsewhere is not opened
_FORMATS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpeg,mpegts,asf,nut,h264,hevc,mjpeg"
_OPTIONS = {"format_whitelist": _FORMATS, "protocol_whitelist": "file"}


def open_video(path: Path, reading: Reading) -> Source:
    """Open a video file; `fps` replaces its times, `gray` takes the luma plane alone where there is one.

    Raises: InputError when there is nothing to decode, or no time and no `fps`.
    """
    first = count = rate = None
    try:
        with av.open(str(path), options=_OPTIONS) as container:
            stream = container.streams.video[0]
            count, rate = _count(stream, container.duration), stream.average_rate
        first = next((frame for frame in _decoded(path) if isinstance(frame, av.VideoFrame)), None)
    except (FFmpegError, IndexError, ValueError):
        pass
    if first is None:
        raise InputError(f"{path}: not a video that can be decoded")
    if reading.fps is None and stamp_of(first) is None:
        raise InputError(f"{path}: a video without times; give --fps")
    notes = (*_time_note(first, rate, reading.fps), *_rotation_note(first, reading.as_stored))
    return Source(path, "video", lambda size: _items(path, reading, size), count, inputs=(path,), notes=notes)


def _time_note(first: av.VideoFrame, rate: Fraction | None, fps: float | None) -> tuple[str, ...]:
    if fps is None or stamp_of(first) is None:
        return ()
    own = f", {float(rate):.6g} frames a second on average," if rate else ""
    return (f"the video's own times{own} are replaced by --fps {fps:g}",)


def _rotation_note(first: av.VideoFrame, as_stored: bool) -> tuple[str, ...]:
    if not first.rotation:
        return ()
    if as_stored:
        return (f"the video's header says to turn it by {first.rotation} degrees; left as stored",)
    if _orientation(first) == 1:
        return (f"the video's header says to turn it by {first.rotation} degrees, which is not done; left as stored",)
    return (
        f"pictures are turned by {first.rotation} degrees (counterclockwise) as the video's header says, which the "
        "calibration has to fit; or give --as-stored",
    )


def _orientation(frame: av.VideoFrame) -> int:
    """The Exif orientation that turns a frame as its display matrix says: counterclockwise by `rotation` degrees."""
    return {90: 8, 180: 3, 270: 6}.get(round(frame.rotation) % 360, 1)


def _count(stream: av.VideoStream, duration: int | None) -> int | None:
    """Number of frames by the container, or about that by its duration (in av.time_base) and rate."""
    if stream.frames > 0:
        return stream.frames
    return round(duration * stream.average_rate / av.time_base) if duration and stream.average_rate else None


def _items(path: Path, reading: Reading, size: Size | None) -> Iterator[Item]:
    for number, frame in enumerate(_decoded(path)):
        name = f"{number:06d}"
        if isinstance(frame, str):
            yield Unusable(name, None, "bad_frame", f"frame {name}: {frame}")
            continue
        t_ns = round(number * 1e9 / reading.fps) if reading.fps else stamp_of(frame)
        orientation = 1 if reading.as_stored else _orientation(frame)
        if t_ns is None:
            yield Unusable(name, None, "bad_stamp", f"frame {name}: no presentation time")
        elif frame.is_corrupt:
            yield Unusable(name, t_ns, "bad_frame", f"frame {name}: damaged")
        else:
            try:
                shown = (frame.height, frame.width) if orientation >= 5 else (frame.width, frame.height)
                require_size(shown, size, f"frame {name}")
                yield Frame(name, t_ns, turned(picture_of(frame, reading.gray), orientation))
            except FrameError as error:
                yield Unusable(name, t_ns, error.reason, str(error))


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
