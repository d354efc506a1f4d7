"""Frames of video that come one by one in messages, decoded in their order (H.264, H.265, VP9, AV1)."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from fractions import Fraction
from typing import cast

import av
from av.error import FFmpegError
from av.stream import Stream

from lumidock.datatypes import Image
from lumidock.errors import FrameError, InputError
from lumidock.streams.images import MAX_PIXELS, require_size
from lumidock.streams.source import Size
from lumidock.streams.video import picture_of

_MOST_WAITING = 64  # frames that a decoder may hold back; more are lost


class Packets:
    """A decoder that is fed with numbered packets; every number comes out once, with a picture or why there is none.

    Pictures come in the order in which they are to be shown.
    """

    def __init__(self, codec: str, gray: bool, size: Size | None) -> None:
        """Raises: InputError for a codec that this FFmpeg does not have."""
        try:
            context = av.CodecContext.create(codec, "r")
        except (FFmpegError, ValueError):
            raise InputError(f"video of codec {codec}: this installation of PyAV cannot decode it") from None
        if not isinstance(context, av.VideoCodecContext):
            raise InputError(f"codec {codec}: no video")
        self._context, self._gray, self._size = context, gray, size
        self._context.thread_type = "SLICE"  # threads over frames would hold some back
        self._context.options = {"max_pixels": str(MAX_PIXELS)}
        self._waiting = deque[int]()
        self._problem, self._started = "no key frame before it", False

    def feed(self, number: int, data: bytes) -> Iterator[tuple[int, Image | str]]:
        """Decode the packet `number`; yields what is done with: a number, and its picture or what is wrong with it."""
        self._waiting.append(number)
        packet = av.Packet(data)
        packet.pts = packet.dts = number
        packet.time_base = Fraction(1, 1000)
        yield from self._decoded(packet)
        while len(self._waiting) > _MOST_WAITING:
            yield self._waiting.popleft(), "cannot be decoded"

    def flush(self) -> Iterator[tuple[int, Image | str]]:
        """What the decoder held back, and the packets that nothing came of."""
        yield from self._decoded(None)
        while self._waiting:
            yield self._waiting.popleft(), self._problem

    def _decoded(self, packet: av.Packet[Stream] | None) -> Iterator[tuple[int, Image | str]]:
        try:
            frames = self._context.decode(cast("av.Packet[av.VideoStream] | None", packet))
        except FFmpegError as error:
            why = f"cannot be decoded: {error.strerror or error}"
            self._problem = why if self._started else f"no key frame before it; {why}"
            if packet is not None and self._waiting and self._waiting[-1] == packet.pts:
                yield self._waiting.pop(), self._problem
            return
        for frame in frames:
            number = frame.pts
            if number is None or number not in self._waiting:
                continue
            while not self._context.has_b_frames and self._waiting[0] != number:  # those before it come no more
                yield self._waiting.popleft(), self._problem
            self._waiting.remove(number)
            yield number, self._picture(frame)
            self._problem, self._started = "cannot be decoded", True

    def _picture(self, frame: av.VideoFrame) -> Image | str:
        if frame.is_corrupt:
            return "damaged"
        try:
            require_size((frame.width, frame.height), self._size, "picture")
        except FrameError as error:
            return str(error)
        return picture_of(frame, self._gray)
