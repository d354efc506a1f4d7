"""Cost of a rendered frame on one core: expected light, read-out and development, encoding; peak memory."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from bench.shipped import shipped_camera, shipped_station
from lumidock.sim.scattering import halo
from lumidock.sim.scenario import load_scenario
from lumidock.sim.schedule import schedule_of

SCENARIOS = ("approach", "headlamp", "pool", "occluder", "flat-port")
FRAMES = (40, 140, 190, 215)  # of the approach: z = 24, 9, 1.5, -2.25 m
_REPEATS = 5


def _best_s(step: Callable[[], object]) -> float:
    """CPU time of the fastest of some repeats."""
    times = []
    for _ in range(_REPEATS):
        start = time.process_time()
        step()
        times.append(time.process_time() - start)
    return min(times)


def costs_ms(name: str, folder: Path) -> list[float]:
    """Slowest of the frames: all, light, sensor, encoding; ms."""
    plan = schedule_of(load_scenario(name), shipped_station(), shipped_camera(), 0)
    rows = []
    for number in FRAMES:
        studio, moment = plan.studio(number), plan.moment(number)
        shot = studio.shoot(moment)
        image = studio.develop(shot, np.random.Generator(np.random.SFC64(0)))
        light = _best_s(lambda studio=studio, moment=moment: (halo.cache_clear(), studio.shoot(moment)))
        sensor = _best_s(lambda studio=studio, shot=shot: studio.develop(shot, np.random.Generator(np.random.SFC64(0))))
        file = _best_s(lambda image=image: cv2.imwrite(str(folder / "a.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, 95]))
        rows.append(1e3 * np.array([light + sensor + file, light, sensor, file]))
    return [float(value) for value in max(rows, key=lambda row: row[0])]


def main() -> tuple[dict[str, object], list[str]]:
    """One row a scenario."""
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
