"""Pictures into an mp4 file that can be played even if the writer is killed."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from lumidock.datatypes import Image

_CLOCK = 90_000  # ticks a second
_FRAGMENTS = {
    "movflags": "frag_keyframe+empty_moov+default_base_moof",
    "frag_duration": "500000",  # us
    "flush_packets": "1",
}
_CODEC = {"preset": "veryfast", "tune": "zerolatency", "crf": "23"}


class Mp4:
    """H.264 in fragments of half a second; each picture is shown at its own time after the first."""

    def __init__(self, path: Path) -> None:
        """Start the file, replacing one that is there."""
        self._container = av.open(str(path), "w", format="mp4", options=_FRAGMENTS)
        self._stream: av.VideoStream | None = None
        self._first_ns, self._last_pts = 0, -1

    def add(self, picture: Image, t_ns: int) -> None:
        """Append a picture (H, W, 3) bgr8; one that is not later than the last is left out."""
        height, width = (side - side % 2 for side in picture.shape[:2])
        if self._stream is None:
            self._stream = self._container.add_stream("libx264", rate=30, options=_CODEC)
            self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, "yuv420p"
            self._stream.codec_context.time_base = Fraction(1, _CLOCK)
            self._stream.codec_context.gop_size = 15
            self._first_ns = t_ns
        pts = (t_ns - self._first_ns) * _CLOCK // 10**9
        if pts <= self._last_pts:
            return
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture[:height, :width]), "bgr24")
        frame.pts, frame.time_base = pts, Fraction(1, _CLOCK)
        self._container.mux(self._stream.encode(frame))
        self._last_pts = pts

    def close(self) -> None:
        """Write what is still in the encoder and close the file."""
        if self._stream is not None:
            self._container.mux(self._stream.encode(None))
        self._container.close()
