"""Cameras: RTSP and RTP streams, and V4L2 devices. A frame's stamp is the time of this machine when it was decoded."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from lumidock.datatypes import Frame
from lumidock.errors import InputError, extra
from lumidock.streams.images import mono_if_gray
from lumidock.streams.sources import Item, Source

_DEVICE = re.compile(r"/dev/video[0-9]{1,3}")


_SINCE_EPOCH_NS = time.time_ns() - time.monotonic_ns()


def now_ns() -> int:
    """Time since the epoch, by the clock as it was at the start: setting it later does not make stamps jump."""
    return _SINCE_EPOCH_NS + time.monotonic_ns()


def open_live(address: str, *, gray: bool = False) -> Source | None:
    """A camera by its address: rtsp://..., rtp://HOST:PORT (H.264), /dev/videoN or gige:[NAME]; None for none of these.

    It is not opened yet: a camera that is lost, or not there yet, is an InputError of its `items`.
    """
    if address.startswith("gige:"):
        from lumidock.streams import gige

        name = address.removeprefix("gige:")
        return Source(Path(name or "gige"), "gige", lambda: gige.frames_of(name), live=True)
    if _DEVICE.fullmatch(address):
        return Source(Path(address), "v4l2", lambda: _device(address), live=True)
    if address.startswith(("rtsp://", "rtsps://", "rtp://")):
        with extra("video"):
            from lumidock.streams.network import frames_of, without_password
        return Source(Path(without_password(address)), "stream", lambda: frames_of(address, gray), live=True)
    return None


def _device(path: str) -> Iterator[Item]:
    capture = cv2.VideoCapture(path, cv2.CAP_V4L2)
    try:
        if not capture.isOpened():
            raise InputError(f"{path}: no camera there")
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        number = 0
        while capture.grab():
            t_ns = now_ns()
            decoded, image = capture.retrieve()
            if decoded:
                yield Frame(f"{number:06d}", t_ns, mono_if_gray(np.asarray(image, np.uint8)))
            number += 1
    finally:
        capture.release()
