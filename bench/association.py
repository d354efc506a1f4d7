"""Cost of associating detections on one core: acquisition by kind of frame, and a tracked frame."""

from __future__ import annotations

import time
from itertools import islice

import numpy as np

from bench.shipped import shipped_camera, shipped_station
from bench.speed import machine
from lumidock import match
from lumidock.config import Config
from lumidock.datatypes import Detections
from lumidock.localizer import Localizer
from lumidock.model import attitude_prior, measurements, station_model
from lumidock.sim.detections import simulated_frames
from lumidock.sim.scenario import load_scenario

_FRAMES, _SEED = 300, 300
_ACQUISITIONS = {
    "one layer, 6 lights": ("missing-1", ()),
    "one layer, 1-3 missing + 1-5 spurious": ("missing-spurious", ()),
    "one layer, 7 lights + 20 spurious": ("missing-spurious", ("faults.missing=0", "faults.spurious=20")),
    "both layers, 13 lights": ("joint", ("detections.drop=0", "faults.spurious=0", "detections.wrong_layer=0")),
    "both layers, 20 % missing, 3 spurious, 30 % wrong labels": ("joint", ()),
}


def acquisition_ms(scenario: str, settings: tuple[str, ...]) -> np.ndarray:
    """Milliseconds (N,) of `match.acquire` on each of some frames of a scenario."""
    station, camera, config = shipped_station(), shipped_camera(), Config()
    model, expected = station_model(station, camera, config.match), attitude_prior(None, config.prior)
    times = []
    for frame in islice(simulated_frames(load_scenario(scenario, settings), station, camera, _SEED), _FRAMES):
        start = time.perf_counter()
        found = measurements(frame.detections, model, config.match)
        match.acquire(found, model, camera, expected, config.match)
        times.append(1e3 * (time.perf_counter() - start))
    return np.array(times[1:])


def tracking_ms() -> np.ndarray:
    """Milliseconds (N,) of each frame of a nominal run through `process_detections`, those without history left out."""
    localizer = Localizer(shipped_station(), shipped_camera())
    frames: list[Detections] = [
        frame.detections
        for frame in simulated_frames(load_scenario("nominal"), localizer.station, localizer.camera, _SEED)
    ]
    times = []
    for detections in frames:
        start = time.perf_counter()
        fix = localizer.process_detections(detections)
        if fix.status == "tracking":
            times.append(1e3 * (time.perf_counter() - start))
    return np.array(times)


def main() -> tuple[dict[str, object], list[str]]:
    """One row a kind of frame."""
    tracking_ms()  # compiles
    content: dict[str, object] = {}
    lines = ["| association, ms a frame | median | 95 % | slowest |", "|---|---|---|---|"]
    rows = {f"acquisition: {name}": acquisition_ms(*what) for name, what in _ACQUISITIONS.items()} | {
        "tracking, nominal run": tracking_ms()
    }
    for name, times in rows.items():
        median, p95, slowest = np.percentile(times, [50, 95, 100])
        lines.append(f"| {name} | {median:.2f} | {p95:.2f} | {slowest:.2f} |")
        content[name] = {"median_ms": median, "p95_ms": p95, "max_ms": slowest}
    lines += ["", machine()]
    return content, lines
