"""Pictures as JPEG, each encoded once however many sinks want it."""

from __future__ import annotations

import threading
from collections import deque

import cv2

from lumidock.datatypes import Image

_QUALITY = 85
_KEPT = 2  # frames that sinks are apart
_lock = threading.Lock()
_recent: deque[tuple[Image, bytes]] = deque(maxlen=_KEPT)


def jpeg_of(image: Image) -> bytes:
    """The bytes of a picture (H, W[, 3]) as JPEG; the same array is not encoded again."""
    with _lock:
        for known, data in _recent:
            if known is image:
                return data
        data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
        _recent.append((image, data))
    return data
