"""Milliseconds a stage and peak memory of the paper's method at 2448 x 2048, on one core."""

from __future__ import annotations

import csv
import platform
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from bench.shipped import CAMERA_FILE, STATION_FILE, shipped_camera, shipped_station
from lumidock.config import PaperConfig
from lumidock.datatypes import Frame
from lumidock.paper import PaperLocalizer, extract
from lumidock.paper.layers import LayerDiscriminator, label_by_color
from lumidock.sim.scenario import load_scenario, trajectory
from lumidock.sim.sequence import render_frame

_Z_M = (18.0, 9.0, 2.3)
_ROUNDS = 15


def frames() -> dict[float, list[Frame]]:
    """Two consecutive frames of the approach at each range."""
    scenario, station, camera = load_scenario("approach"), shipped_station(), shipped_camera()
    t_ns, poses = trajectory(scenario, np.random.default_rng(0))
    found: dict[float, list[Frame]] = {}
    for z in _Z_M:
        first = int(np.argmin(np.abs(poses[:, 2, 3] - z)))
        for number in (first, first + 1):
            rng = np.random.default_rng(number)
            nothing = np.empty(0, np.int64)
            image, _, _ = render_frame(scenario, station, camera, poses[number], np.empty((0, 2)), nothing, rng)
            found.setdefault(z, []).append(Frame(str(number), int(t_ns[number]), image))
    return found


def _milliseconds(job: Callable[[], object]) -> float:
    start = time.perf_counter()
    job()
    return 1e3 * (time.perf_counter() - start)


def _stages(first: Frame, second: Frame) -> dict[str, float]:
    """One timing of each stage on the second frame, with the first as history."""
    station, camera, config = shipped_station(), shipped_camera(), PaperConfig()
    mono = np.ascontiguousarray(second.image[:, :, 1])
    timing = {"np.max over a mono frame": _milliseconds(lambda: np.max(mono))}
    timing["extract"] = _milliseconds(lambda: extract.lights(second, config.extract))
    spots = extract.lights(second, config.extract)
    timing["layers"] = _milliseconds(lambda: label_by_color(second, spots, config.layers))
    labelled = label_by_color(second, spots, config.layers)
    rear = LayerDiscriminator(config.layers).rear(labelled)
    localizer = PaperLocalizer(station, camera, config)
    localizer.process(first)
    seen = max(sum(int(group.sum()) >= 4 for group in (rear, ~rear)), 1)
    matching = _milliseconds(lambda: localizer.process_detections(labelled))
    timing["match and pose, per layer seen"] = matching / seen
    fresh = PaperLocalizer(station, camera, config)
    timing["whole frame, first"] = _milliseconds(lambda: fresh.process(first))
    timing["whole frame, next"] = _milliseconds(lambda: fresh.process(second))
    return timing


def _peak_mib(pictures: list[Frame]) -> float:
    """Peak memory of `lumidock run` over the frames, as its own process."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "frames").mkdir()
        with (folder / "timestamps.csv").open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(("frame", "file", "t_ns"))
            for number, frame in enumerate(pictures):
                cv2.imwrite(str(folder / "frames" / f"{number}.jpg"), frame.image)
                writer.writerow((number, f"{number}.jpg", number * 150_000_000))
        command = [sys.executable, "-m", "lumidock", "run", name, "--out", str(folder / "run")]
        subprocess.run([*command, "--station", STATION_FILE, "--camera", CAMERA_FILE], check=True, capture_output=True)
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024.0


def main() -> tuple[dict[str, object], list[str]]:
    """Medians over interleaved rounds, one row a stage and one column a range."""
    cv2.setNumThreads(1)
    pictures = frames()
    rounds: dict[float, list[dict[str, float]]] = {z: [] for z in _Z_M}
    _stages(*pictures[_Z_M[0]])  # compiles
    for _ in range(_ROUNDS):
        for z in _Z_M:
            rounds[z].append(_stages(*pictures[z]))
    lines = ["| ms, median (slowest) | " + " | ".join(f"{z:g} m" for z in _Z_M) + " |", "|---|" + "---|" * len(_Z_M)]
    for stage in rounds[_Z_M[0]][0]:
        cells = (np.array([timing[stage] for timing in rounds[z]]) for z in _Z_M)
        lines.append(f"| {stage} | " + " | ".join(f"{np.median(c):.2f} ({c.max():.2f})" for c in cells) + " |")
    peak = _peak_mib([frame for group in pictures.values() for frame in group])
    lines += ["", f"Peak memory of a run: {peak:.0f} MiB. {machine()}"]
    content = {"rounds": {str(z): timings for z, timings in rounds.items()}, "peak_mib": peak, "machine": machine()}
    return content, lines


def machine() -> str:
    """What the figures were measured on."""
    model = next(
        (line.split(":")[1].strip() for line in Path("/proc/cpuinfo").read_text().splitlines() if "model name" in line),
        platform.machine(),
    )
    return f"Machine: {model}, one core, Python {platform.python_version()}, OpenCV {cv2.__version__}."
