"""What a frame's acquisition costs where its work is bounded, and what a unit of that work costs.

Random detections that all look like lamps, alone and around the lights of the shipped dock. Everything runs in one
process, in turns, in CPU time of the thread.
"""

from __future__ import annotations

import time
from collections import Counter

import numpy as np

from bench.shipped import shipped_camera, shipped_station
from bench.speed import machine
from lumidock import match, verify
from lumidock.config import Config
from lumidock.datatypes import Array, Detections
from lumidock.model import attitude_prior, measurements, station_model

_SEED, _DRAWS, _RANDOM = 8800, 100, (4, 16, 60, 200)
_Z_M = (3.0, 20.0)


def lights_in_view(rng: np.random.Generator) -> Array:
    """Pixels (n, 2) of the shipped dock's lights from a random distance, nine in ten of those in the picture."""
    station, camera = shipped_station(), shipped_camera()
    at = (rng.uniform(-0.3, 0.3), rng.uniform(-0.3, 0.3), rng.uniform(*_Z_M))
    uv = camera.project(station.p_dock * (1.0, -1.0, -1.0) + at)
    return uv[np.asarray(camera.contains(uv)) & (rng.random(len(uv)) < 0.9)] + rng.normal(0.0, 0.3, 2)


def main() -> tuple[dict[str, object], list[str]]:
    """Milliseconds of a frame, its answers, and microseconds of a unit of `match.max_work`."""
    station, camera, config = shipped_station(), shipped_camera(), Config()
    model, prior = station_model(station, camera, config.match), attitude_prior(None, config.prior)
    rng = np.random.default_rng(_SEED)
    size = (camera.width, camera.height)
    times: dict[tuple[int, bool], list[float]] = {(n, dock): [] for n in _RANDOM for dock in (False, True)}
    words: dict[tuple[int, bool], Counter[str]] = {key: Counter() for key in times}
    for draw in range(_DRAWS + 1):
        for (n, dock), ms in times.items():
            uv = rng.uniform((0.0, 0.0), size, (n, 2))
            uv = np.concatenate([lights_in_view(rng), uv]) if dock else uv
            start = time.thread_time()
            found = match.acquire(
                measurements(Detections.from_uv("0", 0, uv), model, config.match), model, camera, prior, config.match
            )
            if draw:  # the first one compiled
                ms.append(1e3 * (time.thread_time() - start))
                words[n, dock]["answer" if verify.is_answer(found, config.match) else found.reason] += 1
    spent = [1e3 * ms / config.match.max_work for ms in times[200, False]]
    lines = [f"| random detections | ms: median | largest of {_DRAWS} | what it says |", "|---|---|---|---|"]
    content: dict[str, object] = {"us_a_unit": float(np.median(spent)), "max_work": config.match.max_work}
    for (n, dock), ms in times.items():
        what = f"{n}{' around the dock' if dock else ''}"
        said = ", ".join(f"{word} {count}" for word, count in words[n, dock].most_common())
        content[what] = {"median_ms": float(np.median(ms)), "largest_ms": max(ms), "said": dict(words[n, dock])}
        lines.append(f"| {what} | {np.median(ms):.1f} | {max(ms):.1f} | {said} |")
    lines += ["", f"A unit of `match.max_work` takes {np.median(spent):.2f} us. {machine()}"]
    return content, lines
