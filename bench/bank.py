"""What the bank of subset states costs a tracked frame: with it and without, in turns, in CPU time of one process."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import nullcontext
from typing import Any
from unittest.mock import patch

import numpy as np

from bench.shipped import shipped_camera, shipped_station
from bench.speed import dense_station, machine
from lumidock import track
from lumidock.datatypes import Detections
from lumidock.localizer import Localizer
from lumidock.station import Station

_SEED, _TURNS, _FRAMES, _SETTLED, _Z_M = 8900, 6, 60, 10, 12.0


def approach(station: Station, rng: np.random.Generator) -> Iterator[Detections]:
    """An approach head-on at 1 m/s and 15 Hz, all lights detected."""
    camera = shipped_camera()
    for k in range(_FRAMES):
        uv = camera.project(station.p_dock * (1.0, -1.0, -1.0) + (0.1, 0.05, _Z_M - k / 15.0))
        yield Detections.from_uv(str(k), round(k / 15.0 * 1e9), uv + rng.normal(0.0, 0.3, uv.shape))


def tracked_ms(station: Station, *, bank: bool) -> list[float]:
    """Milliseconds of each tracked frame; without its bank a track never begins a subset."""
    localizer, times = Localizer(station, shipped_camera()), []
    kernel = nullcontext() if bank else patch.object(track.bank_kernel, "update_bank", lambda *_, **__: None)
    with kernel:
        for detections in approach(station, np.random.default_rng(_SEED)):
            start = time.thread_time()
            localizer.process_detections(detections)
            times.append(1e3 * (time.thread_time() - start))
    return times[_SETTLED:]


def main() -> tuple[dict[str, Any], list[str]]:
    """One row a dock."""
    lines = ["| dock | tracked frame, ms | without the bank | the bank | ratio |", "|---|---|---|---|---|"]
    content: dict[str, Any] = {}
    docks = {"the shipped cage": shipped_station(), "25 lights": dense_station(25, np.random.default_rng(_SEED))}
    for name, station in docks.items():
        tracked_ms(station, bank=True)  # compiles
        with_it, without = [], []
        for _ in range(_TURNS):
            with_it += tracked_ms(station, bank=True)
            without += tracked_ms(station, bank=False)
        a, b = float(np.median(with_it)), float(np.median(without))
        content[name] = {"with_ms": a, "without_ms": b}
        lines.append(f"| {name} | {a:.2f} | {b:.2f} | {a - b:.2f} | {a / b:.2f} |")
    return content, [*lines, "", machine()]
