"""Frames as JPEG, each encoded once however many sinks want it."""

from __future__ import annotations

import threading
from collections import deque

import cv2

from lumidock.datatypes import Frame, Image
from lumidock.picture import developed

_QUALITY = 85
_KEPT = 2  # frames that sinks are apart
_lock = threading.Lock()
_recent: deque[tuple[Image, bytes]] = deque(maxlen=_KEPT)


def jpeg_of(frame: Frame) -> bytes:
    """The bytes of a frame's picture as JPEG; the same image is not encoded again."""
    with _lock:
        for known, data in _recent:
            if known is frame.image:
                return data
        data = cv2.imencode(".jpg", developed(frame), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
        _recent.append((frame.image, data))
    return data
