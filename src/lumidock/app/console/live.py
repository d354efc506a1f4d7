"""The newest fix for the pages that look on: kept by reference, and turned into a message when one is asked for.

Guidance pays for a reference and a wake-up a frame. A page asks for each message by itself, so a page that stalls
waits for its own answer only, and nothing is queued for it.
"""

from __future__ import annotations

import json
import math
import struct
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2

from lumidock.app.console.frame_view import Scene, frame_view
from lumidock.datatypes import Fix, Frame, Image
from lumidock.picture import developed
from lumidock.streams.source import Item

RATE_HZ = 10.0  # of messages to one page; an eye follows a slow vehicle with less
_WIDTH = 960  # of the picture on the page, px; a phone has fewer, and the marks are drawn over it unscaled
_QUALITY = 75  # of its JPEG: 60 to 120 kB
_HEALTH_S = 1.0  # between two looks at rates and latencies, whose percentiles take a millisecond
_MOST_KEPT = 256 << 20  # bytes of frames for a preview
_KEPT_S = 10.0  # of frames for a preview ...
_ASKED_S = 15.0  # ... which are kept for so long after they were last asked for


def picture_of(image: Image) -> bytes:
    """An image as a JPEG of at most 960 pixels' width."""
    width = min(_WIDTH, image.shape[1])
    size = (width, max(1, round(image.shape[0] * width / image.shape[1])))
    smaller = cv2.resize(image, size, interpolation=cv2.INTER_AREA) if width < image.shape[1] else image
    return cv2.imencode(".jpg", smaller, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()


def message_of(content: dict[str, Any], picture: bytes) -> bytes:
    """One binary message: the length of the JSON in four bytes, little end first, the JSON, the JPEG."""
    text = json.dumps(content, separators=(",", ":"), allow_nan=False).encode()
    return struct.pack("<I", len(text)) + text + picture


@dataclass(frozen=True, slots=True)
class _Shown:
    number: int
    item: Item
    fix: Fix
    latency_us: int | None


class LiveView:
    """A sink that holds the newest fix, when each light was last identified, and on request the last seconds."""

    def __init__(self, scene: Scene, health: Callable[[], dict[str, Any]] = dict) -> None:
        """`health` tells rates, latencies and drops; it is asked at most once a second."""
        self.scene, self.health = scene, health
        self._lock, self._encoding = threading.Lock(), threading.Lock()
        self._shown: _Shown | None = None
        self._message: tuple[int, bytes] = (0, b"")
        self._health: tuple[float, dict[str, Any]] = (-math.inf, {})
        self._wake: dict[object, Callable[[], None]] = {}
        self._seen_ns: dict[int, int] = {}
        self._kept = deque[Frame]()
        self._keep_until_s = 0.0

    def add(self, item: Item, fix: Fix, latency_us: int | None) -> None:
        """Show this fix from now on."""
        with self._lock:
            number = self._shown.number + 1 if self._shown else 1
            self._shown = _Shown(number, item, fix, latency_us)
            if fix.match is not None:
                self._seen_ns |= {light: fix.t_ns for light in fix.match.light.tolist() if light >= 0}
            self._keep(item)
            wakers = list(self._wake.values())
        for wake in wakers:
            wake()

    def close(self) -> None:
        """Nothing is held that would have to be written."""

    def subscribe(self, wake: Callable[[], None]) -> Callable[[], None]:
        """Have `wake` called at every new fix, on the thread of the sink, until the returned function is called."""
        key = object()
        with self._lock:
            self._wake[key] = wake

        def end() -> None:
            with self._lock:
                self._wake.pop(key, None)

        return end

    @property
    def number(self) -> int:
        """How many fixes there have been."""
        with self._lock:
            return self._shown.number if self._shown else 0

    def message(self) -> tuple[int, bytes]:
        """The newest fix's number and its message, which is made once however many pages want it."""
        with self._encoding:
            with self._lock:
                shown, seen_ns = self._shown, dict(self._seen_ns)
            if shown is not None and shown.number != self._message[0]:
                picture = picture_of(developed(shown.item)) if isinstance(shown.item, Frame) else b""
                self._message = (shown.number, message_of(self._content(shown, seen_ns), picture))
            return self._message

    def _content(self, shown: _Shown, seen_ns: dict[int, int]) -> dict[str, Any]:
        ids, now_ns = self.scene.station.ids, shown.fix.t_ns
        last_seen = {ids[light]: round((now_ns - t_ns) * 1e-9, 3) for light, t_ns in seen_ns.items()}
        if time.monotonic() - self._health[0] > _HEALTH_S:
            self._health = (time.monotonic(), self.health())
        content = frame_view(shown.fix, self.scene, shown.latency_us)
        return content | {"number": shown.number, "last_seen_s": last_seen, "health": self._health[1]}

    def newest(self) -> Frame | None:
        """The newest frame, if it has a picture."""
        with self._lock:
            return self._shown.item if self._shown and isinstance(self._shown.item, Frame) else None

    def ask_to_keep(self) -> None:
        """Keep frames for a preview, from now on and for a quarter of a minute after the last such call."""
        with self._lock:
            self._keep_until_s = time.monotonic() + _ASKED_S

    def kept(self) -> list[Frame]:
        """The frames of the last seconds, as far as they were asked for."""
        with self._lock:
            return list(self._kept)

    def _keep(self, item: Item) -> None:
        if time.monotonic() > self._keep_until_s:
            self._kept.clear()
            return
        if not isinstance(item, Frame):
            return
        self._kept.append(item)
        most = max(1, _MOST_KEPT // item.image.nbytes)
        while len(self._kept) > most or item.t_ns - self._kept[0].t_ns > _KEPT_S * 1e9:
            self._kept.popleft()
