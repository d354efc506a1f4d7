"""Cost of a rendered frame on one core: expected electrons, read-out and picture, encoding; peak memory."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from bench.shipped import shipped_camera
from lumidock.sim.scattering import halo
from lumidock.sim.scenario import load_scenario, station_of
from lumidock.sim.schedule import schedule_of
from lumidock.station import load_station

SCENARIOS = ("approach", "headlamp", "pool", "occluder", "flat-port")
FRAMES = (40, 140, 190, 215)  # of the approach: z = 24, 9, 1.5, -2.25 m
_REPEATS = 5


def _best_s(step: Callable[[], object]) -> float:
    """CPU time s of the fastest of `_REPEATS` runs."""
    times = []
    for _ in range(_REPEATS):
        start = time.process_time()
        step()
        times.append(time.process_time() - start)
    return min(times)


def costs_ms(name: str, folder: Path) -> list[float]:
    """Milliseconds of the slowest of `FRAMES`: all, expected electrons, sensor, encoding."""
    scenario = load_scenario(name)
    schedule = schedule_of(scenario, load_station(station_of(scenario)), shipped_camera(), 0)
    rows = []
    for number in FRAMES:
        renderer, conditions = schedule.renderer(number), schedule.conditions(number)
        expected = renderer.expect(conditions)
        image = renderer.picture_of(expected, np.random.Generator(np.random.SFC64(0)))
        light = _best_s(
            lambda renderer=renderer, conditions=conditions: (halo.cache_clear(), renderer.expect(conditions))
        )
        sensor = _best_s(
            lambda renderer=renderer, expected=expected: renderer.picture_of(
                expected, np.random.Generator(np.random.SFC64(0))
            )
        )
        file = _best_s(lambda image=image: cv2.imwrite(str(folder / "a.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, 95]))
        rows.append(1e3 * np.array([light + sensor + file, light, sensor, file]))
    return [float(value) for value in max(rows, key=lambda row: row[0])]


def main() -> tuple[dict[str, object], list[str]]:
    """One row per scenario."""
    cv2.setNumThreads(1)
    mono = np.zeros((2048, 2448), np.uint8)
    unit = 1e3 * _best_s(lambda: [mono.max() for _ in range(20)]) / 20
    lines = ["| slowest of 4 frames, ms of one core | all | light | sensor | JPEG |", "|---|---|---|---|---|"]
    content: dict[str, object] = {"unit_ms": unit}
    with TemporaryDirectory() as folder:
        for name in SCENARIOS:
            content[name] = costs = costs_ms(name, Path(folder))
            lines.append(f"| {name} | " + " | ".join(f"{value:.0f}" for value in costs) + " |")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    lines += ["", f"np.max over a mono frame takes {unit:.2f} ms here. Peak memory: {peak} MiB."]
    return content, lines
